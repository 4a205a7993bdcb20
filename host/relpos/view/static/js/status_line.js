// The connection and the age of what is shown: never a picture that looks newer than it is.

import { setAttribute, setText } from "./dom.js";
import { seconds } from "./words.js";

/** From this age on the picture is called old even while messages come. */
export const OLD_S = 5;

const WORDS = {
  connecting: "Connecting",
  live: "Live",
  silent: "Server silent",
  waiting: "Not connected",
  refused: "Not let in: open the address with the token that relpos prints",
  old: "Old picture",
};

/**
 * Age in seconds of the newest packet in the picture: what it was when the server sent it, by its
 * own clock, and the time since then by ours. Null before the first picture.
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
  const words = shown === "waiting" && retryS ? `${WORDS.waiting}, next try in ${retryS} s` : WORDS[shown];
  let age = "";
  if (ageS !== null) age = ageS < 1.5 ? "data now" : `data ${seconds(ageS)} old`;
  else if (state === "live") age = "no data yet";
  return { state: shown, words, age };
}

export function showConnection({ line, words, age, retry }, told) {
  setAttribute(line, "data-state", told.state);
  setText(words, told.words);
  setText(age, told.age);
  retry.hidden = told.state !== "waiting" && told.state !== "refused";
}
