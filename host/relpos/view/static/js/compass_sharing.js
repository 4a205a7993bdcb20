// Listening to the phone's compass, and what may stand in the way.

import { headingOfEvent, meanHeading } from "./compass.js";

const EVERY_MS = 1000;
const MOST_KEPT = 120; // two minutes without connection; older headings help nobody

export const NOT_SECURE =
  "Phones give their compass over HTTPS alone. Let relpos be started with --https, and open its address.";

export class CompassSharing {
  constructor(onChange) {
    this.onChange = onChange;
    this.on = false;
    this.told = "";
    this.newest = null;
    this.kept = [];
    this.sent = 0;
    this.dropped = 0;
    this.readings = [];
    this.heard = (event) => this.take(event);
  }

  /** Why it cannot be shared at all; empty where it can be tried. */
  static obstacle() {
    if (!globalThis.isSecureContext) return NOT_SECURE;
    if (!("DeviceOrientationEvent" in globalThis)) return "This browser has no compass.";
    return "";
  }

  async start() {
    this.told = CompassSharing.obstacle();
    if (this.told) return this.onChange();
    const ask = globalThis.DeviceOrientationEvent.requestPermission;
    if (typeof ask === "function") {
      // iOS: asked for from a touch, once.
      const answer = await ask.call(globalThis.DeviceOrientationEvent).catch(() => "denied");
      if (answer !== "granted") {
        this.told = "The phone was told not to give its compass: allow motion and orientation in the browser's settings.";
        return this.onChange();
      }
    }
    this.on = true;
    this.told = "Waiting for the compass";
    addEventListener("deviceorientationabsolute", this.heard);
    addEventListener("deviceorientation", this.heard);
    this.timer = setInterval(() => this.collect(), EVERY_MS);
    this.silence = setTimeout(() => {
      if (!this.newest) {
        this.told = "No compass is heard from this phone.";
        this.onChange();
      }
    }, 5000);
    return this.onChange();
  }

  stop() {
    this.on = false;
    this.told = "";
    this.newest = null;
    removeEventListener("deviceorientationabsolute", this.heard);
    removeEventListener("deviceorientation", this.heard);
    clearInterval(this.timer);
    clearTimeout(this.silence);
    this.onChange();
  }

  take(event) {
    const reading = headingOfEvent(event, screen.orientation?.angle ?? 0);
    if (reading) this.readings.push({ ...reading, ms: Date.now() });
  }

  /** Once a second: the mean of what was read. */
  collect() {
    const readings = this.readings;
    this.readings = [];
    const heading = meanHeading(readings.map((r) => r.heading_rad));
    if (heading === null) return;
    this.newest = { heading_rad: heading, sigma_rad: readings[0].sigma_rad };
    this.told = "";
    // The mean of a second belongs to the middle of it.
    const unixMs = readings.reduce((sum, r) => sum + r.ms, 0) / readings.length;
    this.kept.push({ unix_ms: unixMs, ...this.newest });
    if (this.kept.length > MOST_KEPT) {
      this.kept.shift();
      this.dropped += 1;
    }
    this.onChange();
  }

  /** What is to be sent now. */
  takeAll() {
    const headings = this.kept;
    this.kept = [];
    return headings;
  }

  /** They could not be sent. */
  giveBack(headings) {
    this.kept = [...headings, ...this.kept].slice(-MOST_KEPT);
  }
}
