// The active alarms, and which of them are acknowledged.

import { isFresh } from "./age.js";

const KINDS = {
  still_warning: { kind: "still", level: "warning" },
  still_alarm: { kind: "still", level: "alarm" },
  lost: { kind: "lost", level: "alarm" },
};

/**
 * Keeps the alarms between views. `update` returns what has changed, so that it is announced once:
 * {raised, cleared}. A warning that becomes an alarm is raised, and must be acknowledged, again.
 */
export class Alarms {
  constructor() {
    this.active = new Map();
  }

  update(people) {
    const raised = [];
    const cleared = [];
    const seen = new Set();
    for (const person of people) {
      const of = KINDS[person.alert];
      if (!of) continue;
      seen.add(person.node);
      const before = this.active.get(person.node);
      const same = before && before.kind === of.kind && before.level === of.level;
      const alarm = {
        node: person.node,
        name: person.name,
        ...of,
        seconds: of.kind === "lost" ? person.seen_s : person.still_s,
        newsS: isFresh(person) ? 0 : person.seen_s,
        // Acknowledged here at once; on other pages when the server says so.
        acknowledged: person.acknowledged === true || (same ? before.acknowledged : false),
      };
      this.active.set(person.node, alarm);
      if (!same && !alarm.acknowledged) raised.push(alarm);
    }
    for (const [node, alarm] of this.active) {
      if (seen.has(node)) continue;
      this.active.delete(node);
      cleared.push(alarm);
    }
    return { raised, cleared };
  }

  acknowledge(node) {
    const alarm = this.active.get(node);
    if (alarm) this.active.set(node, { ...alarm, acknowledged: true });
  }

  /** The worst first: unacknowledged before acknowledged, alarms before warnings. */
  list() {
    const rank = (a) => (a.acknowledged ? 2 : 0) + (a.level === "alarm" ? 0 : 1);
    return [...this.active.values()].sort((a, b) => rank(a) - rank(b) || b.seconds - a.seconds);
  }

  /** The sound to play: "high", "medium" or null. */
  get sounding() {
    const open = this.list().filter((alarm) => !alarm.acknowledged);
    if (open.length === 0) return null;
    return open.some((alarm) => alarm.level === "alarm") ? "high" : "medium";
  }

  clear() {
    this.active.clear();
  }
}
