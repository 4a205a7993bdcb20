// Landmark presses, stored on the phone until the server confirms them.

const KEY = "relpos.presses";
export const UNDO_MS = 5000;

/**
 * A press is {id, node, landmark, unix_ms, offset_ms}; `unix_ms` is this device's clock when the
 * button went down, `offset_ms` the server's clock minus it if it was known then. A press can be
 * undone for five seconds and is sent afterwards.
 */
export class PressQueue {
  constructor(storage, { now = () => Date.now(), newId = randomId } = {}) {
    this.storage = storage;
    this.now = now;
    this.newId = newId;
    this.acknowledged = 0;
  }

  /** As they are stored: another tab of this browser has the same. */
  get presses() {
    const kept = this.storage.getItem(KEY);
    try {
      const presses = JSON.parse(kept ?? "[]");
      return Array.isArray(presses) ? presses : [];
    } catch {
      // Unreadable presses cannot be sent: stored elsewhere instead of overwritten.
      this.storage.setItem(`${KEY}.unreadable`, kept);
      return [];
    }
  }

  press(node, landmark, offsetMs = null, unixMs = this.now()) {
    const press = { id: this.newId(), node, landmark, unix_ms: unixMs, offset_ms: offsetMs };
    this.keep([...this.presses, press]);
    return press;
  }

  /** Undo the newest press; null where its five seconds are over. */
  undo() {
    const { presses } = this;
    const last = presses.pop();
    if (!last || !this.isHeld(last)) return null;
    this.keep(presses);
    return last;
  }

  isHeld(press) {
    const age = this.now() - press.unix_ms;
    // Otherwise a clock that was set back would hold presses for ever.
    return age >= 0 && age < UNDO_MS;
  }

  get newest() {
    return this.presses[this.presses.length - 1] ?? null;
  }

  get waiting() {
    return this.presses.length;
  }

  /** What may be sent now, in batches of one wearer and one clock offset each. */
  batches(offsetNowMs) {
    const batches = new Map();
    for (const press of this.presses) {
      if (this.isHeld(press)) continue;
      const offsetMs = press.offset_ms ?? offsetNowMs;
      const key = `${press.node} ${offsetMs}`;
      if (!batches.has(key)) {
        batches.set(key, { node: press.node, clock_offset_ms: offsetMs, presses: [] });
      }
      const { id, landmark, unix_ms } = press;
      batches.get(key).presses.push({ id, landmark, unix_ms });
    }
    return [...batches.values()];
  }

  /** Remove the presses that the server has confirmed. */
  accepted(ids) {
    const gone = new Set(ids);
    const before = this.presses;
    const left = before.filter((press) => !gone.has(press.id));
    this.acknowledged += before.length - left.length;
    this.keep(left);
  }

  keep(presses) {
    this.storage.setItem(KEY, JSON.stringify(presses));
  }
}

/** A random UUID; crypto.randomUUID is there over HTTPS alone. */
export function randomId() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  bytes[6] = (bytes[6] & 0x0f) | 0x40;
  bytes[8] = (bytes[8] & 0x3f) | 0x80;
  const hex = [...bytes].map((b) => b.toString(16).padStart(2, "0")).join("");
  return hex.replace(/^(.{8})(.{4})(.{4})(.{4})(.{12})$/, "$1-$2-$3-$4-$5");
}
