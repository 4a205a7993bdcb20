// What is told above everything: alarms of people, notices of the session.

import { make, setAttribute, setText } from "./dom.js";
import { alarmText } from "./words.js";

/** One row an alarm, kept while it lasts, so that its button can be hit. */
export class AlarmBanner {
  constructor(section, { acknowledge, show }) {
    this.section = section;
    this.acknowledge = acknowledge;
    this.show = show;
    this.rows = new Map();
  }

  update(alarms) {
    const list = alarms.list();
    for (const [node, row] of this.rows) {
      if (!alarms.active.has(node)) {
        row.element.remove();
        this.rows.delete(node);
      }
    }
    for (const alarm of list) {
      let row = this.rows.get(alarm.node);
      if (!row) {
        row = this.make(alarm.node);
        this.rows.set(alarm.node, row);
        this.section.append(row.element);
      }
      setAttribute(row.element, "data-level", alarm.level);
      setAttribute(row.element, "data-acknowledged", String(alarm.acknowledged));
      setText(row.kind, alarm.level);
      setText(row.text, alarmText(alarm));
      row.button.hidden = alarm.acknowledged;
      setAttribute(row.button, "aria-label", `Acknowledge: ${alarm.name}`);
      setAttribute(row.find, "aria-label", `Find ${alarm.name}`);
    }
    this.section.hidden = list.length === 0;
  }

  make(node) {
    const kind = make("span", { class: "kind" });
    const text = make("span", { class: "text" });
    const button = make("button", { type: "button", text: "Acknowledge" });
    button.addEventListener("click", () => this.acknowledge(node));
    const element = make("div", { class: "alarm", "data-node": node }, kind, text);
    const find = make("button", { type: "button", text: "Find" });
    find.addEventListener("click", () => this.show(node));
    element.append(make("span", { class: "buttons" }, find, button));
    return { element, kind, text, button, find };
  }
}

const KINDS = { info: "Note", warning: "Warning", alarm: "Alarm" };

/** Warnings and alarms a line each; mere notes share one, the newest first. */
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
