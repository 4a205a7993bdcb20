// The WebSocket: reconnects by itself, tells silence from loss, and notices sleep.

import { delayS, judge, SILENT_S } from "./backoff.js";

const TICK_MS = 500;

/**
 * `onMessage(object)` gets every message, `onState(state)` every change of it: "connecting",
 * "live", "silent" (connected, but nothing comes), "waiting" (until the next attempt) or "refused"
 * (the server does not know our token).
 */
export class Connection {
  constructor({ onMessage, onState }) {
    this.onMessage = onMessage;
    this.onState = onState;
    this.state = "connecting";
    this.failures = 0;
    this.unreadable = 0;
    this.socket = null;
    this.heardMs = null;
    this.retryMs = 0;
    this.tickMs = Date.now();
  }

  start() {
    this.open();
    setInterval(() => this.tick(), TICK_MS);
    addEventListener("online", () => this.wake());
    addEventListener("pageshow", () => this.wake());
    document.addEventListener("visibilitychange", () => {
      if (document.visibilityState === "visible") this.wake();
    });
  }

  /** Seconds until the next attempt, rounded up; null while none is due. */
  get retryS() {
    return this.state === "waiting" || this.state === "refused"
      ? Math.max(0, Math.ceil((this.retryMs - Date.now()) / 1000))
      : null;
  }

  /** Try at once: by hand, or after sleep. */
  wake() {
    const silent = this.heardMs === null || Date.now() - this.heardMs > SILENT_S * 1000;
    const resting = this.state === "waiting" || this.state === "refused";
    if (resting || (silent && this.state !== "connecting")) {
      this.failures = 0;
      this.open();
    }
  }

  open() {
    this.close();
    this.set("connecting");
    const address = new URL("/ws", location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(address);
    this.socket = socket;
    this.openedMs = Date.now();
    socket.onmessage = (event) => {
      if (socket !== this.socket) return;
      this.heardMs = Date.now();
      this.failures = 0;
      this.set("live");
      let message;
      try {
        message = JSON.parse(event.data);
      } catch {
        this.unreadable += 1;
        return;
      }
      this.onMessage(message);
    };
    socket.onclose = () => {
      if (socket === this.socket) this.fail();
    };
  }

  close() {
    const socket = this.socket;
    this.socket = null;
    socket?.close();
  }

  fail() {
    this.close();
    this.retryMs = Date.now() + 1000 * delayS(this.failures);
    this.failures += 1;
    this.set("waiting");
    // A refusal looks like any other failure to a WebSocket.
    fetch("/api/time", { cache: "no-store" }).then(
      (answer) => {
        if (answer.status === 401 && this.state === "waiting") this.set("refused");
      },
      () => {},
    );
  }

  tick() {
    const now = Date.now();
    const slept = now - this.tickMs > 4000;
    this.tickMs = now;
    if (slept) {
      this.wake();
    } else if (this.state === "waiting" || this.state === "refused") {
      if (now >= this.retryMs) this.open();
    } else if (this.state === "connecting") {
      if (now - this.openedMs > 8000) this.fail();
    } else {
      const judged = judge((now - this.heardMs) / 1000);
      if (judged === "dead") this.fail();
      else this.set(judged);
    }
  }

  set(state) {
    if (state === this.state) return;
    this.state = state;
    this.onState(state);
  }
}
