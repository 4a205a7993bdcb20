// The banner of a lost link, the same on both pages: it comes, counts and goes by itself.

import { LINK_LOST_S } from "./age.js";
import { make, setAttribute, setText } from "./dom.js";
import { seconds, timeOfDay } from "./words.js";

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
    this.button = make("button", { type: "button", text: "Silence for 2 min" });
    this.button.addEventListener("click", () => {
      this.silentUntilMs = Date.now() + SILENCE_MS;
      this.onChange(this.lost);
    });
    section.replaceChildren(make("span", { class: "kind", text: "No connection" }), this.text, this.button);
    section.hidden = true;
  }

  get sounding() {
    return this.lost && Date.now() > this.silentUntilMs;
  }

  /** `lagS` since the last view, null before the first. */
  update(lagS, receivedMs) {
    const lost = lagS !== null && lagS >= LINK_LOST_S;
    if (lost) {
      setText(this.text, `for ${seconds(lagS)}: all below is old, of ${timeOfDay(receivedMs)}. ` +
        "Positions are last places; alarms cannot arrive. It is tried again by itself.");
      this.button.hidden = !this.sounding;
    }
    if (lost === this.lost) return;
    this.lost = lost;
    this.silentUntilMs = 0;
    this.section.hidden = !lost;
    setAttribute(document.documentElement, "data-link", lost ? "lost" : null);
    setText(this.voice, lost ? "Connection lost: all values are old." : "Connection is back.");
    const title = document.title.replace(/^NO CONNECTION · /, "");
    document.title = lost ? `NO CONNECTION · ${title}` : title;
    this.onChange(lost);
  }
}
