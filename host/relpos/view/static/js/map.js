// The team on a canvas. Draws when something has changed, and then once a frame at most.

import { isFresh, reachM } from "./age.js";
import { inkOn, personColour } from "./colours.js";
import { placeLabels, placeWhereFree } from "./labels.js";
import { pathMarker, signOf } from "./marker.js";
import { isPlaced, VAGUE_RAD } from "./relation.js";
import { TrackLayer } from "./track_layer.js";
import {
  clampScale, fit, gridStep, headingUp, isLoose, pan, scaleBar, toMap, toScreen, zoomAt,
} from "./transform.js";
import { number, t } from "./i18n.js";
import { distance, nodeName, plusMinusDegrees, probability, probabilityHere, seconds } from "./words.js";

const TAIL_S = 30;
const MINUTE_S = 60;
const PULSE_MS = 1000;
const PULSE_STEP_MS = 100;
const GLIDE_MS = 140;
/** More people than that have too many ranges to be drawn all. */
const MANY = 8;
/** Fewer points are drawn each time: without a graphics card that costs less than their bitmap. */
const DIRECT_POINTS = 6000;
/** Ellipses hold two standard deviations: the person is inside 86 times in a hundred. */
const ELLIPSE_SIGMAS = 2;

export class TeamMap {
  constructor(canvas, team, { onPick, onCamera }) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.team = team;
    this.onPick = onPick;
    this.onCamera = onCamera;
    this.view = { x: 0, y: 0, scale: 20, rotation: 0, width: 1, height: 1 };
    this.camera = { mode: "fit", node: null };
    this.up = "north";
    this.me = null;
    this.selected = null;
    this.find = null;
    this.layers = { tracks: "all", ranges: "auto", smoothed: true };
    /** The switch of floors (`floors.js`), where the page has one. */
    this.floors = null;
    this.alarms = new Map();
    this.dark = false;
    /** Whether everything is old: then nothing has a person's colour. */
    this.old = false;
    this.still = matchMedia("(prefers-reduced-motion: reduce)");
    this.goal = null;
    this.glidedMs = 0;
    this.layer = new TrackLayer();
    this.labelPlaces = new Map();
    this.widths = new Map();
    this.frame = null;
    this.frames = 0;
    this.ratio = 1;
    this.unit = 1;
    this.readTheme();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
    this.listen();
  }

  // -- when to draw ------------------------------------------------------------------------------

  invalidate() {
    if (this.frame !== null) return;
    this.frame = requestAnimationFrame((now) => {
      this.frame = null;
      this.draw(now);
    });
  }

  resize() {
    const box = this.canvas.getBoundingClientRect();
    this.ratio = Math.min(globalThis.devicePixelRatio || 1, 3);
    this.unit = Number.parseFloat(getComputedStyle(document.documentElement).fontSize) / 16;
    const [width, height] = [Math.max(1, box.width), Math.max(1, box.height)];
    this.canvas.width = Math.round(width * this.ratio);
    this.canvas.height = Math.round(height * this.ratio);
    this.view = { ...this.view, width, height };
    this.widths.clear();
    this.refit = true;
    this.invalidate();
  }

  readTheme(dark = this.dark) {
    this.dark = dark;
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    this.colours = {
      ground: colour("--map"),
      grid: colour("--grid"),
      ink: colour("--ink"),
      soft: colour("--soft"),
      link: colour("--link"),
      alarm: colour("--alarm"),
      warning: colour("--warning"),
      accent: colour("--accent"),
      green: colour("--green"),
      yellow: colour("--yellow"),
      red: colour("--red"),
      signInk: colour("--sign-ink"),
    };
    this.layer.forget();
    this.invalidate();
  }

  colourOf(node) {
    return this.old ? this.colours.soft : personColour(node, this.dark);
  }

  // -- where the camera is -----------------------------------------------------------------------

  setCamera(mode, node = null) {
    this.camera = { mode, node };
    this.refit = true;
    this.onCamera();
    this.invalidate();
  }

  setUp(up) {
    this.up = up;
    this.refit = true;
    this.onCamera();
    this.invalidate();
  }

  zoom(factor, px = this.view.width / 2, py = this.view.height / 2) {
    if (this.camera.mode === "follow") {
      this.view = { ...this.view, scale: clampScale(this.view.scale * factor) };
    } else {
      this.view = zoomAt(this.view, factor, px, py);
      if (this.camera.mode === "fit") this.setCamera("free");
    }
    this.invalidate();
  }

  drag(dx, dy) {
    this.view = pan(this.view, dx, dy);
    if (this.camera.mode !== "free") this.setCamera("free");
    this.invalidate();
  }

  points() {
    const points = this.team.list().filter(isPlaced).map((p) => [p.x_m, p.y_m]);
    // Where they have just been, too: then the view need not move with every step.
    for (const track of this.team.tracks.values()) {
      for (let k = track.since((this.team.timeS ?? 0) - MINUTE_S); k < track.points.length; k += 4) {
        points.push([track.points[k][1], track.points[k][2]]);
      }
    }
    const { places, rings } = this.team.possible();
    for (const ring of rings) points.push(...around(ring));
    for (const place of places) {
      if (place.shape !== "ring" && place.probability >= 0.05) points.push([place.x_m, place.y_m]);
    }
    return points;
  }

  /** Whose heading is up: mine, else that of who is followed, else the first one's. */
  headingPerson() {
    const node = this.me ?? this.camera.node ?? this.team.wearers()[0]?.node;
    return this.team.person(node);
  }

  /** Move the view to where it belongs; whether it is still on its way there. */
  aim(now) {
    const person = this.headingPerson();
    const turned = this.up === "heading" && person && Number.isFinite(person.heading_rad) &&
      (person.sigma_heading_rad ?? 0) < VAGUE_RAD;
    const rotation = headingUp(turned ? person.heading_rad : this.team.northRad ?? Math.PI / 2);
    // Without a heading to turn by, the map stays as it was turned last.
    if (this.up === "north" || turned) this.view = { ...this.view, rotation };
    if (this.camera.mode === "follow") {
      const followed = this.team.person(this.camera.node);
      if (isPlaced(followed)) {
        this.view = { ...this.view, x: followed.x_m, y: followed.y_m };
      }
    } else if (this.camera.mode === "fit") {
      const points = this.points();
      const fitted = fit(this.view, points, { most: 60 * this.unit });
      const aimed = { ...this.view, ...this.goal };
      if (points.length && (this.refit || isLoose(aimed, fitted, points))) {
        this.goal = { x: fitted.x, y: fitted.y, scale: fitted.scale };
      }
      return this.glide(now);
    }
    this.goal = null;
    this.refit = false;
    return false;
  }

  /** Go a step towards where an automatic view is to be; whether it is still on its way. */
  glide(now) {
    const goal = this.goal;
    const jump = this.refit || this.still.matches;
    this.refit = false;
    if (!goal) return false;
    const share = jump ? 1 : 1 - Math.exp(-Math.min(now - this.glidedMs, 100) / GLIDE_MS);
    this.glidedMs = now;
    const { x, y, scale } = this.view;
    const off = Math.hypot(goal.x - x, goal.y - y) * scale + 1000 * Math.abs(Math.log(goal.scale / scale));
    if (off < 1 || jump) {
      this.view = { ...this.view, ...goal };
      return false;
    }
    this.view = {
      ...this.view,
      x: x + share * (goal.x - x),
      y: y + share * (goal.y - y),
      scale: scale * (goal.scale / scale) ** share,
    };
    return true;
  }

  // -- drawing -----------------------------------------------------------------------------------

  draw(now) {
    this.frames += 1;
    const gliding = this.aim(now);
    const { context, view, colours, ratio, unit } = this;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = colours.ground;
    context.fillRect(0, 0, view.width, view.height);
    this.drawGrid();
    this.ground?.drawPlan();
    const again = this.drawTracks();
    if (this.layers.smoothed) this.drawSmoothed();
    const { here, places, rings } = this.team.possible();
    const placed = this.team.list().filter(isPlaced);
    const people = placed.filter((p) => !this.floors || this.floors.isHere(p) || this.rank(p) >= 3);
    for (const place of places) this.drawGhost(place);
    for (const ring of rings) this.drawRing(ring, 1);
    const links = this.drawLinks();
    for (const person of placed) if (!people.includes(person)) this.floors.drawElsewhere(this, person);
    for (const person of people) this.drawEllipse(person);
    for (const person of people) this.drawReach(person);
    this.drawFind();
    this.ground?.drawMarkers();
    // Who is in trouble is drawn last, on top.
    const ordered = [...people].sort((a, b) => this.rank(a) - this.rank(b));
    for (const person of ordered) this.drawMarker(person, now);
    this.drawLabels(ordered.reverse(), links, places, here, rings);
    this.drawScale();
    this.drawNorth();
    this.floors?.drawSection(this);
    if (gliding) this.invalidate();
    else if (again) setTimeout(() => this.invalidate(), 160);
    const pulsing = !this.old && [...this.alarms.values()].some((a) => !a.acknowledged) && !this.still.matches;
    if (pulsing && !this.pulse) {
      this.pulse = setTimeout(() => {
        this.pulse = null;
        this.invalidate();
      }, PULSE_STEP_MS);
    }
    document.dispatchEvent(new CustomEvent("relpos:drawn", {
      detail: { seq: this.team.seq, unixMs: Date.now() },
    }));
  }

  rank(person) {
    if (this.alarms.has(person.node)) return 4;
    if (this.find && (person.node === this.find.from || person.node === this.find.to)) return 3;
    if (person.node === this.selected) return 2;
    return person.node === this.me ? 1 : 0;
  }

  drawGrid() {
    const { context, view, colours, unit } = this;
    const step = gridStep(view.scale, 56 * unit);
    const corners = [[0, 0], [view.width, 0], [0, view.height], [view.width, view.height]]
      .map(([px, py]) => toMap(view, px, py));
    const [xs, ys] = [corners.map((c) => c[0]), corners.map((c) => c[1])];
    const [left, right] = [Math.min(...xs), Math.max(...xs)];
    const [low, high] = [Math.min(...ys), Math.max(...ys)];
    context.strokeStyle = colours.grid;
    context.lineWidth = 1;
    context.beginPath();
    for (let x = Math.ceil(left / step) * step; x <= right; x += step) {
      context.moveTo(...toScreen(view, x, low));
      context.lineTo(...toScreen(view, x, high));
    }
    for (let y = Math.ceil(low / step) * step; y <= high; y += step) {
      context.moveTo(...toScreen(view, left, y));
      context.lineTo(...toScreen(view, right, y));
    }
    context.stroke();
  }

  drawTracks() {
    if (this.layers.tracks === "off") return false;
    const { context, view, unit } = this;
    const tracks = this.team.order
      .map((node) => [node, this.team.tracks.get(node), this.colourOf(node)])
      .filter(([, track]) => track);
    let again = false;
    if (this.layers.tracks === "all") {
      context.globalAlpha = this.team.order.length > 8 ? 0.28 : 0.4;
      const points = tracks.reduce((sum, [, track]) => sum + track.points.length, 0);
      if (points < DIRECT_POINTS) {
        context.lineWidth = 1.5 * unit;
        for (const [, track, colour] of tracks) {
          this.pathTrack(track, 0);
          context.strokeStyle = colour;
          context.stroke();
        }
      } else {
        again = this.layer.draw(context, view, this.ratio, tracks, 1.5 * unit);
      }
      context.globalAlpha = 1;
    }
    // The newest part of a track stands out: it shows the last direction of motion.
    const tailS = this.layers.tracks === "all" ? TAIL_S : MINUTE_S;
    context.lineWidth = 3 * unit;
    context.lineCap = "round";
    context.lineJoin = "round";
    context.globalAlpha = 0.8;
    for (const [node, track, colour] of tracks) {
      const person = this.team.person(node);
      const first = track.since((this.team.timeS ?? 0) - tailS);
      if (first >= track.points.length) continue;
      context.strokeStyle = colour;
      this.pathTrack(track, first);
      if (isPlaced(person) && person.status === "ok") {
        context.lineTo(...toScreen(view, person.x_m, person.y_m));
      }
      context.stroke();
    }
    context.globalAlpha = 1;
    return again;
  }

  /** What the whole recording says of the ways so far: dashed beside the live ones. */
  drawSmoothed() {
    const { context, unit } = this;
    const nowS = this.team.timeS ?? 0;
    const fromS = this.layers.tracks === "all" ? -Infinity : nowS - MINUTE_S;
    if (this.layers.tracks === "off") return;
    context.lineWidth = 2 * unit;
    context.setLineDash([7 * unit, 5 * unit]);
    for (const [node, track] of this.team.smoothed) {
      this.pathTrack(track, track.since(fromS), track.since(nowS));
      context.strokeStyle = this.colourOf(node);
      context.stroke();
    }
    context.setLineDash([]);
  }

  /** The track from its point `first` on as the current path. */
  pathTrack(track, first, end = track.points.length) {
    const { context, view } = this;
    context.beginPath();
    for (let k = first; k < end; k += 1) {
      const [, x, y, starts] = track.points[k];
      const [px, py] = toScreen(view, x, y);
      if (k === first || starts) context.moveTo(px, py);
      else context.lineTo(px, py);
    }
  }

  /** An alternative position of a person. */
  drawGhost(place) {
    const { context, view, unit } = this;
    if (place.shape === "ring") {
      this.drawRing(place, 0.5);
      return;
    }
    const [px, py] = toScreen(view, place.x_m, place.y_m);
    context.globalAlpha = Math.min(0.95, 0.6 + 0.5 * place.probability);
    context.strokeStyle = this.colourOf(place.node);
    context.setLineDash([4 * unit, 3 * unit]);
    context.lineWidth = 1.5 * unit;
    this.pathEllipse(place);
    context.stroke();
    context.beginPath();
    context.arc(px, py, 9 * unit, 0, 2 * Math.PI);
    context.fillStyle = this.colours.ground;
    context.fill();
    context.lineWidth = 2 * unit;
    context.stroke();
    context.setLineDash([]);
    context.fillStyle = this.colours.ink;
    context.font = this.font(11, true);
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillText(signOf(this.team.person(place.node) ?? place), px, py + 0.5 * unit);
    context.globalAlpha = 1;
  }

  /** Somebody who is anywhere on a circle: radius sigma_major_m, width sigma_minor_m. */
  drawRing(ring, strength) {
    const { context, view, unit } = this;
    const [px, py] = toScreen(view, ring.x_m, ring.y_m);
    const radius = ring.sigma_major_m * view.scale;
    context.strokeStyle = this.colourOf(ring.node);
    context.globalAlpha = 0.22 * strength;
    context.lineWidth = Math.max(2 * ELLIPSE_SIGMAS * ring.sigma_minor_m * view.scale, 6 * unit);
    context.beginPath();
    context.arc(px, py, radius, 0, 2 * Math.PI);
    context.stroke();
    context.globalAlpha = strength;
    context.lineWidth = 2 * unit;
    context.setLineDash([8 * unit, 5 * unit]);
    context.stroke();
    context.setLineDash([]);
    context.globalAlpha = 1;
  }

  /** Lines of measured ranges; returns what their labels would like to be. */
  drawLinks() {
    const { context, view, colours, unit } = this;
    if (this.layers.ranges === "off") return [];
    const mine = this.find?.from ?? this.selected ?? this.me;
    const few = this.layers.ranges === "all" ||
      (this.layers.ranges === "auto" && this.team.order.length <= MANY);
    const labels = [];
    for (const [node, peer, rangeM, ageS] of this.team.ranges) {
      const [a, b] = [this.team.person(node), this.team.person(peer)];
      if (!isPlaced(a) || !isPlaced(b)) continue;
      const own = node === mine || peer === mine;
      if (!few && !own) continue;
      const [ax, ay] = toScreen(view, a.x_m, a.y_m);
      const [bx, by] = toScreen(view, b.x_m, b.y_m);
      context.strokeStyle = colours.link;
      context.lineWidth = (own ? 1.6 : 1) * unit;
      context.globalAlpha = Math.max(0.15, (own ? 0.9 : 0.5) * (1 - ageS / 12));
      context.beginPath();
      context.moveTo(ax, ay);
      context.lineTo(bx, by);
      context.stroke();
      const length = Math.hypot(bx - ax, by - ay);
      if (length < 70 * unit) continue;
      const text = number(rangeM, 1);
      const [width, height] = [this.width(text, 11, false) + 4 * unit, 13 * unit];
      const places = [0.5, 0.38, 0.62, 0.28, 0.72].map((t) => [
        ax + t * (bx - ax) - width / 2, ay + t * (by - ay) - height / 2, width, height,
      ]);
      labels.push({ id: `${node}-${peer}`, text, places, own, ageS });
    }
    context.globalAlpha = 1;
    return labels.sort((p, q) => Number(q.own) - Number(p.own) || p.ageS - q.ageS);
  }

  pathEllipse(p) {
    const { context, view } = this;
    const [px, py] = toScreen(view, p.x_m, p.y_m);
    context.beginPath();
    context.ellipse(
      px, py,
      ELLIPSE_SIGMAS * (p.sigma_major_m ?? 0) * view.scale,
      ELLIPSE_SIGMAS * (p.sigma_minor_m ?? 0) * view.scale,
      -((p.sigma_angle_rad ?? 0) + view.rotation), 0, 2 * Math.PI,
    );
  }

  drawEllipse(person) {
    const { context, unit } = this;
    const colour = this.colourOf(person.node);
    this.pathEllipse(person);
    const gone = !isFresh(person);
    if (!gone) {
      context.fillStyle = colour;
      context.globalAlpha = this.dark ? 0.2 : 0.13;
      context.fill();
    }
    context.globalAlpha = gone ? 0.6 : 0.75;
    context.strokeStyle = colour;
    context.lineWidth = 1.25 * unit;
    // The position is unknown by now: an outline, no area that hides the others.
    if (gone) context.setLineDash([3 * unit, 5 * unit]);
    context.stroke();
    context.setLineDash([]);
    context.globalAlpha = 1;
  }

  /** Where somebody who is not heard may be by now: as far from the last place as people walk. */
  drawReach(person) {
    const radius = (reachM(person) + (person.sigma_major_m ?? 0)) * this.view.scale;
    if (isFresh(person) || radius < 16 * this.unit) return;
    const { context, unit } = this;
    const [px, py] = toScreen(this.view, person.x_m, person.y_m);
    context.strokeStyle = this.colourOf(person.node);
    context.globalAlpha = 0.8;
    context.lineWidth = 1.5 * unit;
    context.setLineDash([2 * unit, 6 * unit]);
    context.beginPath();
    context.arc(px, py, radius, 0, 2 * Math.PI);
    context.stroke();
    context.setLineDash([]);
    context.globalAlpha = 1;
  }

  drawFind() {
    if (!this.find) return;
    const [a, b] = [this.team.person(this.find.from), this.team.person(this.find.to)];
    if (!isPlaced(a) || !isPlaced(b)) return;
    const { context, view, colours, unit } = this;
    context.strokeStyle = colours.accent;
    context.lineWidth = 4 * unit;
    context.setLineDash([12 * unit, 7 * unit]);
    context.beginPath();
    context.moveTo(...toScreen(view, a.x_m, a.y_m));
    context.lineTo(...toScreen(view, b.x_m, b.y_m));
    context.stroke();
    context.setLineDash([]);
  }

  drawMarker(person, now) {
    const { context, view, colours, unit } = this;
    const [px, py] = toScreen(view, person.x_m, person.y_m);
    const colour = this.colourOf(person.node);
    const radius = 11 * unit;
    const gone = !isFresh(person);
    const alarm = this.alarms.get(person.node);
    if (alarm) {
      const swing = this.old || this.still.matches || alarm.acknowledged || alarm.level === "low"
        ? 0.5 : 0.5 - 0.5 * Math.cos((2 * Math.PI * (now % PULSE_MS)) / PULSE_MS);
      context.strokeStyle = alarm.level === "high" ? colours.alarm : colours.warning;
      context.lineWidth = (this.old || alarm.acknowledged ? 3 : 5) * unit;
      context.beginPath();
      context.arc(px, py, radius + (6 + 8 * swing) * unit, 0, 2 * Math.PI);
      context.stroke();
    }
    if (person.node === this.selected || person.node === this.me) {
      context.strokeStyle = person.node === this.selected ? colours.accent : colours.ink;
      context.lineWidth = 2 * unit;
      context.beginPath();
      context.arc(px, py, radius + 4 * unit, 0, 2 * Math.PI);
      context.stroke();
    }
    const known = Number.isFinite(person.heading_rad) &&
      (person.sigma_heading_rad ?? 0) < VAGUE_RAD;
    if (known && !gone && !person.post) this.drawHeading(person, px, py, radius, colour);
    pathMarker(context, person, px, py, radius);
    context.fillStyle = gone ? colours.ground : colour;
    context.fill();
    context.strokeStyle = gone ? colour : colours.ground;
    context.lineWidth = (gone ? 2.5 : 1.5) * unit;
    if (gone) context.setLineDash([4 * unit, 3 * unit]);
    context.stroke();
    context.setLineDash([]);
    context.fillStyle = gone ? colours.ink : inkOn(colour);
    context.font = this.font(signOf(person).length > 2 ? 9.5 : 12, true);
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillText(signOf(person), px, py + 0.5 * unit);
    // The sign is the node's; whether a silent one works nobody knows.
    if (!gone && (person.health === "yellow" || person.health === "red")) {
      this.drawSign(person.health, px + 0.95 * radius, py - 0.95 * radius, 6.5 * unit);
    }
  }

  drawHeading(person, px, py, radius, colour) {
    const { context, view, colours, unit } = this;
    // Screen angles run clockwise.
    const angle = -(person.heading_rad + view.rotation);
    const sigma = person.sigma_heading_rad ?? 0;
    if (sigma > 0.1) {
      context.fillStyle = colour;
      context.globalAlpha = 0.22;
      context.beginPath();
      context.moveTo(px, py);
      context.arc(px, py, radius + 18 * unit, angle - sigma, angle + sigma);
      context.fill();
      context.globalAlpha = 1;
    }
    const tip = radius + 11 * unit;
    const at = (r, a) => [px + r * Math.cos(a), py + r * Math.sin(a)];
    context.beginPath();
    context.moveTo(...at(tip, angle));
    context.lineTo(...at(radius, angle - 0.62));
    context.lineTo(...at(radius, angle + 0.62));
    context.closePath();
    context.fillStyle = colour;
    context.fill();
    context.strokeStyle = colours.ground;
    context.lineWidth = unit;
    context.stroke();
  }

  drawSign(health, px, py, size) {
    const { context, colours } = this;
    context.beginPath();
    if (health === "yellow") {
      context.moveTo(px, py - size);
      context.lineTo(px + size, py + 0.8 * size);
      context.lineTo(px - size, py + 0.8 * size);
    } else {
      for (let k = 0; k < 8; k += 1) {
        const a = ((k + 0.5) * Math.PI) / 4;
        context.lineTo(px + size * Math.cos(a), py + size * Math.sin(a));
      }
    }
    context.closePath();
    context.fillStyle = health === "yellow" ? colours.yellow : colours.red;
    context.fill();
    context.strokeStyle = colours.ground;
    context.lineWidth = 1.5;
    context.lineJoin = "round";
    context.stroke();
    context.fillStyle = health === "yellow" ? "#000" : colours.signInk;
    context.font = this.font(8.5, true);
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillText("!", px, py + size * 0.12);
  }

  stateOf(person, here) {
    const alarm = this.alarms.get(person.node);
    if (alarm?.kind === "fall") return t("state.fell");
    if (alarm?.kind === "post") return t("map.stale", { time: seconds(person.seen_s) });
    if (alarm) return alarm.kind === "lost"
      ? t("map.lost", { time: seconds(person.seen_s) })
      : isFresh(person) ? t("map.still", { time: seconds(person.still_s) }) : t("map.was-still", { time: seconds(person.seen_s) });
    if (person.status === "lost" || person.status === "stale") return t(`map.${person.status}`, { time: seconds(person.seen_s) });
    if (person.status === "ambiguous") return probabilityHere(here.get(person.node));
    return "";
  }

  drawLabels(people, links, places, here, rings) {
    const { context, view, colours, unit } = this;
    const items = people.map((person) => {
      const [x, y] = toScreen(view, person.x_m, person.y_m);
      const name = shorten(person.node === this.me ? `${person.name} (me)` : person.name, 18);
      const state = this.stateOf(person, here);
      const width = Math.max(this.width(name, 13.5, true), this.width(state, 12, true)) + 4 * unit;
      return {
        id: person.node, x, y, radius: 15 * unit, width, height: (state ? 32 : 18) * unit,
        name, state, person,
      };
    }).filter(({ x, y }) => x > -20 && y > -20 && x < view.width + 20 && y < view.height + 20);
    const bounds = [view.width, view.height];
    const taken = this.furniture();
    const placed = placeLabels(items, bounds, this.labelPlaces, taken);
    this.labelPlaces = new Map([...placed].map(([id, place]) => [id, place.candidate]));
    const boxes = [...taken];
    for (const item of items) {
      const { box, far } = placed.get(item.id);
      boxes.push(box, [item.x - item.radius, item.y - item.radius, 2 * item.radius, 2 * item.radius]);
      if (far) this.drawLeader(item, box);
    }
    context.textAlign = "left";
    context.textBaseline = "top";
    for (const item of items) {
      const { box } = placed.get(item.id);
      const [x, y] = [box[0] + 2 * unit, box[1] + 2 * unit];
      this.write(item.name, x, y, 13.5, true, colours.ink);
      if (item.state) {
        const level = this.alarms.get(item.id)?.level;
        const colour = level === "high" ? colours.alarm : colours.ink;
        this.write(item.state, x, y + 14.5 * unit, 12, true, colour);
      }
    }
    // Probabilities of ghosts, then ranges, where there is room.
    const wanted = [];
    for (const place of places) {
      if (place.shape === "ring") continue;
      const [x, y] = toScreen(view, place.x_m, place.y_m);
      const name = this.team.person(place.node)?.name ?? nodeName(place.node);
      const text = `${shorten(name, 12)} ${probability(place.probability)}?`;
      const [w, h] = [this.width(text, 12, true) + 4 * unit, 15 * unit];
      const gap = 12 * unit;
      wanted.push({
        id: `place ${place.node} ${place.x_m} ${place.y_m}`, text, size: 12, bold: true,
        places: [
          [x + gap, y - h / 2, w, h], [x - gap - w, y - h / 2, w, h],
          [x - w / 2, y - gap - h, w, h], [x - w / 2, y + gap, w, h],
        ],
      });
      boxes.push([x - 9 * unit, y - 9 * unit, 18 * unit, 18 * unit]);
    }
    for (const ring of rings) {
      const person = this.team.person(ring.node);
      const [x, y] = toScreen(view, ring.x_m, ring.y_m);
      const text = t("map.ring", { name: person?.name ?? nodeName(ring.node) });
      const [w, h] = [this.width(text, 13, true) + 4 * unit, 17 * unit];
      const r = ring.sigma_major_m * view.scale;
      wanted.push({
        id: `ring ${ring.node}`, text, size: 13, bold: true,
        places: [
          [x - w / 2, y - r - h - 4 * unit, w, h], [x - w / 2, y + r + 4 * unit, w, h],
          [x + r + 6 * unit, y - h / 2, w, h], [x - r - w - 6 * unit, y - h / 2, w, h],
        ],
      });
    }
    const found = placeWhereFree([...wanted, ...links], bounds, boxes);
    for (const { id, text, size = 11, bold = false } of [...wanted, ...links]) {
      const box = found.get(id);
      if (!box) continue;
      this.write(text, box[0] + 2 * unit, box[1] + unit, size, bold, bold ? colours.ink : colours.soft);
    }
  }

  /** What lies on the map and must not be covered: buttons, scale bar, north arrow. */
  furniture() {
    const { view, unit } = this;
    const boxes = [
      [0, view.height - 40 * unit, 160 * unit, 40 * unit],
      [view.width - 60 * unit, 0, 60 * unit, 76 * unit],
    ];
    const own = this.canvas.getBoundingClientRect();
    for (const element of this.covers ?? []) {
      const box = element.getBoundingClientRect();
      if (box.width) boxes.push([box.left - own.left, box.top - own.top, box.width, box.height]);
    }
    return boxes;
  }

  drawLeader(item, box) {
    const { context, colours, unit } = this;
    const nearestX = Math.min(Math.max(item.x, box[0]), box[0] + box[2]);
    const nearestY = Math.min(Math.max(item.y, box[1]), box[1] + box[3]);
    context.strokeStyle = colours.soft;
    context.lineWidth = unit;
    context.beginPath();
    context.moveTo(item.x, item.y);
    context.lineTo(nearestX, nearestY);
    context.stroke();
  }

  write(text, x, y, size, bold, colour) {
    const { context, colours, unit } = this;
    context.font = this.font(size, bold);
    context.textAlign = "left";
    context.textBaseline = "top";
    context.lineJoin = "round";
    context.lineWidth = 3.5 * unit;
    context.strokeStyle = colours.ground;
    context.strokeText(text, x, y);
    context.fillStyle = colour;
    context.fillText(text, x, y);
  }

  font(size, bold) {
    return `${bold ? "600 " : ""}${size * this.unit}px system-ui, "DejaVu Sans", sans-serif`;
  }

  width(text, size, bold) {
    const key = `${size}${bold ? "b" : ""}${text}`;
    let width = this.widths.get(key);
    if (width === undefined) {
      if (this.widths.size > 2000) this.widths.clear();
      this.context.font = this.font(size, bold);
      width = this.context.measureText(text).width;
      this.widths.set(key, width);
    }
    return width;
  }

  drawScale() {
    const { context, view, colours, unit } = this;
    const { metres, pixels } = scaleBar(view.scale, 120 * unit);
    const [x, y] = [14 * unit, view.height - 14 * unit];
    for (const [colour, width] of [[colours.ground, 6], [colours.ink, 2.5]]) {
      context.strokeStyle = colour;
      context.lineWidth = width * unit;
      context.lineCap = "butt";
      context.beginPath();
      context.moveTo(x, y - 6 * unit);
      context.lineTo(x, y);
      context.lineTo(x + pixels, y);
      context.lineTo(x + pixels, y - 6 * unit);
      context.stroke();
    }
    const text = metres < 1 ? `${number(metres * 100)} cm` : `${number(metres)} m`;
    this.write(text, x + 5 * unit, y - 19 * unit, 13, true, colours.ink);
    this.scaleText = text;
  }

  drawNorth() {
    const { context, view, colours, unit } = this;
    const [x, y] = [view.width - 30 * unit, 34 * unit];
    context.save();
    context.translate(x, y);
    const northRad = this.team.northRad ?? Math.PI / 2;
    context.rotate(headingUp(northRad) - view.rotation);
    context.beginPath();
    context.moveTo(0, -20 * unit);
    context.lineTo(8 * unit, 8 * unit);
    context.lineTo(0, 3 * unit);
    context.lineTo(-8 * unit, 8 * unit);
    context.closePath();
    context.fillStyle = colours.ink;
    context.strokeStyle = colours.ground;
    context.lineWidth = 2 * unit;
    context.stroke();
    context.fill();
    context.restore();
    const text = this.team.northRad === null ? t("compass.map", { point: t("compass.n") }) : t("compass.n");
    this.write(text, x - this.width(text, 12, true) / 2, y + 22 * unit, 12, true, colours.ink);
  }

  // -- hands -------------------------------------------------------------------------------------

  listen() {
    const { canvas } = this;
    const fingers = new Map();
    let moved = 0;
    const at = (event) => {
      const box = canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, at(event));
      if (fingers.size === 1) moved = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const now = at(event);
      if (fingers.size === 1) {
        const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
        moved += Math.hypot(dx, dy);
        // A glove's touch trembles.
        if (moved > 6) this.drag(dx, dy);
      } else if (fingers.size === 2) {
        const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
        const middle = (p) => [(p[0] + other[0]) / 2, (p[1] + other[1]) / 2];
        const span = (p) => Math.max(10, Math.hypot(p[0] - other[0], p[1] - other[1]));
        const [from, to] = [middle(before), middle(now)];
        moved = 100;
        if (this.camera.mode !== "follow") this.drag(to[0] - from[0], to[1] - from[1]);
        this.zoom(span(now) / span(before), to[0], to[1]);
      }
      fingers.set(event.pointerId, now);
    });
    const lift = (event) => {
      if (event.type === "pointerup" && fingers.size === 1 && moved <= 6) this.pick(...at(event));
      fingers.delete(event.pointerId);
    };
    canvas.addEventListener("pointerup", lift);
    canvas.addEventListener("pointercancel", lift);
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 33 : event.deltaMode === 2 ? 400 : 1;
      // Pinching on a touchpad comes as small steps with the control key.
      const strength = event.ctrlKey ? 0.01 : 0.0016;
      this.zoom(Math.exp(-event.deltaY * lines * strength), ...at(event));
    }, { passive: false });
    canvas.addEventListener("dblclick", (event) => this.zoom(2, ...at(event)));
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = (event.shiftKey ? 160 : 48) * this.unit;
    const actions = {
      ArrowLeft: () => this.drag(step, 0),
      ArrowRight: () => this.drag(-step, 0),
      ArrowUp: () => this.drag(0, step),
      ArrowDown: () => this.drag(0, -step),
      "+": () => this.zoom(1.3),
      "=": () => this.zoom(1.3),
      "-": () => this.zoom(1 / 1.3),
      "0": () => this.setCamera("fit"),
      h: () => this.setUp(this.up === "north" ? "heading" : "north"),
      n: () => this.step(1),
      p: () => this.step(-1),
      f: () => this.followSelected(),
      Escape: () => this.setCamera("free"),
    };
    const action = actions[event.key];
    if (!action) return;
    event.preventDefault();
    action();
  }

  step(by) {
    const order = this.team.order;
    if (order.length === 0) return;
    const at = order.indexOf(this.selected);
    this.onPick(order[(at + by + order.length + (at < 0 && by < 0 ? 1 : 0)) % order.length]);
  }

  followSelected() {
    if (this.selected === null) return;
    if (this.camera.mode === "follow" && this.camera.node === this.selected) this.setCamera("free");
    else this.setCamera("follow", this.selected);
  }

  pick(px, py) {
    if (this.onPlace) {
      this.onPlace(...toMap(this.view, px, py));
      return;
    }
    let [best, least] = [null, 26 * this.unit];
    for (const person of this.team.list().filter(isPlaced)) {
      const [x, y] = toScreen(this.view, person.x_m, person.y_m);
      const off = Math.hypot(px - x, py - y);
      if (off < least) [best, least] = [person.node, off];
    }
    this.onPick(best);
  }

  /** What the map shows, in a sentence. */
  describe() {
    const people = this.team.wearers();
    const placed = people.filter(isPlaced);
    const located = placed.filter(isFresh);
    const parts = [t("map.located", { located: located.length, count: people.length })];
    if (placed.length > located.length) {
      parts.push(t("map.last", { names: placed.filter((p) => !isFresh(p)).map((p) => p.name).join(", ") }));
    }
    if (this.camera.mode === "follow") {
      parts.push(t("map.following", { name: this.team.person(this.camera.node)?.name ?? nodeName(this.camera.node) }));
    }
    parts.push(this.up === "heading" ? t("map.heading-up", { name: this.headingPerson()?.name ?? "" })
      : this.team.northRad === null ? t("map.north-up") : t("map.magnetic-up", { sigma: plusMinusDegrees(this.team.sigmaNorthRad) }));
    const signs = this.ground?.shown ?? [];
    if (signs.length) parts.push(t("map.markers", { names: signs.map(({ sign }) => t(`marker.${sign}`)).join(", ") }));
    parts.push(t("map.across", { distance: distance(this.view.width / this.view.scale, 1) }));
    return `${parts.join(", ")}.`;
  }
}

function around(ring) {
  const r = ring.sigma_major_m + 2 * ring.sigma_minor_m;
  return [[ring.x_m - r, ring.y_m], [ring.x_m + r, ring.y_m], [ring.x_m, ring.y_m - r], [ring.x_m, ring.y_m + r]];
}

function shorten(text, most) {
  return text.length > most ? `${text.slice(0, most - 1)}…` : text;
}
