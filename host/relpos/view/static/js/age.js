// How old what is shown is: nothing looks newer than it is.

/** Without a view of the session for so long the link is lost, whatever else arrives. */
export const LINK_LOST_S = 3.5;
const STALE_S = 3; // live/composer.py
/** How fast somebody who is not heard may have gone on: an unhurried walk. */
export const WALKING_M_S = 1.4;
const BEAT_MS = 500;

/**
 * This moment, or one `agoS` before. By two clocks: one may be set, the other may stand still while
 * the device sleeps.
 */
export function moment(agoS = 0) {
  return { wallMs: Date.now() - 1000 * agoS, steadyMs: performance.now() - 1000 * agoS };
}

/** Seconds since then, by the clock that says more: nothing looks newer than it is. */
export function sinceS({ wallMs, steadyMs }) {
  return Math.max(Date.now() - wallMs, performance.now() - steadyMs) / 1000;
}

/** Whether a person's values are of now: also somebody who is not located has to be heard. */
export function isFresh(person) {
  if (person == null || person.status === "stale" || person.status === "lost") return false;
  // The session calls only who is located stale.
  return person.status === "ok" || !(person.seen_s > STALE_S);
}

/** How far from the last known place a person may be by now, in metres; 0 while heard, and for a node that nobody wears. */
export function reachM(person) {
  return isFresh(person) || person.post ? 0 : WALKING_M_S * Math.max(person.seen_s ?? 0, 0);
}

/** The person as known `lagS` after the view came: older by that, and only a last place once the link is lost. */
export function aged(person, lagS) {
  if (!(lagS > 0)) return person;
  const older = { ...person, seen_s: Number.isFinite(person.seen_s) ? person.seen_s + lagS : person.seen_s };
  if (lagS < LINK_LOST_S) return older;
  return { ...older, status: person.status === "ok" || person.status === "ambiguous" ? "stale" : person.status,
    moving: null, health: "unknown" };
}

/** Call `beat` twice a second, in a hidden tab, too: there browsers slow all timers but a worker's. */
export function startBeat(beat) {
  try {
    const worker = new Worker("/static/js/beat_worker.js");
    worker.onmessage = beat;
    worker.onerror = () => setInterval(beat, BEAT_MS);
  } catch {
    setInterval(beat, BEAT_MS);
  }
}
