// Guiding one person to another: which way to turn, and whether it gets warmer.

import { t } from "./i18n.js";
import { side, spokenDistance } from "./words.js";

const AHEAD_RAD = (25 * Math.PI) / 180;
const BEAR_RAD = (60 * Math.PI) / 180;
const AROUND_RAD = (140 * Math.PI) / 180;
// Hysteresis: an instruction holds until the direction is this far beyond its limit.
const HOLD_RAD = (7 * Math.PI) / 180;

function order(relativeRad, slack) {
  const size = Math.abs(relativeRad) - slack;
  const hand = relativeRad > 0 ? "left" : "right";
  if (size <= AHEAD_RAD) return "ahead";
  if (size <= BEAR_RAD) return `bear-${hand}`;
  if (size <= AROUND_RAD) return hand;
  return "around";
}

/** The direction to turn; `previous` is the last instruction. */
export function turnOrder(relativeRad, previous = null) {
  const now = order(relativeRad, 0);
  if (previous && previous !== now) {
    const near = [order(relativeRad, HOLD_RAD), order(relativeRad, -HOLD_RAD)];
    if (near.includes(previous)) return previous;
  }
  return now;
}

/** Whether the target is within reach of a hand, or as near as the position is known. */
export function isThere(relation) {
  return relation.distanceM < Math.max(1.5, 1.5 * relation.sigmaM);
}

/**
 * The instruction for the seeker: {key, words, arrowRad}; `arrowRad` is null while unknown. `last`:
 * it leads to a last known place; `fresh`: the seeker's own position is of now.
 */
export function guidance(relation, previous = null, { last = false, fresh = true } = {}) {
  if (!relation) return { key: "unknown", words: t("position.unknown"), arrowRad: null };
  if (!fresh) return { key: "old", words: t("find.old"), arrowRad: null };
  if (isThere(relation)) {
    return { key: "there", words: t(last ? "find.there-last" : "find.there"), arrowRad: relation.relativeRad };
  }
  if (relation.relativeRad === null) {
    return { key: "vague", words: t(relation.headingKnown ? "find.moving" : "find.vague"), arrowRad: null };
  }
  const key = turnOrder(relation.relativeRad, previous);
  return { key, words: t(`find.${key}`), arrowRad: relation.relativeRad };
}

const TREND_S = 6;
const MIN_SPAN_S = 2.5;
const MIN_SPEED_M_S = 0.15;
const MIN_CHANGE_M = 0.6;

/** Warmer or colder, by the slope of the distance over the last seconds. */
export class Trend {
  constructor() {
    this.samples = [];
  }

  add(timeS, distanceM) {
    const last = this.samples[this.samples.length - 1];
    if (timeS === last?.[0]) return;
    // A recording that was moved back.
    if (timeS < last?.[0]) this.samples = [];
    this.samples.push([timeS, distanceM]);
    while (this.samples[0][0] < timeS - TREND_S) this.samples.shift();
  }

  /** "warmer", "colder", "same", or null with too few samples. */
  get direction() {
    const n = this.samples.length;
    if (n < 3) return null;
    const [first, last] = [this.samples[0][0], this.samples[n - 1][0]];
    if (last - first < MIN_SPAN_S) return null;
    let [st, sd, stt, std] = [0, 0, 0, 0];
    for (const [t, d] of this.samples) {
      st += t - first;
      sd += d;
      stt += (t - first) ** 2;
      std += (t - first) * d;
    }
    const slope = (n * std - st * sd) / (n * stt - st * st);
    if (Math.abs(slope) < MIN_SPEED_M_S || Math.abs(slope) * (last - first) < MIN_CHANGE_M) {
      return "same";
    }
    return slope < 0 ? "warmer" : "colder";
  }
}

/** The text that is read aloud. */
export function spoken(targetName, relation, guide, trend) {
  if (!relation) return `${targetName}: ${t("position.unknown")}.`;
  const parts = [`${targetName}, ${spokenDistance(relation.distanceM)}`];
  parts.push(guide.arrowRad === null || guide.key === "there"
    ? guide.words
    : `${side(guide.arrowRad)}: ${guide.words}`);
  if (trend === "warmer" || trend === "colder") parts.push(t(`find.${trend}.spoken`));
  return `${parts.join(", ")}.`;
}

const SAY_EVERY_MS = 4000;

/** Decides when to speak: after a change, and not too soon after the last announcement. */
export class Announcer {
  constructor() {
    this.last = null;
  }

  due(nowMs, { key, distanceM, trend }) {
    const last = this.last;
    const changed = !last || last.key !== key || last.trend !== trend ||
      Math.abs(distanceM - last.distanceM) >= Math.max(1, 0.1 * last.distanceM);
    if (!changed || (last && nowMs - last.atMs < SAY_EVERY_MS)) return false;
    this.last = { key, distanceM, trend, atMs: nowMs };
    return true;
  }
}
