// The accountability board: who is in, roll call, MAYDAY, evacuation. What people say, not what is measured.

import { byId, make, postJson, setAttribute, setText } from "./dom.js";
import { has, t, timeOfDay } from "./i18n.js";
import { ago, duration, seconds } from "./words.js";

const STATES = ["", "standby", "entered", "withdrawing", "out"];
const FIELDS = ["team", "sector", "task", "state", "air"];
const EARLY_S = 60;

export class BoardView {
  /** `by()` is who acts here, `say(text)` tells what went wrong. */
  constructor(team, { by, say, find }) {
    this.team = team;
    this.by = by;
    this.say = say;
    this.find = find;
    this.board = { people: {}, mayday: {}, roll_call: null, evacuation: null };
    this.rows = new Map();
    this.dialog = byId("board-dialog");
    byId("show-board").addEventListener("click", () => {
      // Beside what is on top: alarms and a lost link stay in view.
      this.dialog.show();
      this.update();
    });
    // On the body, too: the focus is there for a moment when the button that had it has gone.
    document.addEventListener("keydown", ({ key, target }) => {
      if (key === "Escape" && (target === document.body || this.dialog.contains(target))) this.dialog.close();
    });
    const all = (state) => Promise.all(team.wearers().map(({ node }) => this.post("board", { node, state })));
    byId("all-standby").addEventListener("click", () => all("standby"));
    byId("all-entered").addEventListener("click", () => all("entered"));
    byId("roll-start").addEventListener("click", () => this.post("rollcall", { action: "start", within_s: Number(byId("roll-minutes").value) * 60 }));
    byId("roll-end").addEventListener("click", () => this.post("rollcall", { action: "end" }));
    hold(byId("evacuate-all"), () => this.post("evacuate", { action: "order" }));
    hold(byId("evacuate-team"), () => this.post("evacuate", { action: "order", nodes: this.ofTeam(byId("board-team").value) }));
    byId("evacuate-end").addEventListener("click", () => this.post("evacuate", { action: "end" }));
  }

  handle(board) {
    this.board = board;
    this.update();
  }

  ofTeam(name) {
    return this.team.wearers().map(({ node }) => node).filter((node) => (this.board.people?.[node]?.team ?? "") === name);
  }

  /** Never rejected. */
  async post(kind, body) {
    try {
      await postJson(`/api/${kind}`, { ...body, by: this.by() });
    } catch (error) {
      this.say(t("board.failed", { error: error.message }));
    }
  }

  /** Call MAYDAY for a person. */
  mayday(node, on) {
    this.post("mayday", { node, on });
    if (on) this.find(node);
  }

  update(nowMs = this.team.nowMs) {
    this.showRollCall(nowMs);
    this.showEvacuation();
    const { people = {}, evacuation, roll_call: call } = this.board;
    const inside = this.team.wearers().filter(({ node }) => ["entered", "withdrawing"].includes(people[node]?.state));
    setText(byId("show-board"), inside.length ? t("board.in", { count: inside.length }) : t("board"));
    if (!this.dialog.open) return;
    const teams = [...new Set(Object.values(people).map((place) => place.team).filter(Boolean))].sort();
    const select = byId("board-team");
    if (select.dataset.shown !== teams.join()) {
      select.dataset.shown = teams.join();
      select.replaceChildren(...teams.map((name) => make("option", { value: name, text: name })));
    }
    for (const [node, row] of this.rows) {
      if (this.team.person(node)) continue;
      row.element.remove();
      this.rows.delete(node);
    }
    byId("evacuate-team").disabled = select.disabled = !teams.length;
    for (const person of this.team.wearers()) {
      const row = this.rows.get(person.node) ?? this.make(person.node);
      const place = people[person.node] ?? {};
      setText(row.name, person.name);
      setAttribute(row.element, "data-state", place.state ?? "");
      for (const name of FIELDS) {
        setAttribute(row[name], "aria-label", t(`board.${name}.of`, { node: person.node }));
        row[name].disabled = document.documentElement.dataset.role === "look";
        const value = name === "air" ? place.air_bar ?? "" : place[name] ?? "";
        if (!row.edited.has(row[name]) && row[name].value !== String(value)) row[name].value = value;
      }
      setText(row.time, Number.isFinite(place.entered_unix_s)
        ? `${timeOfDay(1000 * place.entered_unix_s)}, ${duration(nowMs / 1000 - place.entered_unix_s)}` : "–");
      setText(row.contact, ago(person.seen_s));
      setText(row.airAge, Number.isFinite(place.air_unix_s) ? t("board.air.entered", { time: timeOfDay(1000 * place.air_unix_s) }) : "");
      const answer = call?.answers?.[person.node];
      const called = call && call.ended_unix_s === null && call.nodes.includes(person.node);
      row.here.hidden = row.missing.hidden = !called;
      setAttribute(row.here, "aria-pressed", String(answer?.answer === "confirmed"));
      setAttribute(row.missing, "aria-pressed", String(answer?.answer === "missing"));
      setText(row.answer, answer ? t(`roll.${answer.answer}.by`, { name: answer.by || t("somebody") }) : called ? t("roll.waiting") : "");
      const mayday = this.board.mayday?.[person.node];
      setText(row.mayday, t(mayday ? "mayday.end" : "mayday.hold"));
      row.hasMayday = Boolean(mayday);
      setAttribute(row.element, "data-mayday", String(row.hasMayday));
      const out = evacuation?.nodes.includes(person.node);
      row.tick.hidden = !out;
      setAttribute(row.evacuate, "aria-label", t("evacuate.name", { name: person.name }));
      const seen = evacuation?.acknowledged?.[person.node];
      row.evacuate.hidden = out && !seen;
      setText(row.order, !out ? "" : seen ? t("evacuate.understood.by", { name: seen.by || t("somebody"), time: timeOfDay(1000 * seen.unix_s) })
        : ["delivered", "lit"].filter((way) => evacuation[way]?.[person.node]).map((way) => t(`evacuate.${way}`, { time: timeOfDay(1000 * evacuation[way][person.node]) })).join("; ")
          || t("evacuate.radio"));
    }
  }

