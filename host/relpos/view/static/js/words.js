// Numbers and directions as people read and hear them.

import { clockHour, compassPoint, degrees } from "./angles.js";
import { has, number, t } from "./i18n.js";

export { timeOfDay } from "./i18n.js";

export const UNKNOWN = "–";
const NBSP = "\u00a0"; // a figure and its unit stay on one line

/** "4.2 m", "17 m"; tenths only where they are near and mean something. */
export function distance(m, sigmaM = 0) {
  if (!Number.isFinite(m)) return UNKNOWN;
  return m < 9.95 && !(sigmaM >= 1) ? `${number(m, 1)}${NBSP}m` : `${number(m)}${NBSP}m`;
}

/** "±0.4 m": one standard deviation. */
export function plusMinus(sigmaM) {
  if (!Number.isFinite(sigmaM)) return "";
  return `±${number(Math.max(sigmaM, 0.1), sigmaM < 9.95 ? 1 : 0)}${NBSP}m`;
}

/** "±8°": one standard deviation; none below half a degree. */
export function plusMinusDegrees(sigmaRad) {
  return Number.isFinite(sigmaRad) ? `±${number(Math.max(degrees(sigmaRad), 1))}°` : "";
}

/** To be read aloud: "4 metres", "half a metre"; without tenths. */
export function spokenDistance(m) {
  if (!Number.isFinite(m)) return t("distance.unknown");
  return m < 0.75 ? t("distance.half") : t("distance.metres", { count: Math.round(m) });
}

/** "0.4 s", "12 s", "3:05 min", "1:02 h". */
export function duration(s) {
  if (!Number.isFinite(s)) return UNKNOWN;
  const positive = Math.max(0, s);
  if (positive < 9.95) return `${number(positive, positive < 0.95 ? 1 : 0)}${NBSP}s`;
  if (positive < 120) return `${Math.round(positive)}${NBSP}s`;
  const minutes = Math.floor(positive / 60);
  if (minutes < 120) return `${minutes}:${two(positive % 60)}${NBSP}min`;
  return `${Math.floor(minutes / 60)}:${two(minutes % 60)}${NBSP}h`;
}

function two(n) {
  return String(Math.floor(n)).padStart(2, "0");
}

/** Full seconds, so that the figure does not flicker. */
export function seconds(s) {
  if (!Number.isFinite(s)) return UNKNOWN;
  return s < 120 ? `${Math.floor(Math.max(s, 0))}${NBSP}s` : duration(s);
}

/** Time since the last report: "now" within two reports. */
export function ago(s) {
  if (!Number.isFinite(s)) return UNKNOWN;
  return s < 2 ? t("now") : t("ago", { time: seconds(s) });
}

export function volts(v) {
  return Number.isFinite(v) && v > 0 ? `${number(v, 2)} V` : UNKNOWN;
}

export function dbm(v) {
  return Number.isFinite(v) ? `${number(v)} dBm`.replace("-", "−") : UNKNOWN;
}

export function percent(fraction) {
  if (!Number.isFinite(fraction)) return UNKNOWN;
  return `${number(100 * fraction)} %`;
}

/** A probability: never shown as certain or impossible while it is neither. */
export function probability(p) {
  if (!Number.isFinite(p)) return UNKNOWN;
  if (p > 0 && p < 0.01) return `<${percent(0.01)}`;
  if (p < 1 && p > 0.99) return `>${percent(0.99)}`;
  return percent(p);
}

/** "2 o'clock"; for an angle from `relative`. */
export function clock(relativeRad) {
  return t("clock", { hour: clockHour(relativeRad) });
}

const EIGHTHS = ["ahead", "ahead-right", "right", "behind-right", "behind", "behind-left", "left", "ahead-left"];

/** A relative direction in words: "ahead left". */
export function side(relativeRad) {
  const eighth = Math.round(-relativeRad / (Math.PI / 4));
  return t(`side.${EIGHTHS[((eighth % 8) + 8) % 8]}`);
}

/** "north-east"; where north is unknown (null) "map north-east", the map's y axis being its north. */
export function compass(bearingRad, northRad) {
  return northRad === null ? t("compass.map", { point: t(`compass.${compassPoint(bearingRad)}.long`) })
    : t(`compass.${compassPoint(bearingRad, northRad)}.long`);
}

/** The direction in short: "2 o'clock"; "close by" or "direction unknown" where it is too vague. */
export function directionWords(relation) {
  if (relation.relativeRad !== null) return clock(relation.relativeRad);
  return relation.distanceM < Math.max(1, 2 * relation.sigmaM) ? t("close") : t("direction.unknown");
}

/** A person's position in one line, for lists and for screen readers. */
export function whereabouts(relation, northRad) {
  if (!relation) return t("position.unknown");
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
  return Number.isFinite(p) && p < 0.97 ? t("here", { probability: probability(p) }) : t("status.ambiguous");
}

/** A word of `group` for a value of the session; the value itself where it is a new one. */
function word(group, value) {
  return has(`${group}.${value}`) ? t(`${group}.${value}`) : String(value ?? "");
}

/** Of the node, not of its wearer: "node OK". */
export const healthWords = (health) => word("health", health);

/** "located", "lost, last place". */
export const statusWords = (status) => word("status", status);

/** Priority of an alarm: "high". */
export const levelWords = (level) => word("level", level);

/** A person without a name of their own. */
export const nodeName = (node) => t("node", { node });

/** The text of an alarm, or of several with one cause, from `alarms.js`. */
export function alarmText(alarm) {
  const names = (alarm.alarms ?? []).map((a) => a.name).join(", ");
  const values = { name: alarm.name, names, count: alarm.alarms?.length, time: seconds(alarm.seconds), news: ago(alarm.newsS) };
  return t(`alarm.${alarm.kind === "still" && alarm.newsS ? "was-still" : alarm.kind}`, values);
}
