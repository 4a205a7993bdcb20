// The state of the connection and the age of the data: a view never looks newer than it is.

import { LINK_LOST_S } from "./age.js";
import { setAttribute, setHidden, setText } from "./dom.js";
import { date, t, timeOfDay } from "./i18n.js";
import { seconds } from "./words.js";

/** Age in seconds from which the data are called old even while messages arrive. */
export const OLD_S = LINK_LOST_S;

/**
 * Age in seconds of the newest packet in the view: its age by the server's clock when it was sent,
 * plus the time since then by ours. Null before the first view.
 */
export function dataAgeS({ unixS, arrivedUnixS, receivedMs, nowMs }) {
  if (receivedMs === null || unixS === null) return null;
  const sent = Number.isFinite(arrivedUnixS) ? Math.max(0, unixS - arrivedUnixS) : 0;
  return sent + Math.max(0, nowMs - receivedMs) / 1000;
}

/** {state, words, age} to show. */
export function connectionWords(state, ageS, retryS) {
  const old = ageS !== null && ageS > OLD_S;
  const shown = state === "live" && old ? "old" : state;
  const words = shown === "waiting" && retryS ? t("connection.retry", { seconds: retryS }) : t(`connection.${shown}`);
  let age = "";
  if (ageS !== null) age = ageS < 1.5 ? t("data.now") : t("data.old", { time: seconds(ageS) });
  else if (state === "live") age = t("data.none");
  return { state: shown, words, age };
}

/** {state, words, age} of a recording that is played: its own clock, never now's. */
export function replayWords(state, session, timeS) {
  if (state !== "live") return connectionWords(state, null, null);
  const unixS = session.recorded_unix_s;
  const age = timeS === null ? "" : Number.isFinite(unixS)
    ? `${date(1000 * unixS)} ${timeOfDay(1000 * (unixS + timeS))}`
    : t("replay.second", { second: Math.floor(timeS) });
  return { state: "replay", words: t("connection.replay"), age };
}

export function showConnection({ line, words, age, retry }, status) {
  setAttribute(line, "data-state", status.state);
  setText(words, status.words);
  setText(age, status.age);
  setHidden(retry, status.state !== "waiting" && status.state !== "refused");
}
