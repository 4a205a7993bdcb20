// When to try again.

const STEPS_S = [0.5, 1, 2, 4, 8, 10];

/** Seconds until the attempt after `failures` in a row; `random` in [0, 1) spreads many pages. */
export function delayS(failures, random = Math.random()) {
  const step = STEPS_S[Math.min(failures, STEPS_S.length - 1)];
  return step * (0.8 + 0.4 * random);
}

/** The server says something each two seconds. */
export const SILENT_S = 5;
export const DEAD_S = 10;

/** What the time since the last message means: "live", "silent" or "dead". */
export function judge(silentS) {
  if (silentS >= DEAD_S) return "dead";
  return silentS >= SILENT_S ? "silent" : "live";
}
