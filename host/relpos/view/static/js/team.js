// The newest view of the team, and what follows from it; fed by the server's messages (protocol 1).

import { aged, moment, sinceS } from "./age.js";
import { t } from "./i18n.js";
import { nodeName } from "./words.js";
import { pairKey, relation } from "./relation.js";
import { Track } from "./tracks.js";

export const PROTOCOL = 1;

/** Less probable positions are not shown: they would be clutter. */
const MIN_PROBABILITY = 0.03;
const STARTING = ["starting", "no status heard yet"]; // nodes/health.py
const POST_NAME = "Command post"; // team_view.py
const RANGE_AGE_S = 10; // as the session drops them
const ONE_PLACE_M = 0.7; // as in the host's fusion/modes.py

export class Team {
  constructor() {
    this.session = null;
    this.limits = { still_warning_s: 20, still_alarm_s: 30 };
    this.clear();
  }

  clear() {
    /** As they were in the newest view, and as they are `lagS` later. */
    this.viewed = new Map();
    this.viewedRanges = [];
    this.people = new Map();
    this.pairs = new Map();
    this.ranges = [];
    this.alternatives = [];
    this.possibleOf = null;
    this.notices = [];
    this.tracks = new Map();
    /** By the whole recording; empty until they are computed. */
    this.smoothed = new Map();
    this.ambiguous = false;
    /** Bearing of magnetic north in the common frame; null while unknown. */
    this.northRad = null;
    this.sigmaNorthRad = null;
    this.timeS = null;
    this.unixS = null;
    this.arrivedUnixS = null;
    /** When the newest view was made, at the earliest. */
    this.viewedAt = null;
    this.seq = null;
    this.order = [];
  }

  /** Handle a message that is at most `ageS` old; returns its type, or "unknown" for one that this page cannot read. */
  handle(message, ageS = 0) {
    switch (message?.type) {
      case "hello": {
        const other = message.session?.started_unix_s !== this.session?.started_unix_s;
        if (other || message.session?.waiting) this.clear();
        this.session = message.session ?? {};
        this.limits = { ...this.limits, ...message.limits };
        return message.protocol === PROTOCOL ? "hello" : "unknown";
      }
      case "tracks":
        for (const [node, points] of Object.entries(message.tracks)) {
          this.trackOf(Number(node)).restore(points);
        }
        return "tracks";
      case "smoothed":
        this.smoothed = new Map(Object.entries(message.tracks).map(([node, points]) => {
          const track = new Track();
          track.restore(points);
          return [Number(node), track];
        }));
        return "smoothed";
      case "picture":
        this.viewedAt = moment(ageS);
        this.handleView(message);
        return "picture";
      case "log":
      case "you":
      case "board":
      case "timeline":
        return message.type;
      case "ping":
        return "ping";
      default:
        return "unknown";
    }
  }

  handleView(picture) {
    // A recording that was moved to another moment: its tracks begin there.
    const step = picture.time_s - (this.timeS ?? picture.time_s);
    if (this.replayed && (step < -0.01 || step > 15)) this.tracks = new Map();
    this.seq = picture.seq;
    this.timeS = picture.time_s;
    this.unixS = picture.unix_s;
    this.arrivedUnixS = picture.arrived_unix_s;
    this.ambiguous = Boolean(picture.ambiguous);
    this.northRad = picture.north_rad ?? null;
    this.sigmaNorthRad = picture.sigma_north_rad ?? null;
    this.notices = picture.notices ?? [];
    this.viewedRanges = picture.ranges ?? [];
    this.alternatives = picture.alternatives ?? [];
    this.viewed = new Map((picture.people ?? []).map((person) => [person.node, named(person)]));
    this.age(0);
    this.pairs = new Map((picture.pairs ?? []).map((pair) => [pairKey(pair[0], pair[1]), pair]));
    this.order = [...this.people.keys()].sort((a, b) => a - b);
    for (const person of this.people.values()) {
      // Only located people leave a track.
      if (!person.post && (person.status === "ok" || person.status === "stale")) {
        this.trackOf(person.node).add(picture.time_s, person.x_m, person.y_m);
      }
    }
  }

  /** Seconds since the newest view; null before the first. */
  get lagS() {
    return this.viewedAt && sinceS(this.viewedAt);
  }

  /** The session's time of day in ms: this device's own may be wrong. In a replay the recording's. */
  get nowMs() {
    if (this.replayed) return 1000 * ((this.session.recorded_unix_s ?? 0) + (this.timeS ?? 0));
    return this.viewedAt ? 1000 * (this.unixS + this.lagS) : Date.now();
  }

  /** Make everything `lagS` older than it was in the newest view. */
  age(lagS) {
    this.people = new Map([...this.viewed].map(([node, person]) => [node, aged(person, lagS)]));
    this.ranges = lagS > 0
      ? this.viewedRanges.map(([a, b, rangeM, ageS]) => [a, b, rangeM, ageS + lagS]).filter(([, , , ageS]) => ageS <= RANGE_AGE_S)
      : this.viewedRanges;
  }

  /** Whether this is a recording, not now. */
  get replayed() {
    return this.session?.replay === true;
  }

