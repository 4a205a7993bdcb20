// The top of the page: alarms of people, warnings of the session.

import { make, setAttribute, setHidden, setText } from "./dom.js";
import { said, t } from "./i18n.js";
import { alarmText, levelWords, seconds } from "./words.js";

/** More rows than that, unless they are high, share one. */
const MAX_ROWS = 4;

/** One line an alarm, the same element while it lasts, so that its button stays under the finger. */
export class AlarmBanner {
  constructor(section, { acknowledge, show }) {
    this.section = section;
    this.acknowledge = acknowledge;
    this.show = show;
    this.rows = new Map();
    this.list = make("div", { class: "rows" });
    this.more = make("p", { class: "alarm more", "data-acknowledged": "false" });
    this.moreText = make("span", { class: "text" });
    this.all = make("button", { type: "button", "data-t": "acknowledge.all" });
    this.all.addEventListener("click", () => this.acknowledge(this.open));
    this.more.append(this.moreText, make("span", { class: "buttons" }, this.all));
    this.known = make("p", { class: "alarm known", "data-acknowledged": "true" });
    this.known.append(make("span", { class: "kind", "data-t": "known" }));
    this.knownText = make("span", { class: "text" });
    this.known.append(this.knownText);
    this.open = [];
    section.replaceChildren(this.list, this.more, this.known);
  }

  update(alarms) {
    const rows = alarms.rows();
    const known = alarms.list().filter((alarm) => alarm.acknowledged || alarm.shelvedS);
    this.open = rows.flatMap((row) => row.nodes);
    const shown = rows.filter((row, k) => k < MAX_ROWS || row.level === "high");
    const others = rows.slice(shown.length);
    const hidden = others.flatMap((row) => row.alarms).map((a) => a.name);
    for (const [key, row] of this.rows) {
      if (!shown.some((alarm) => alarm.key === key)) {
        row.element.remove();
        this.rows.delete(key);
      }
    }
    shown.forEach((alarm, place) => {
      let row = this.rows.get(alarm.key);
      if (!row) {
        row = this.make();
        this.rows.set(alarm.key, row);
      }
      // Moved only where it is out of place: moving takes the focus.
      if (this.list.children[place] !== row.element) this.list.insertBefore(row.element, this.list.children[place] ?? null);
      const name = alarm.alarms.map((a) => a.name).join(", ");
      row.nodes = alarm.nodes;
      setAttribute(row.element, "data-node", alarm.key);
      setAttribute(row.element, "data-level", alarm.level);
      setText(row.kind, levelWords(alarm.level));
      setText(row.text, alarmText(alarm));
      setAttribute(row.button, "aria-label", t("acknowledge.name", { name }));
      setAttribute(row.find, "aria-label", t("find.name", { name }));
      setHidden(row.find, alarm.nodes.length > 1);
    });
    setHidden(this.more, this.rows.size < 2 && !others.length);
    setAttribute(this.more, "data-level", rows[0]?.level ?? "low");
    setText(this.moreText, others.length
      ? t("alarms.more", { count: hidden.length, names: hidden.join(", ") })
      : t("alarms.open", { count: this.open.length }));
    setHidden(this.known, known.length === 0);
    setText(this.knownText, known.map(knownText).join(" · "));
    setHidden(this.section, !rows.length && !known.length);
  }

  make() {
    const row = { nodes: [] };
    row.kind = make("span", { class: "kind" });
    row.text = make("span", { class: "text" });
    row.button = make("button", { type: "button", "data-t": "acknowledge" });
    row.button.addEventListener("click", () => this.acknowledge(row.nodes));
    row.find = make("button", { type: "button", "data-t": "find" });
    row.find.addEventListener("click", () => this.show(row.nodes[0]));
    row.element = make("div", { class: "alarm", "data-acknowledged": "false" },
      row.kind, row.text, make("span", { class: "buttons" }, row.find, row.button));
    return row;
  }
}

function knownText(alarm) {
  const how = alarm.shelvedS ? t("known.shelved", { time: seconds(alarm.shelvedS) }) : alarm.by ? t("known.by", { name: alarm.by }) : t("known.seen");
  return `${alarmText(alarm)} (${how})`;
}

/** Warnings and alarms of the session have a line each; notes are in the log alone. */
export function showNotices(section, notices) {
  const lines = notices.filter((notice) => notice.level !== "info");
  const key = JSON.stringify(lines.map((n) => [n.level, n.text]));
  if (section.dataset.shown === key) return;
  section.dataset.shown = key;
  section.replaceChildren(...lines.map((notice) => make("p", { "data-level": notice.level },
    make("span", { class: "kind", text: t(`notice.${notice.level}`) }),
    make("span", { class: "text", text: notice.text }))));
}
