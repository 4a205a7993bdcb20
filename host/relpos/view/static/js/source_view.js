// Before a session: the commander chooses the mission's source, and starts.

import { byId, make, postJson, setText } from "./dom.js";
import { t } from "./i18n.js";

const LOOK_MS = 2000;
const DEMO = "demo";
const PATH = "";

export class SourceView {
  constructor() {
    this.shown = "";
    byId("source-path").addEventListener("input", () => this.choose(PATH));
    byId("source-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.start();
    });
  }

  /** Show the form while no session runs. */
  show(waiting) {
    byId("source").hidden = !waiting;
    clearInterval(this.timer);
    if (!waiting) return;
    this.shown = "";
    byId("source-start").disabled = false;
    setText(byId("source-status"), "");
    byId("source-title").focus();
    this.timer = setInterval(() => this.look(), LOOK_MS);
    this.look();
  }

  /** Ports come and go with their cables. */
  async look() {
    const answer = await fetch("/api/sources", { cache: "no-store" }).catch(() => null);
    byId("source-form").hidden = !answer?.ok;
    byId("source-wait").hidden = Boolean(answer?.ok);
    if (!answer?.ok) return;
    const { ports, before, name, trouble } = await answer.json();
    const found = JSON.stringify(ports);
    if (found === this.shown) return;
    const first = this.shown === "";
    this.shown = found;
    // What was typed stays chosen, whatever is plugged in meanwhile.
    const typed = this.chosen === PATH || (first && byId("source-path").value);
    const chosen = typed ? PATH : this.chosen ?? before;
    const known = ports.some((port) => port.source === chosen);
    byId("source-ports").replaceChildren(make("legend", { "data-t": "source" }),
      ...ports.map((port) => this.option(port.source, [port.source, port.text].filter((text) => text && text !== "n/a").join(" · "))),
      this.option(DEMO, null, "source.demo"),
      this.option(PATH, null, "source.other"));
    this.choose(known || chosen === DEMO ? chosen : chosen || typed ? PATH : ports[0]?.source ?? DEMO);
    if (!first) return;
    byId("source-name").value = name;
    if (chosen && !known && chosen !== DEMO) byId("source-path").value = chosen;
    setText(byId("source-status"), trouble);
  }

  option(value, text, key) {
    const words = key ? make("span", { "data-t": key }) : make("span", { text });
    return make("label", { class: "check" }, make("input", { type: "radio", name: "source", value }), words);
  }

  get chosen() {
    return byId("source-form").querySelector("input[name=source]:checked")?.value;
  }

  choose(value) {
    for (const input of byId("source-form").querySelectorAll("input[name=source]")) input.checked = input.value === value;
  }

  async start() {
    const source = this.chosen === PATH ? byId("source-path").value.trim() : this.chosen;
    if (!source) {
      setText(byId("source-status"), t("source.none"));
      byId("source-path").focus();
      return;
    }
    byId("source-start").disabled = true;
    setText(byId("source-status"), t("source.starting"));
    try {
      await postJson("/api/start", { source, name: byId("source-name").value, common: byId("source-common").checked });
      clearInterval(this.timer); // The page of the session comes by itself.
    } catch (error) {
      byId("source-start").disabled = false;
      setText(byId("source-status"), t("source.failed", { error: error.message }));
    }
  }
}
