// The sounds of alarms: pulses as in IEC 60601-1-8, vibration where there is some. WebAudio, which
// browsers allow after the first touch or key.

/** Pulses: [seconds from the start, hertz]; each lasts `pulseS`, the burst comes again after `everyS`. */
export const PATTERNS = {
  high: burst(523, 0.16, 10, [0, 0.26, 0.52, 0.98, 1.24, 2.1, 2.36, 2.62, 3.08, 3.34]),
  medium: burst(392, 0.2, 25, [0, 0.42, 0.84]),
  low: burst(330, 0.22, 30, [0, 0.5]),
  // No alarm of a person: two long falling tones.
  link: { pulseS: 0.45, everyS: 6, level: 0.5, pulses: [[0, 587], [0.5, 294]] },
  // What happened then: one soft tone, once.
  replay: { pulseS: 0.35, everyS: null, level: 0.12, pulses: [[0, 220]] },
};
const MUTE_MS = 120_000;
const VIBRATION = { high: [200, 80, 200, 80, 200, 250, 200, 80, 200], medium: [200, 150, 200, 150, 200], low: [200], link: [600] };
/** At least four harmonics: a sound with several is located by ear, and not lost behind a mask. */
const HARMONICS = [0, 1, 0.7, 0.6, 0.5, 0.4, 0.3];

function burst(hertz, pulseS, everyS, starts) {
  return { pulseS, everyS, level: 0.5, pulses: starts.map((at) => [at, hertz]) };
}

/** Schedule one burst of `kind` in an audio context. */
export function schedule(context, kind, startS) {
  const { pulseS, pulses, level } = PATTERNS[kind];
  const wave = context.createPeriodicWave(new Float32Array(HARMONICS.length), new Float32Array(HARMONICS));
  for (const [at, hertz] of pulses) {
    const [from, to] = [startS + at, startS + at + pulseS];
    const oscillator = context.createOscillator();
    const gain = context.createGain();
    oscillator.setPeriodicWave(wave);
    oscillator.frequency.value = hertz;
    gain.gain.setValueAtTime(0, from);
    gain.gain.linearRampToValueAtTime(level, from + 0.02);
    gain.gain.setValueAtTime(level, to - 0.02);
    gain.gain.linearRampToValueAtTime(0, to);
    oscillator.connect(gain).connect(context.destination);
    oscillator.start(from);
    oscillator.stop(to + 0.01);
  }
}

export class Siren {
  constructor(onChange) {
    this.onChange = onChange;
    this.context = null;
    this.mutedUntilMs = 0;
    this.unmuting = null;
    this.kind = null;
    this.timer = null;
    // The sound's own button decides for itself.
    const unlock = (event) => {
      if (!event.target.closest?.("[data-sound]")) this.unlock();
    };
    addEventListener("pointerdown", unlock);
    addEventListener("keydown", unlock);
  }

  /** Whether sound is off for a while. */
  get muted() {
    return Date.now() < this.mutedUntilMs;
  }

  /** "on", "muted", or "locked" until the first touch or key. */
  get state() {
    if (this.muted) return "muted";
    return this.context?.state === "running" ? "on" : "locked";
  }

  async unlock() {
    if (this.context?.state === "running") return;
    const Context = globalThis.AudioContext ?? globalThis.webkitAudioContext;
    if (!Context) return;
    this.context ??= new Context();
    try {
      await this.context.resume();
    } catch {
      // Not a gesture after all: the next one will do, and the page says "locked" until then.
    }
    // What has been waiting is heard at once.
    this.restart();
    this.onChange();
  }

  /** Seconds until the sound is back. */
  get mutedS() {
    return Math.max(0, Math.ceil((this.mutedUntilMs - Date.now()) / 1000));
  }

  /** Off for two minutes at most: it comes back by itself. */
  mute(muted) {
    clearTimeout(this.unmuting);
    this.mutedUntilMs = muted ? Date.now() + MUTE_MS : 0;
    if (muted) this.unmuting = setTimeout(() => this.mute(false), MUTE_MS);
    this.restart();
    this.onChange();
  }

  /** Let it be heard once that there is sound. */
  async test() {
    await this.unlock();
    if (this.kind === null) this.once("low");
  }

  /** A key of PATTERNS, or null. */
  sound(kind) {
    if (kind === this.kind) return;
    this.kind = kind;
    this.restart();
  }

  restart() {
    clearInterval(this.timer);
    this.timer = null;
    if (this.kind === null) {
      if (navigator.userActivation?.hasBeenActive) navigator.vibrate?.(0);
      return;
    }
    const once = () => this.once(this.kind);
    once();
    const { everyS } = PATTERNS[this.kind];
    if (everyS !== null) this.timer = setInterval(once, everyS * 1000);
  }

  once(kind) {
    // Without a touch before, browsers refuse and complain.
    if (navigator.userActivation?.hasBeenActive && VIBRATION[kind]) navigator.vibrate?.(VIBRATION[kind]);
    if (this.state === "on") schedule(this.context, kind, this.context.currentTime + 0.02);
  }
}
