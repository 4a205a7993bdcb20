// The active alarms: their priority, what has one cause, who has acknowledged them.

import { isFresh } from "./age.js";

/** Priorities as in IEC 60601-1-8: help at once, soon, be aware. */
const KINDS = {
  mayday: { kind: "mayday", level: "high" },
  still_alarm: { kind: "still", level: "high" },
  fall: { kind: "fall", level: "high" },
  lost: { kind: "lost", level: "medium" },
  still_warning: { kind: "still", level: "low" },
};
/** Nobody wears the command post's node: its silence leaves heights without their reference. */
const POST = { lost: { kind: "post", level: "low" } };
const RANK = { high: 0, medium: 1, low: 2 };
const FLOOD = 10;
const FLOOD_MS = 600_000;
/** Silent within so many seconds of each other: one cause. */
const TOGETHER_S = 5;
const MANY = 3;

/**
 * Keeps the alarms between views. `update` returns what has changed, so that it is announced once:
 * {raised, cleared}. A warning that becomes an alarm is raised, and must be acknowledged, again.
 */
export class Alarms {
  constructor(now = () => performance.now()) {
    this.now = now;
    this.clear();
  }

  clear() {
    this.active = new Map();
    this.raisedMs = [];
    this.people = 0;
  }

  update(people) {
    const raised = [];
    const cleared = [];
    const seen = new Set();
    this.people = people.filter((person) => !person.post).length;
    for (const person of people) {
      const of = (person.post ? POST : KINDS)[person.alert];
      if (!of) continue;
      seen.add(person.node);
      const before = this.active.get(person.node);
      const same = before && before.kind === of.kind && before.level === of.level;
      const alarm = {
        node: person.node,
        name: person.name,
        ...of,
        seconds: person.alert === "lost" ? person.seen_s : person.still_s,
        newsS: isFresh(person) ? 0 : person.seen_s,
        // Acknowledged here at once; on other pages when the server says so.
        acknowledged: person.acknowledged === true || (same ? before.acknowledged : false),
        by: person.acknowledged_by || (same ? before.by : ""),
        shelvedS: person.shelved_s ?? 0,
      };
      this.active.set(person.node, alarm);
      if (!same && !alarm.acknowledged && !alarm.shelvedS) {
        raised.push(alarm);
        this.raisedMs.push(this.now());
      }
    }
    for (const [node, alarm] of this.active) {
      if (seen.has(node)) continue;
      this.active.delete(node);
      cleared.push(alarm);
    }
    return { raised, cleared };
  }

  acknowledge(node, by = "", acknowledged = true) {
    const alarm = this.active.get(node);
    if (alarm) this.active.set(node, { ...alarm, acknowledged, by });
  }

  /**
   * Acknowledge here at once, and with `send(node)`; `show()` follows each change. Those of whom
   * nobody else learned are open again, and the error of `send` is thrown.
   */
  async acknowledgeAll(nodes, by, send, show) {
    for (const node of nodes) this.acknowledge(node, by);
    show();
    const unsent = new Set(nodes);
    try {
      for (const node of nodes) {
        await send(node);
        unsent.delete(node);
      }
    } catch (error) {
      for (const node of unsent) this.acknowledge(node, "", false);
      show();
      throw error;
    }
  }

  /** The worst first: unacknowledged before acknowledged, by priority, then the oldest. */
  list() {
    const rank = (a) => (a.acknowledged || a.shelvedS ? 3 : 0) + RANK[a.level];
    return [...this.active.values()].sort((a, b) => rank(a) - rank(b) || b.seconds - a.seconds);
  }

  get open() {
    return this.list().filter((alarm) => !alarm.acknowledged && !alarm.shelvedS);
  }

  /** Ten alarms within ten minutes: more than a person can answer one by one. */
  get flood() {
    const since = this.now() - FLOOD_MS;
    this.raisedMs = this.raisedMs.filter((ms) => ms > since);
    return this.raisedMs.length >= FLOOD;
  }

  /**
   * What is to be answered, each with one cause: {key, kind, level, nodes, alarms}. Nobody who lies
   * still is ever taken into a group; in a flood all that is not high is one.
   */
  rows() {
    const rows = [];
    const lost = this.open.filter((alarm) => alarm.kind === "lost");
    const silent = [...this.active.values()].filter((alarm) => alarm.kind !== "post" && (alarm.newsS || alarm.kind === "lost"));
    const seconds = lost.map((alarm) => alarm.seconds);
    const together = lost.length >= MANY && Math.max(...seconds) - Math.min(...seconds) <= TOGETHER_S;
    const nobody = lost.length > 1 && silent.length === this.people;
    const grouped = new Set(nobody || together ? lost.map((alarm) => alarm.node) : []);
    if (grouped.size) rows.push(group(nobody ? "nobody" : "together", nobody ? "high" : "medium", lost));
    const others = this.open.filter((alarm) => !grouped.has(alarm.node));
    const folded = this.flood ? others.filter((alarm) => alarm.level !== "high") : [];
    for (const alarm of others) {
      if (!folded.includes(alarm)) rows.push({ key: String(alarm.node), ...alarm, nodes: [alarm.node], alarms: [alarm] });
    }
    if (folded.length) rows.push(group("flood", "low", folded));
    return rows.sort((a, b) => RANK[a.level] - RANK[b.level]);
  }

  /** The sound to play: "high", "medium", "low" or null. In a flood only what is high sounds. */
  get sounding() {
    const levels = this.rows().filter((row) => row.kind !== "flood").map((row) => row.level);
    return Object.keys(RANK).find((level) => levels.includes(level)) ?? null;
  }
}

function group(kind, level, alarms) {
  return { key: kind, kind, level, alarms, nodes: alarms.map((alarm) => alarm.node), seconds: Math.max(...alarms.map((a) => a.seconds)) };
}
