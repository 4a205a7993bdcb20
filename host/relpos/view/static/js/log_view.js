// The session's log: what happened, to whom, by whom, the newest first.

import { make, setText } from "./dom.js";
import { has, said, t, timeOfDay } from "./i18n.js";

const MOST = 5000;

export class LogView {
  constructor(list, { onNew }) {
    this.list = list;
    this.onNew = onNew;
    this.clear();
  }

  clear() {
    this.entries = [];
    this.seen = 0;
  }

  add(entries) {
    this.entries = [...this.entries, ...entries].slice(-MOST);
    this.onNew();
  }

  /** How many lines have come since the log was last looked at. */
  get unseen() {
    return this.entries.length - this.seen;
  }

  /** Show it, with the names that people have by now. */
  look(team) {
    this.seen = this.entries.length;
    this.list.replaceChildren(...this.entries.map((entry) => make("li", { "data-kind": entry.kind },
      make("time", { text: timeOfDay(1000 * entry.unix_s) }), make("span", { class: "kind", text: has(`log.${entry.kind}`) ? t(`log.${entry.kind}`) : entry.kind }),
      make("span", { text: entry.by ? t("log.by", { text: words(entry, team), name: entry.by }) : words(entry, team) }))).reverse());
    this.onNew();
  }
}

function words(entry, team) {
  const text = said(entry.said, entry.text);
  // Who was named keeps the number: else "Ben is Ben".
  return entry.kind === "name" ? text : team.withNames(text);
}

/** The button that opens the log, with the number of lines that nobody has looked at. */
export function showUnseen(button, count) {
  setText(button, count ? t("log.count", { count }) : t("log"));
}
