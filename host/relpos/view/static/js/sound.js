// The sound of alarms: WebAudio, which browsers allow after the first touch or key, and
// vibration where there is some.

const PATTERNS = {
  // [seconds from the start, hertz, seconds]; as a PASS alarm: a warning chirps, an alarm wails.
  warning: { every: 2.5, beeps: [[0, 1500, 0.12], [0.2, 1500, 0.12]] },
  alarm: {
    every: 1.2,
    beeps: [[0, 2000, 0.18], [0.2, 2900, 0.18], [0.4, 2000, 0.18], [0.6, 2900, 0.18]],
  },
};
const VIBRATION = { warning: [120, 80, 120], alarm: [400, 100, 400, 100, 400] };

export class Siren {
  constructor(onChange) {
    this.onChange = onChange;
    this.context = null;
    this.muted = false;
    this.kind = null;
    this.timer = null;
    // The sound's own button decides for itself.
    const unlock = (event) => {
      if (!event.target.closest?.("[data-sound]")) this.unlock();
    };
    addEventListener("pointerdown", unlock);
    addEventListener("keydown", unlock);
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
    this.onChange();
  }

  mute(muted) {
    this.muted = muted;
    this.restart();
    this.onChange();
  }

  /** "alarm", "warning" or null. */
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
    this.timer = setInterval(once, PATTERNS[this.kind].every * 1000);
  }

  once(kind) {
    // Without a touch before, browsers refuse and complain.
    if (navigator.userActivation?.hasBeenActive) navigator.vibrate?.(VIBRATION[kind]);
    if (this.state !== "on") return;
    const start = this.context.currentTime + 0.02;
    for (const [at, hertz, seconds] of PATTERNS[kind].beeps) {
      const oscillator = this.context.createOscillator();
      const gain = this.context.createGain();
      oscillator.type = "square";
      oscillator.frequency.value = hertz;
      gain.gain.setValueAtTime(0, start + at);
      gain.gain.linearRampToValueAtTime(kind === "alarm" ? 0.5 : 0.25, start + at + 0.01);
      gain.gain.setValueAtTime(kind === "alarm" ? 0.5 : 0.25, start + at + seconds - 0.01);
      gain.gain.linearRampToValueAtTime(0, start + at + seconds);
      oscillator.connect(gain).connect(this.context.destination);
      oscillator.start(start + at);
      oscillator.stop(start + at + seconds + 0.01);
    }
  }
}
