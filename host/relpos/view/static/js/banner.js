// The top of the page: alarms of people, notices of the session.

import { make, setAttribute, setText } from "./dom.js";
import { alarmText } from "./words.js";

const MAX_ROWS = 4;

/**
 * One row an alarm, the same element while it lasts, so that its button stays under the finger; at
 * most four, the worst ones. The others, and the acknowledged ones, share a line each.
 */
export class AlarmBanner {
  constructor(section, { acknowledge, show }) {
    this.section = section;
    this.acknowledge = acknowledge;
    this.show = show;
    this.rows = new Map();
    this.list = make("div", { class: "rows" });
    this.more = make("p", { class: "alarm more", "data-level": "warning", "data-acknowledged": "false" });
    this.moreText = make("span", { class: "text" });
    this.all = make("button", { type: "button", text: "Acknowledge all" });
    this.all.addEventListener("click", () => {
      for (const node of this.open) acknowledge(node);
    });
    this.more.append(this.moreText, make("span", { class: "buttons" }, this.all));
    this.known = make("p", { class: "alarm known", "data-acknowledged": "true" });
    this.known.append(make("span", { class: "kind", text: "known" }));
    this.knownText = make("span", { class: "text" });
    this.known.append(this.knownText);
    this.open = [];
    section.replaceChildren(this.list, this.more, this.known);
  }

  update(alarms) {
    const list = alarms.list();
    const open = list.filter((alarm) => !alarm.acknowledged);
    const known = list.filter((alarm) => alarm.acknowledged);
    this.open = open.map((alarm) => alarm.node);
    const shown = open.slice(0, MAX_ROWS);
    const others = open.slice(MAX_ROWS);
    for (const [node, row] of this.rows) {
      if (!shown.some((alarm) => alarm.node === node)) {
        row.element.remove();
        this.rows.delete(node);
      }
    }
    for (const alarm of shown) {
      let row = this.rows.get(alarm.node);
      if (!row) {
        row = this.make(alarm.node);
        this.rows.set(alarm.node, row);
        this.list.append(row.element);
      }
      setAttribute(row.element, "data-level", alarm.level);
      setText(row.kind, alarm.level);
      setText(row.text, alarmText(alarm));
      setAttribute(row.button, "aria-label", `Acknowledge: ${alarm.name}`);
      setAttribute(row.find, "aria-label", `Find ${alarm.name}`);
    }
    this.more.hidden = open.length < 2;
    setAttribute(this.more, "data-level", others.some((a) => a.level === "alarm") ? "alarm" : "warning");
    setText(this.moreText, others.length ? `and ${others.length} more: ${others.map((a) => a.name).join(", ")}` : "");
    this.known.hidden = known.length === 0;
    setText(this.knownText, known.map(alarmText).join(" · "));
    this.section.hidden = list.length === 0;
  }

  make(node) {
    const kind = make("span", { class: "kind" });
    const text = make("span", { class: "text" });
    const button = make("button", { type: "button", text: "Acknowledge" });
    button.addEventListener("click", () => this.acknowledge(node));
    const find = make("button", { type: "button", text: "Find" });
    find.addEventListener("click", () => this.show(node));
    const element = make("div", { class: "alarm", "data-node": node, "data-acknowledged": "false" },
      kind, text, make("span", { class: "buttons" }, find, button));
    return { element, kind, text, button, find };
  }
}

const KINDS = { info: "Note", warning: "Warning", alarm: "Alarm" };

/** Warnings and alarms have a line each; notes share one, the newest first. */
export function showNotices(section, notices) {
  const key = JSON.stringify(notices.map((n) => [n.level, n.text]));
  if (section.dataset.shown === key) return;
  section.dataset.shown = key;
  const notes = notices.filter((notice) => notice.level === "info").map((notice) => notice.text);
  const lines = notices.filter((notice) => notice.level !== "info");
  if (notes.length) lines.push({ level: "info", text: notes.reverse().join(" · ") });
  section.replaceChildren(...lines.map((notice) => make("p", { "data-level": notice.level },
    make("span", { class: "kind", text: KINDS[notice.level] ?? notice.level }),
    make("span", { class: "text", text: notice.text }))));
}