  make(node) {
    // What is typed here stays until it is sent; after that, and else, what the session has is shown.
    const edited = new Set();
    const field = (name, attributes) => {
      const input = make(name === "state" ? "select" : "input", attributes);
      input.addEventListener("input", () => edited.add(input));
      input.addEventListener("blur", () => input.dataset.sending || edited.delete(input));
      input.addEventListener("change", async () => {
        input.dataset.sending = "true";
        await this.post("board", name === "air"
          ? { node, air_bar: input.value === "" ? null : Number(input.value) } : { node, [name]: input.value });
        delete input.dataset.sending;
        edited.delete(input);
      });
      return input;
    };
    const row = { edited, name: make("span"), time: make("td"), contact: make("td"), airAge: make("span", { class: "soft" }),
      answer: make("span"), order: make("span"), team: field("team", { size: 6, maxlength: 40 }), sector: field("sector", { size: 6, maxlength: 40 }),
      task: field("task", { size: 10, maxlength: 40 }), state: field("state", {}), air: field("air", { type: "number", min: 0, max: 400, step: 5 }) };
    row.state.append(...STATES.map((value) => make("option", { value, "data-t": `board.state.${value || "none"}` })));
    const button = (key, action) => {
      const element = make("button", { type: "button", "data-t": key });
      element.addEventListener("click", action);
      return element;
    };
    row.here = button("roll.answer.confirmed", () => this.post("rollcall", { action: "answer", node, answer: "confirmed" }));
    row.missing = button("roll.answer.missing", () => this.post("rollcall", { action: "answer", node, answer: "missing" }));
    row.evacuate = button("evacuate.one", () => {});
    hold(row.evacuate, () => this.post("evacuate", { action: "order", nodes: [node] }));
    row.tick = button("evacuate.understood", () => this.post("evacuate", { action: "acknowledged", node }));
    row.mayday = make("button", { type: "button" });
    hold(row.mayday, () => this.mayday(node, !row.hasMayday));
    row.element = make("tr", { "data-node": node }, make("th", { scope: "row" }, row.name), make("td", {}, row.team), make("td", {}, row.sector),
      make("td", {}, row.task), make("td", {}, row.state), row.time, row.contact, make("td", {}, row.air, " bar ", row.airAge),
      make("td", {}, row.here, row.missing, row.answer), make("td", {}, row.mayday), make("td", {}, row.evacuate, row.order, row.tick));
    byId("board-rows").append(row.element);
    this.rows.set(node, row);
    return row;
  }

  showRollCall(nowMs) {
    const call = this.board.roll_call;
    const open = Boolean(call) && call.ended_unix_s === null;
    byId("roll-end").hidden = !open;
    const line = byId("roll-line");
    line.hidden = !call;
    if (!call) return;
    const answers = Object.values(call.answers);
    const confirmed = answers.filter((answer) => answer.answer === "confirmed").length;
    const leftS = call.started_unix_s + call.within_s - nowMs / 1000;
    setAttribute(line, "data-state", !open ? call.outcome : leftS < 0 ? "over" : leftS < EARLY_S ? "soon" : "open");
    const count = t("roll.count", { confirmed, called: call.nodes.length, missing: answers.length - confirmed });
    const state = open ? (leftS < 0 ? "over" : "left") : call.outcome;
    setText(line, t(`roll.${call.emergency ? "emergency." : ""}${state}`, { count, time: open ? seconds(Math.abs(leftS)) : timeOfDay(1000 * call.ended_unix_s) }));
  }

  showEvacuation() {
    const order = this.board.evacuation;
    byId("evacuate-end").hidden = !order;
    const line = byId("evacuation-line");
    line.hidden = !order;
    if (!order) return;
    const done = Object.keys(order.acknowledged).length;
    setText(line, t("evacuate.line", { time: timeOfDay(1000 * order.unix_s), done, all: order.nodes.length }));
  }
}

const HOLD_MS = 1000;

/** Act after a hold of a second, by finger, mouse or key: never by a slip. */
export function hold(button, action) {
  let timer = null;
  const stop = () => {
    clearTimeout(timer);
    timer = null;
    button.classList.remove("holding");
  };
  const start = () => {
    if (timer !== null) return;
    button.classList.add("holding");
    timer = setTimeout(() => {
      stop();
      action();
    }, HOLD_MS);
  };
  button.classList.add("hold");
  button.addEventListener("pointerdown", start);
  for (const end of ["pointerup", "pointerleave", "pointercancel", "blur", "keyup"]) button.addEventListener(end, stop);
  button.addEventListener("keydown", (event) => {
    if (event.key === "Enter" || event.key === " ") {
      event.preventDefault();
      // A key that stays down is one hold: a second would call the MAYDAY again that it has ended.
      if (!event.repeat) start();
    }
  });
}
