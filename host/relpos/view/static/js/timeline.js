// The time line of a recording that is played: play, pause, speed, any moment, the next event.

import { byId, make, postJson, setAttribute, setText } from "./dom.js";
import { said, t } from "./i18n.js";
import { duration } from "./words.js";

export class Timeline {
  constructor(say) {
    this.say = say;
    this.line = null;
    this.dragging = false;
    this.slider = byId("moment");
    this.smoothed = false;
    const post = (body) => postJson("/api/replay", body).catch((error) => say(t("replay.stuck", { error: error.message })));
    byId("play").addEventListener("click", () => post({ playing: !this.line.playing }));
    byId("event-before").addEventListener("click", () => post({ step: -1 }));
    byId("event-after").addEventListener("click", () => post({ step: 1 }));
    byId("speed").addEventListener("change", (event) => post({ speed: Number(event.target.value) }));
    this.slider.addEventListener("input", () => {
      this.dragging = true;
      setText(byId("moment-words"), duration(Number(this.slider.value) - this.line.from_s));
      // One request at a time: the newest wish counts.
      if (this.asking) return;
      this.asking = true;
      post({ at_s: Number(this.slider.value) }).finally(() => {
        this.asking = false;
      });
    });
    this.slider.addEventListener("change", () => {
      post({ at_s: Number(this.slider.value) }).finally(() => {
        this.dragging = false;
      });
    });
  }

  /** Another session, or the same once more: what was of the one before is gone. */
  clear() {
    this.line = null;
    this.dragging = false;
    this.ready(false);
    byId("timeline").hidden = true;
  }

  handle(line) {
    const ticks = this.line?.ticks?.length !== line.ticks.length;
    this.line = line;
    byId("timeline").hidden = false;
    setText(byId("play"), t(line.playing ? "replay.pause" : "replay.play"));
    setAttribute(this.slider, "min", line.from_s);
    setAttribute(this.slider, "max", line.to_s);
    byId("speed").value = String(line.speed);
    byId("event-before").disabled = byId("event-after").disabled = line.reading;
    byId("smoothed-field").hidden = !this.smoothed && !line.smoothing;
    setText(byId("smoothed-words"), t(this.smoothed ? "replay.smoothed" : "replay.smoothing"));
    if (!ticks) return;
    const span = Math.max(line.to_s - line.from_s, 1);
    byId("ticks").replaceChildren(...line.ticks.map(([atS, kind, text, key]) => {
      const tick = make("span", { class: "tick", "data-kind": kind, title: said(key, text) });
      tick.style.left = `${(100 * (atS - line.from_s)) / span}%`;
      return tick;
    }));
  }

  /** The smoothed tracks have come, or there are none. */
  ready(some) {
    this.smoothed = some;
    byId("smoothed").disabled = !some;
    if (this.line) this.handle({ ...this.line, smoothing: false });
  }

  show(timeS) {
    if (!this.line || this.dragging || timeS === null) return;
    this.slider.value = String(timeS);
    const words = t("replay.of", { at: duration(timeS - this.line.from_s), all: duration(this.line.to_s - this.line.from_s) });
    setText(byId("moment-words"), words);
    setAttribute(this.slider, "aria-valuetext", words);
  }
}
