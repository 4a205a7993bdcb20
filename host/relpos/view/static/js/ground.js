// What lies on the ground of the map: a plan, and markers; and the tools that put them there.

import { byId, make, postJson, refusal, setText } from "./dom.js";
import { t, timeOfDay } from "./i18n.js";
import { align, provisional, toPixel, toPlace } from "./plan.js";
import { randomId } from "./queue.js";
import { toScreen } from "./transform.js";
import { distance } from "./words.js";

export const SIGNS = { entrance: "⇥", exit: "⇤", hydrant: "H", hazard: "!", found: "✓" };
const COLOURS = { entrance: "#0b5d2a", exit: "#0b5d2a", hydrant: "#a11212", hazard: "#8a5a00", found: "#1b4f9c" };

export class Ground {
  /** `say(text)` tells what went wrong, `by()` is who acts. */
  constructor(map, team, { say, by }) {
    Object.assign(this, { map, team, say, by, markers: {}, plan: null, image: null, points: [], before: null });
    map.ground = this;
    byId("marker-place").addEventListener("click", () => this.ask("place.marker", (x, y) => this.mark(x, y)));
    byId("plan-file").addEventListener("change", (event) => this.upload(event.target));
    byId("plan-align").addEventListener("click", () => this.begin());
    byId("plan-remove").addEventListener("click", () => this.post("plan", { action: "remove" }));
    byId("map").addEventListener("keydown", (event) => {
      if (event.key === "Escape") this.stop();
      if (event.key === "Enter" && map.onPlace) map.onPlace(map.view.x, map.view.y);
    });
  }

  async post(kind, body) {
    try {
      await postJson(`/api/${kind}`, { ...body, by: this.by() });
    } catch (error) {
      this.say(t("sent.failed", { error: error.message }));
    }
  }

  // -- tools ---------------------------------------------------------------------------------------

  /** Ask for a place on the map: a click, or Enter for its middle; Escape leaves it. */
  ask(key, action) {
    setText(byId("ground-status"), t(key));
    byId("layers").open = false; // It lies over the map.
    this.map.canvas.classList.add("placing");
    this.map.onPlace = action;
    this.map.canvas.focus();
  }

  stop(words = "") {
    this.map.onPlace = null;
    this.map.canvas.classList.remove("placing");
    setText(byId("ground-status"), words);
  }

  mark(x, y) {
    this.stop();
    this.post("marker", { action: "set", id: randomId(), sign: byId("marker-sign").value, x_m: x, y_m: y });
  }

  async upload(input) {
    const [file] = input.files;
    if (!file) return;
    const answer = await fetch("/api/image", { method: "POST", body: file }).catch(() => null);
    input.value = "";
    if (!answer?.ok) this.say(t("sent.failed", { error: await refusal(answer) ?? t("server.silent") }));
  }

  /** Two points, each first on the plan and then on the map; a third one says how well it fits. */
  begin() {
    this.before = this.transform;
    this.map.setCamera("free");
    this.points = [];
    this.aligned = this.plan.image;
    this.pair();
  }

  pair() {
    const count = this.points.length + 1;
    this.ask(`plan.on-plan.${count}`, (px, py) => {
      const from = toPixel(this.before, px, py);
      this.ask(`plan.on-map.${count}`, (x, y) => this.paired([...from, x, y]));
    });
  }

  paired(point) {
    // Somebody has laid another plan there meanwhile, of other pixels.
    if (this.plan?.image !== this.aligned) return this.stop();
    this.points.push(point);
    const found = align(this.points);
    if (this.points.length === 2 && !found) {
      this.points = [];
      return this.stop(t("plan.one-point"));
    }
    if (this.points.length >= 2) this.post("plan", { action: "align", image: this.aligned, points: this.points });
    if (this.points.length === 3) return this.stop(t("plan.residual", { distance: distance(found.residualM) }));
    // The third one is clicked on the plan where two have put it.
    if (found) this.before = found;
    return this.pair();
  }

  // -- the board's news ----------------------------------------------------------------------------

  handle({ markers = {}, plan = null }) {
    this.markers = markers;
    if (plan?.image !== this.plan?.image) {
      this.image = null;
      if (plan) {
        const image = new Image();
        image.onload = () => {
          if (this.plan?.image !== plan.image) return; // A later one was quicker.
          this.image = image;
          this.default = provisional(this.map.view, image.width, image.height);
          byId("plan-align").disabled = false;
          this.map.invalidate();
        };
        image.src = `/api/image/${plan.image}`;
      }
    }
    this.plan = plan;
    byId("plan-align").disabled = !this.image;
    byId("plan-remove").disabled = !plan;
    const list = Object.entries(markers).map(([id, { sign, by, unix_s: unixS }]) => {
      const remove = make("button", { type: "button", "data-t": "marker.remove", "aria-label": t("marker.remove.of", { sign: t(`marker.${sign}`) }) });
      remove.addEventListener("click", () => this.post("marker", { action: "remove", id }));
      return make("li", {}, `${t(`marker.${sign}`)}, ${by || t("somebody")} ${timeOfDay(1000 * unixS)} `, remove);
    });
    byId("markers").replaceChildren(...list);
    this.map.invalidate();
  }

  get transform() {
    return align(this.plan?.points ?? []) ?? this.default ?? null;
  }

  /** Those that were there by the moment that is shown. */
  get shown() {
    const nowS = this.team.replayed ? (this.team.session.recorded_unix_s ?? 0) + (this.team.timeS ?? 0) : Infinity;
    return Object.values(this.markers).filter((marker) => marker.unix_s <= nowS);
  }

  // -- drawing -------------------------------------------------------------------------------------

  drawPlan() {
    const { context, view, ratio } = this.map;
    const { transform } = this;
    if (!this.image || !transform) return;
    const corner = toScreen(view, ...toPlace(transform, 0, 0));
    const right = toScreen(view, ...toPlace(transform, 1, 0));
    const down = toScreen(view, ...toPlace(transform, 0, 1));
    context.save();
    context.globalAlpha = this.plan.points.length < 2 ? 0.35 : 0.55;
    context.transform(right[0] - corner[0], right[1] - corner[1], down[0] - corner[0], down[1] - corner[1], ...corner);
    context.drawImage(this.image, 0, 0);
    context.restore();
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
  }

  drawMarkers() {
    const { context, view, unit } = this.map;
    for (const { sign, x_m: x, y_m: y } of this.shown) {
      const [px, py] = toScreen(view, x, y);
      const half = 10 * unit;
      context.fillStyle = COLOURS[sign] ?? "#444";
      context.strokeStyle = "#fff";
      context.lineWidth = 1.5 * unit;
      context.beginPath();
      context.rect(px - half, py - half, 2 * half, 2 * half);
      context.fill();
      context.stroke();
      context.fillStyle = "#fff";
      context.font = this.map.font(13, true);
      context.textAlign = "center";
      context.textBaseline = "middle";
      context.fillText(SIGNS[sign] ?? "?", px, py);
    }
    context.textAlign = "start";
    context.textBaseline = "alphabetic";
  }
}
