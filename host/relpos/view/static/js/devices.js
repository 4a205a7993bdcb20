// The dialog that lets devices in: of a mission, one by one and with a role; else by one code.

import { byId, make, postJson, setText } from "./dom.js";
import { t, timeOfDay } from "./i18n.js";

const LOOK_MS = 2000;
/** A code is good for five minutes: it is renewed before. */
const RENEW_MS = 240_000;

export class DevicesDialog {
  constructor() {
    this.dialog = byId("phones-dialog");
    this.image = byId("qr");
    this.role = byId("invite-role");
    this.count = null;
    this.timer = null;
    byId("phones").addEventListener("click", () => this.open());
    this.role.addEventListener("change", () => this.invite());
    this.dialog.addEventListener("close", () => clearInterval(this.timer));
  }

  async open() {
    this.dialog.showModal();
    await this.invite();
    await this.look();
    clearInterval(this.timer);
    this.timer = setInterval(() => this.look(), LOOK_MS);
  }

  async invite() {
    const answer = await fetch(`/api/invite?role=${this.role.value}`, { cache: "no-store" }).catch(() => null);
    this.mission = Boolean(answer) && answer.status !== 404;
    this.invitedMs = Date.now();
    byId("mission-devices").hidden = !this.mission;
    byId("session-token").hidden = this.mission;
    if (this.mission && answer.ok) {
      const { url, svg, reachable } = await answer.json();
      this.image.src = `data:image/svg+xml;utf8,${encodeURIComponent(svg)}`;
      setText(byId("invite-url"), url);
      return this.show(reachable ? null : t("phones.unreachable"));
    }
    if (this.mission) return this.show(answer.status === 403 ? t("phones.commander") : t("server.silent"));
    const code = answer ? await fetch("/qr.svg").catch(() => null) : null;
    if (code?.ok) this.image.src = "/qr.svg";
    return this.show(code?.ok ? null : t(code?.status === 404 ? "phones.unreachable" : "server.silent"));
  }

  show(trouble) {
    this.image.hidden = trouble !== null;
    byId("qr-trouble").hidden = trouble === null;
    setText(byId("qr-trouble"), trouble ?? "");
  }

  async look() {
    if (!this.mission) return;
    const answer = await fetch("/api/devices", { cache: "no-store" }).catch(() => null);
    if (!answer?.ok) return;
    const { own, devices } = await answer.json();
    // A code that was used is no code any more.
    if ((this.count !== null && devices.length > this.count) || Date.now() - this.invitedMs > RENEW_MS) await this.invite();
    this.count = devices.length;
    byId("devices").replaceChildren(...devices.filter((device) => !device.revoked).map((device) => {
      const remove = make("button", { type: "button", "data-t": "phones.revoke", "aria-label": t("phones.revoke.name", { name: device.id }) });
      remove.addEventListener("click", async () => {
        await postJson("/api/revoke", { id: device.id }).catch(() => {});
        this.look();
      });
      return make("li", {}, t(device.id === own ? "phones.own" : "phones.device", { role: t(`role.${device.role}`), time: timeOfDay(1000 * device.admitted_unix_s) }), device.id === own ? "" : remove);
    }));
  }
}
