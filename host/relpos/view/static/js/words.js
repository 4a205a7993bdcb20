// Numbers and directions as people read and hear them.

import { clockHour, compassPoint, degrees } from "./angles.js";

export const UNKNOWN = "–";
const NBSP = "\u00a0"; // a figure and its unit stay on one line

/** "4.2 m", "17 m"; tenths only where they are near and mean something. */
export function distance(m, sigmaM = 0) {
  if (!Number.isFinite(m)) return UNKNOWN;
  return m < 9.95 && !(sigmaM >= 1) ? `${m.toFixed(1)}${NBSP}m` : `${Math.round(m)}${NBSP}m`;
}

/** "±0.4 m": one standard deviation. */
export function plusMinus(sigmaM) {
  if (!Number.isFinite(sigmaM)) return "";
  return `±${Math.max(sigmaM, 0.1).toFixed(sigmaM < 9.95 ? 1 : 0)}${NBSP}m`;
}

/** "±8°": one standard deviation; none below half a degree. */
export function plusMinusDegrees(sigmaRad) {
  return Number.isFinite(sigmaRad) ? `±${Math.max(degrees(sigmaRad), 1).toFixed(0)}°` : "";
}

/** To be read aloud: "4 metres", "half a metre"; without tenths. */
export function spokenDistance(m) {
  if (!Number.isFinite(m)) return "distance unknown";
  if (m < 0.75) return "half a metre";
  if (m < 1.5) return "1 metre";
  return `${Math.round(m)} metres`;
}

/** "0.4 s", "12 s", "3:05 min", "1:02 h". */
export function duration(s) {
  if (!Number.isFinite(s)) return UNKNOWN;
  const positive = Math.max(0, s);
  if (positive < 9.95) return `${positive.toFixed(positive < 0.95 ? 1 : 0)} s`;
  if (positive < 120) return `${Math.round(positive)} s`;
  const minutes = Math.floor(positive / 60);
  if (minutes < 120) return `${minutes}:${two(positive % 60)} min`;
  return `${Math.floor(minutes / 60)}:${two(minutes % 60)} h`;
}

function two(n) {
  return String(Math.floor(n)).padStart(2, "0");
}

/** Full seconds, so that the figure does not flicker. */
export function seconds(s) {
  if (!Number.isFinite(s)) return UNKNOWN;
  return s < 120 ? `${Math.floor(Math.max(s, 0))} s` : duration(s);
}

/** Time since the last report: "now" within two reports. */
export function ago(s) {
  if (!Number.isFinite(s)) return UNKNOWN;
  return s < 2 ? "now" : `${seconds(s)} ago`;
}

export function volts(v) {
  return Number.isFinite(v) && v > 0 ? `${v.toFixed(2)} V` : UNKNOWN;
}

export function dbm(v) {
  return Number.isFinite(v) ? `${Math.round(v)} dBm`.replace("-", "−") : UNKNOWN;
}

export function percent(fraction) {
  if (!Number.isFinite(fraction)) return UNKNOWN;
  return `${Math.round(100 * fraction)} %`;
}

/** A probability: never shown as certain or impossible while it is neither. */
export function probability(p) {
  if (!Number.isFinite(p)) return UNKNOWN;
  if (p > 0 && p < 0.01) return "<1 %";
  if (p < 1 && p > 0.99) return ">99 %";
  return percent(p);
}

/** "2 o'clock"; for an angle from `relative`. */
export function clock(relativeRad) {
  return `${clockHour(relativeRad)} o'clock`;
}

const EIGHTHS = [
  "ahead",
  "ahead right",
  "right",
  "behind right",
  "behind",
  "behind left",
  "left",
  "ahead left",
];

/** A relative direction in words: "ahead left". */
export function side(relativeRad) {
  const eighth = Math.round(-relativeRad / (Math.PI / 4));
  return EIGHTHS[((eighth % 8) + 8) % 8];
}

/** "north-east"; where north is unknown (null) "map north-east", the map's y axis being its north. */
export function compass(bearingRad, northRad) {
  return northRad === null ? `map ${compassPoint(bearingRad).words}` : compassPoint(bearingRad, northRad).words;
}

/** "NE", or "map NE". */
export function compassShort(bearingRad, northRad) {
  return northRad === null ? `map ${compassPoint(bearingRad).short}` : compassPoint(bearingRad, northRad).short;
}

/** The direction in short: "2 o'clock"; "close by" or "direction unknown" where it is too vague. */
export function directionWords(relation) {
  if (relation.relativeRad !== null) return clock(relation.relativeRad);
  return relation.distanceM < Math.max(1, 2 * relation.sigmaM) ? "close by" : "direction unknown";
}

/** A person's position in one line, for lists and for screen readers. */
export function whereabouts(relation, northRad) {
  if (!relation) return "position unknown";
  const parts = [`${distance(relation.distanceM, relation.sigmaM)} ${plusMinus(relation.sigmaM)}`.trim()];
  if (relation.relativeRad !== null) {
    parts.push(`${clock(relation.relativeRad)}, ${side(relation.relativeRad)}`);
  } else {
    parts.push(directionWords(relation));
  }
  parts.push(compass(relation.bearingRad, northRad));
  return parts.join(" · ");
}

/** Probability of an ambiguous person's position shown: "62 % here". */
export function probabilityHere(p) {
  return Number.isFinite(p) && p < 0.97 ? `${probability(p)} here` : "ambiguous";
}

/** Of the node, not of its wearer. */
export const HEALTH_WORDS = { green: "node OK", yellow: "node weak", red: "node failing", unknown: "node unknown", starting: "node starting" };

export const STATUS_WORDS = {
  ok: "located",
  ambiguous: "ambiguous",
  unlocated: "not located",
  stale: "not heard, last place",
  lost: "lost, last place",
};

/** The text of an alarm, or of several with one cause, from `alarms.js`. */
export function alarmText(alarm) {
  const names = (alarm.alarms ?? []).map((a) => a.name).join(", ");
  if (alarm.kind === "nobody") return `Nothing heard from anybody for ${seconds(alarm.seconds)}: is the coordinator gone?`;
  if (alarm.kind === "together") return `${alarm.alarms.length} lost together for ${seconds(alarm.seconds)}: ${names}`;
  if (alarm.kind === "flood") return `Many alarms. Less urgent, ${alarm.alarms.length}: ${names}`;
  if (alarm.kind === "mayday") return `MAYDAY: ${alarm.name}`;
  if (alarm.kind === "lost") return `${alarm.name} is lost: not heard for ${seconds(alarm.seconds)}`;
  if (alarm.newsS) return `${alarm.name} had not moved for ${seconds(alarm.seconds)}; last heard ${ago(alarm.newsS)}`;
  return `${alarm.name} has not moved for ${seconds(alarm.seconds)}`;
}

/** Time of day, "14:03:22". */
export function timeOfDay(unixMs) {
  const at = new Date(unixMs);
  return [at.getHours(), at.getMinutes(), at.getSeconds()].map(two).join(":");
}
