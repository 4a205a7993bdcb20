// Shares the phone's compass; explains why it cannot.

import { t } from "./i18n.js";
import { headingOfEvent, meanHeading } from "./compass.js";

const EVERY_MS = 1000;
const MAX_KEPT = 120; // two minutes without connection; older headings are of no use

export class CompassSharing {
  constructor(onChange) {
    this.onChange = onChange;
    this.on = false;
    this.status = "";
    this.newest = null;
    this.kept = [];
    this.sent = 0;
    this.dropped = 0;
    this.readings = [];
    this.heard = (event) => this.take(event);
  }

  /** Why the compass cannot be shared; empty where it can be tried. */
  static obstacle() {
    if (!globalThis.isSecureContext) return t("compass.insecure");
    if (!("DeviceOrientationEvent" in globalThis)) return t("compass.none");
    return "";
  }

  async start() {
    this.status = CompassSharing.obstacle();
    if (this.status) return this.onChange();
    const ask = globalThis.DeviceOrientationEvent.requestPermission;
    if (typeof ask === "function") {
      // iOS: asked for from a touch, once.
      const answer = await ask.call(globalThis.DeviceOrientationEvent).catch(() => "denied");
      if (answer !== "granted") {
        this.status = t("compass.denied");
        return this.onChange();
      }
    }
    this.on = true;
    this.status = t("compass.waiting");
    addEventListener("deviceorientationabsolute", this.heard);
    addEventListener("deviceorientation", this.heard);
    this.timer = setInterval(() => this.collect(), EVERY_MS);
    this.silence = setTimeout(() => {
      if (!this.newest) {
        this.status = t("compass.silent");
        this.onChange();
      }
    }, 5000);
    return this.onChange();
  }

  stop() {
    this.on = false;
    this.status = "";
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
    this.status = "";
    // The mean of a second belongs to the middle of it.
    const unixMs = readings.reduce((sum, r) => sum + r.ms, 0) / readings.length;
    this.kept.push({ unix_ms: unixMs, ...this.newest });
    if (this.kept.length > MAX_KEPT) {
      this.kept.shift();
      this.dropped += 1;
    }
    this.onChange();
  }

  /** Take all headings that are due to be sent. */
  takeAll() {
    const headings = this.kept;
    this.kept = [];
    return headings;
  }

  /** Put back headings that could not be sent. */
  putBack(headings) {
    this.kept = [...headings, ...this.kept].slice(-MAX_KEPT);
  }
}
