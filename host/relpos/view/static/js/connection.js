// The WebSocket: reconnects by itself, tells silence from loss, and notices sleep.

import { moment, sinceS } from "./age.js";
import { delayS, judge, SILENT_S } from "./backoff.js";

const TICK_MS = 500;

/**
 * `onMessage(object, ageS)` gets every message, and how old it is at most; `onState(state)` every change of it: "connecting",
 * "live", "silent" (connected, but nothing comes), "waiting" (until the next attempt) or "refused"
 * (the server does not know our token). A picture is asked for `restMs` after the last one: one air carries all phones.
 */
export class Connection {
  constructor({ onMessage, onState, restMs = 0 }) {
    this.restMs = restMs;
    this.onMessage = onMessage;
    this.onState = onState;
    this.state = "connecting";
    this.failures = 0;
    this.unreadable = 0;
    this.socket = null;
    this.heard = null;
    this.failed = null;
    this.delayS = 0;
    this.askedFor = null;
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
      ? Math.max(0, Math.ceil(this.delayS - sinceS(this.failed)))
      : null;
  }

  /** Try at once: by hand, or after sleep. */
  wake() {
    const silent = this.heard === null || sinceS(this.heard) > SILENT_S;
    const resting = this.state === "waiting" || this.state === "refused";
    if (resting || (silent && this.state !== "connecting")) {
      this.failures = 0;
      this.open();
    }
  }

  open() {
    this.close();
    this.set("connecting");
    const address = new URL("/ws?answers", location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(address);
    this.socket = socket;
    this.opened = moment();
    // The first view was made before it is asked for, by so much as the server says.
    this.askedFor = this.opened;
    socket.onmessage = (event) => {
      if (socket !== this.socket) return;
      this.heard = moment();
      this.failures = 0;
      this.set("live");
      let message;
      try {
        message = JSON.parse(event.data);
      } catch {
        this.unreadable += 1;
        return;
      }
      if (message.type === "you") this.askedFor = moment(sinceS(this.opened) + (message.view_age_s ?? 0));
      this.onMessage(message, sinceS(this.askedFor));
      if (message.type !== "picture") return;
      const ask = () => {
        if (socket !== this.socket || socket.readyState !== WebSocket.OPEN) return;
        // The next one is made after this word: no older than the time since.
        this.askedFor = moment();
        socket.send("");
      };
      if (this.restMs) setTimeout(ask, this.restMs);
      else ask();
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
    this.failed = moment();
    this.delayS = delayS(this.failures);
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
      if (sinceS(this.failed) >= this.delayS) this.open();
    } else if (this.state === "connecting") {
      if (sinceS(this.opened) > 8) this.fail();
    } else {
      const judged = judge(sinceS(this.heard));
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
