// The banner of a lost link, the same on both pages: it comes, counts and goes by itself.

import { LINK_LOST_S } from "./age.js";
import { make, setAttribute, setText } from "./dom.js";
import { t, timeOfDay } from "./i18n.js";
import { seconds } from "./words.js";

const SILENCE_MS = 120_000;

export class LinkBanner {
  /** `onChange(lost)` is called when the link is lost, and when it is back. */
  constructor(section, voice, onChange) {
    this.section = section;
    this.voice = voice;
    this.onChange = onChange;
    this.lost = false;
    this.silentUntilMs = 0;
    this.text = make("span", { class: "text" });
    this.button = make("button", { type: "button", "data-t": "link.silence" });
    this.button.addEventListener("click", () => {
      this.silentUntilMs = Date.now() + SILENCE_MS;
      this.onChange(this.lost);
    });
    section.replaceChildren(make("span", { class: "kind", "data-t": "link.lost" }), this.text, this.button);
    section.hidden = true;
  }

  get sounding() {
    return this.lost && Date.now() > this.silentUntilMs;
  }

  /** `lagS` since the last view, null before the first. */
  update(lagS, receivedMs) {
    const lost = lagS !== null && lagS >= LINK_LOST_S;
    if (lost) {
      setText(this.text, t("link.text", { time: seconds(lagS), of: timeOfDay(receivedMs) }));
      this.button.hidden = !this.sounding;
    }
    if (lost === this.lost) return;
    this.lost = lost;
    this.silentUntilMs = 0;
    this.section.hidden = !lost;
    setAttribute(document.documentElement, "data-link", lost ? "lost" : null);
    setText(this.voice, t(lost ? "link.lost.spoken" : "link.back.spoken"));
    if (lost) this.title = document.title;
    document.title = lost ? `${t("link.title")} · ${this.title}` : this.title ?? document.title;
    this.onChange(lost);
  }
}
