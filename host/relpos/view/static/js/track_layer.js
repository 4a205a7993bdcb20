// All tracks as one bitmap that lies on the map, north up: following, turning and panning move the
// bitmap, new points are added to it, and only another scale or leaving it draws it anew.

import { toScreen } from "./transform.js";

const MAX_PX = 4096;
const SPARE = 1.3; // how much wider than the screen's diagonal
const SETTLE_MS = 150; // while zooming, the bitmap is stretched and drawn anew at most so often

export class TrackLayer {
  constructor() {
    this.canvas = document.createElement("canvas");
    this.drawnMs = -Infinity;
    this.layout = null;
    this.drawn = new Map();
    this.renderings = 0;
  }

  forget() {
    this.layout = null;
  }

  /**
   * Draw onto `context` (CSS pixels, `ratio` device pixels each). `tracks` is [[node, track,
   * colour], ...]. Returns whether it should be called again soon, being stretched.
   */
  draw(context, view, ratio, tracks, width) {
    const needM = Math.hypot(view.width, view.height) / view.scale;
    const wanted = Math.min(view.scale * ratio, MAX_PX / (needM * SPARE));
    const now = performance.now();
    const layout = this.layout;
    const covers = layout &&
      Math.hypot(view.x - layout.x, view.y - layout.y) + needM / 2 <= layout.sideM / 2;
    const sharp = layout && Math.abs(layout.scale / wanted - 1) < 0.01;
    if (!covers || (!sharp && now - this.drawnMs > SETTLE_MS)) {
      this.begin(view, wanted, needM * SPARE);
      this.drawnMs = now;
    }
    this.extend(tracks, width * ratio);
    const { x, y, sideM } = this.layout;
    const [px, py] = toScreen(view, x, y);
    const side = sideM * view.scale;
    context.save();
    context.translate(px, py);
    context.rotate(-view.rotation);
    context.drawImage(this.canvas, -side / 2, -side / 2, side, side);
    context.restore();
    return Math.abs(this.layout.scale / wanted - 1) >= 0.01;
  }

  begin(view, scale, sideM) {
    const sidePx = Math.max(1, Math.ceil(sideM * scale));
    if (this.canvas.width !== sidePx) this.canvas.width = this.canvas.height = sidePx;
    this.context = this.canvas.getContext("2d");
    this.context.setTransform(1, 0, 0, 1, 0, 0);
    this.context.clearRect(0, 0, sidePx, sidePx);
    this.layout = { x: view.x, y: view.y, scale: sidePx / sideM, sideM, sidePx };
    this.drawn.clear();
    this.renderings += 1;
  }

  extend(tracks, width) {
    // A track that has changed behind its end cannot be drawn on.
    const stale = tracks.some(([node, track]) => {
      const before = this.drawn.get(node);
      return before && before.redrawn !== track.redrawn;
    });
    if (stale) {
      this.context.clearRect(0, 0, this.canvas.width, this.canvas.height);
      this.drawn.clear();
    }
    const { x, y, scale, sidePx } = this.layout;
    const context = this.context;
    context.lineWidth = width;
    context.lineCap = "round";
    context.lineJoin = "round";
    for (const [node, track, colour] of tracks) {
      const points = track.points;
      const from = this.drawn.get(node)?.count ?? 0;
      if (from >= points.length) continue;
      context.strokeStyle = colour;
      context.beginPath();
      for (let k = Math.max(from, 1); k < points.length; k += 1) {
        if (points[k][3]) continue;
        const before = points[k - 1];
        if (k === Math.max(from, 1) || before[3]) {
          context.moveTo(sidePx / 2 + (before[1] - x) * scale, sidePx / 2 - (before[2] - y) * scale);
        }
        context.lineTo(
          sidePx / 2 + (points[k][1] - x) * scale,
          sidePx / 2 - (points[k][2] - y) * scale,
        );
      }
      context.stroke();
      this.drawn.set(node, { count: points.length, redrawn: track.redrawn });
    }
  }
}
