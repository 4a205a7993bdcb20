// The banner of a lost link, the same on both pages: it comes, counts and goes by itself.

import { LINK_LOST_S, moment, sinceS } from "./age.js";
import { make, setAttribute, setText } from "./dom.js";
import { t, timeOfDay } from "./i18n.js";
import { seconds } from "./words.js";

const SILENCE_S = 120;

export class LinkBanner {
  /** `onChange(lost)` is called when the link is lost, and when it is back. */
  constructor(section, voice, onChange) {
    this.section = section;
    this.voice = voice;
    this.onChange = onChange;
    this.lost = false;
    this.title = document.title;
    this.silencedAt = null;
    this.text = make("span", { class: "text" });
    this.button = make("button", { type: "button", "data-t": "link.silence" });
    this.button.addEventListener("click", () => {
      this.silencedAt = moment();
      this.onChange(this.lost);
    });
    section.replaceChildren(make("span", { class: "kind", "data-t": "link.lost" }), this.text, this.button);
    section.hidden = true;
  }

  get sounding() {
    return this.lost && !(this.silencedAt && sinceS(this.silencedAt) < SILENCE_S);
  }

  /** The page's title, before which a lost link is told. */
  setTitle(title) {
    this.title = title;
    document.title = this.lost ? `${t("link.title")} · ${title}` : title;
  }

  /** `lagS` since the last view, which is of `unixS`; null before the first. */
  update(lagS, unixS = null) {
    const lost = lagS !== null && lagS >= LINK_LOST_S;
    if (lost) {
      setText(this.text, t("link.text", { time: seconds(lagS), of: timeOfDay(1000 * unixS) }));
      this.button.hidden = !this.sounding;
    }
    if (lost === this.lost) return;
    this.lost = lost;
    this.silencedAt = null;
    this.section.hidden = !lost;
    setAttribute(document.documentElement, "data-link", lost ? "lost" : null);
    setText(this.voice, t(lost ? "link.lost.spoken" : "link.back.spoken"));
    this.setTitle(this.title);
    this.onChange(lost);
  }
}
