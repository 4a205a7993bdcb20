// How far the server's clock is ahead of this device's.

/**
 * One exchange: the server's answer lies somewhere between sending and receiving, so the middle is
 * wrong by at most half the round trip.
 */
export function exchange(sentMs, serverMs, receivedMs) {
  return {
    offsetMs: serverMs - (sentMs + receivedMs) / 2,
    roundTripMs: receivedMs - sentMs,
  };
}

/** The exchange with the smallest round trip; null of none. Broken ones do not count. */
export function best(exchanges) {
  const sound = exchanges.filter((e) => Number.isFinite(e.offsetMs) && e.roundTripMs >= 0);
  return sound.reduce((a, b) => (a === null || b.roundTripMs < a.roundTripMs ? b : a), null);
}

/** Ask the server several times. `ask` resolves to its time in ms; `now` is this device's. */
export async function measureOffset(ask, { times = 8, now = () => Date.now() } = {}) {
  const exchanges = [];
  for (let k = 0; k < times; k += 1) {
    const sentMs = now();
    const serverMs = await ask();
    exchanges.push(exchange(sentMs, serverMs, now()));
  }
  return best(exchanges);
}
