// Keeping the screen on: browsers allow it over HTTPS alone, and let go when the page is hidden.

import { t } from "./i18n.js";

export class ScreenLock {
  constructor(onChange) {
    this.onChange = onChange;
    this.wanted = false;
    this.held = null;
    this.trouble = "";
    document.addEventListener("visibilitychange", () => {
      if (this.wanted && document.visibilityState === "visible") this.take();
    });
  }

  get possible() {
    return "wakeLock" in navigator;
  }

  async set(wanted) {
    this.wanted = wanted;
    this.trouble = "";
    if (wanted) {
      await this.take();
    } else {
      await this.held?.release();
      this.held = null;
    }
    this.onChange();
  }

  async take() {
    if (this.held && !this.held.released) return;
    try {
      this.held = await navigator.wakeLock.request("screen");
      this.held.addEventListener("release", () => this.onChange());
      this.trouble = "";
    } catch (error) {
      this.trouble = t("wake.refused", { error: error.message });
    }
    this.onChange();
  }

  get on() {
    return Boolean(this.held && !this.held.released);
  }
}