  /** Time of day in ms at which a person was last heard; in a replay the recording's, null where unknown. */
  heardMs(node) {
    const seenS = this.viewed.get(node)?.seen_s;
    const startS = this.replayed ? this.session.recorded_unix_s : this.unixS - this.timeS;
    return Number.isFinite(seenS) && Number.isFinite(startS) ? 1000 * (startS + this.timeS - seenS) : null;
  }

  trackOf(node) {
    let track = this.tracks.get(node);
    if (!track) {
      track = new Track();
      this.tracks.set(node, track);
    }
    return track;
  }

  /** All people, by number. */
  list() {
    return this.order.map((node) => this.people.get(node));
  }

  /** Who is worn by somebody: all but the command post's node. */
  wearers() {
    return this.list().filter((person) => !person.post);
  }

  person(node) {
    return this.people.get(node) ?? null;
  }

  /** A text of the session with the names of its people in place of their nodes' numbers. */
  withNames(text) {
    return text.replace(/\b[Nn]ode (\d+)\b/g, (words, node) => this.person(Number(node))?.name ?? words);
  }

  /** How `from` sees `to` (numbers); null where either is unknown. */
  relation(from, to) {
    return relation(this.person(from), this.person(to), this.pairs.get(pairKey(from, to)) ?? null);
  }

  /**
   * Possible positions while the team is ambiguous: {shown, places, rings, here}.
   *
   * The server lists alternatives of the whole team with their probabilities, the one shown (the
   * nearest to the view) among them. For each person, equal positions of several alternatives are
   * one place, and their probabilities add up. `here` (node -> probability) is that of the position
   * shown, `places` are all other positions, the most probable first, `rings` are the people shown
   * on a ring.
   */
  possible() {
    if (this.possibleOf === this.alternatives) return this.possibleNow;
    const alternatives = [...this.alternatives].sort((a, b) => b.probability - a.probability);
    let shown = null;
    let least = Infinity;
    for (const alternative of alternatives) {
      const off = this.distanceFromShown(alternative);
      if (off < least) [shown, least] = [alternative, off];
    }
    const homes = new Map((shown?.people ?? []).map((p) => [p.node, p]));
    const here = new Map();
    const found = new Map();
    for (const { probability, people } of alternatives) {
      for (const ghost of people) {
        const home = homes.get(ghost.node);
        if (home && isSamePlace(ghost, home)) {
          here.set(ghost.node, (here.get(ghost.node) ?? 0) + probability);
          continue;
        }
        const places = found.get(ghost.node) ?? [];
        const known = places.find((place) => isSamePlace(ghost, place));
        if (known) known.probability += probability;
        else places.push({ ...ghost, probability });
        found.set(ghost.node, places);
      }
    }
    this.possibleOf = this.alternatives;
    this.possibleNow = {
      shown,
      here,
      places: [...found.values()].flat()
        .filter((place) => place.probability >= MIN_PROBABILITY)
        .sort((a, b) => b.probability - a.probability),
      rings: [...homes.values()].filter((p) => p.shape === "ring"),
    };
    return this.possibleNow;
  }

  /**
   * How `from` sees `to` where the most probable other alternative has them: {relation, probability};
   * null where there is none. One that moves others alone is no other.
   */
  elsewhere(from, to) {
    const { shown } = this.possible();
    const at = (alternative, node) => alternative?.people.find((p) => p.node === node && p.shape !== "ring");
    const groups = [];
    for (const alternative of this.alternatives) {
      if (![from, to].every((node) => at(alternative, node) && at(shown, node))) continue;
      const same = (other) => [from, to].every((node) => isSamePlace(at(alternative, node), at(other, node)));
      if (same(shown)) continue;
      const group = groups.find(({ first }) => same(first));
      if (group) group.probability += alternative.probability;
      else groups.push({ first: alternative, probability: alternative.probability });
    }
    const [best] = groups.sort((a, b) => b.probability - a.probability);
    if (!best || best.probability < MIN_PROBABILITY) return null;
    const placed = (node) => ({ ...this.person(node), ...at(best.first, node) });
    return { relation: relation(placed(from), placed(to)), probability: best.probability };
  }

  distanceFromShown(alternative) {
    let [sum, count] = [0, 0];
    for (const ghost of alternative.people) {
      const person = this.person(ghost.node);
      if (!person || ghost.shape === "ring" || !Number.isFinite(person.x_m)) continue;
      sum += Math.hypot(ghost.x_m - person.x_m, ghost.y_m - person.y_m);
      count += 1;
    }
    return count ? sum / count : Number.MAX_VALUE;
  }
}

/** Whether two positions of a person are the same, given the uncertainty of the second. */
function isSamePlace(a, b) {
  if (a.shape !== b.shape) return false;
  const off = Math.hypot(a.x_m - b.x_m, a.y_m - b.y_m);
  if (a.shape === "ring") return off + Math.abs(a.sigma_major_m - b.sigma_major_m) < 1;
  const spread2 = 2 * ((b.sigma_major_m ?? 0) ** 2 + (b.sigma_minor_m ?? 0) ** 2);
  return off ** 2 < Math.max(ONE_PLACE_M ** 2, spread2);
}

function named(person) {
  const health = STARTING.includes(person.reasons?.[0]) ? "starting" : person.health;
  const own = person.name && person.name !== `Node ${person.node}` && person.name !== POST_NAME;
  return { ...person, health, name: own ? person.name : person.post ? t("post") : nodeName(person.node) };
}
