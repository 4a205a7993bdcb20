// Guidance to a person: arrow, distance and instruction, large enough for gloves and smoke.

import { isFresh, reachM } from "./age.js";
import { degrees } from "./angles.js";
import { arrow, make, setAttribute, setText } from "./dom.js";
import { Announcer, guidance, spoken, Trend, TREND_WORDS } from "./finding.js";
import { ago, distance, plusMinus, probability } from "./words.js";

const TREND_SIGNS = { warmer: "▲", colder: "▼", same: "=" };

/**
 * `actions`: close(), next(by) for the next target, swap() (absent on a phone: there the seeker is
 * its wearer).
 */
export class FindView {
  constructor(section, actions) {
    this.section = section;
    this.from = null;
    this.to = null;
    this.trend = new Trend();
    this.announcer = new Announcer();
    this.previous = null;
    this.aloud = false;
    this.title = make("h2", { id: "find-title", tabindex: "-1" });
    this.arrow = arrow("big-arrow");
    this.distance = make("p", { class: "distance" });
    this.order = make("p", { class: "order" });
    this.trendSign = make("span", { "aria-hidden": "true" });
    this.trendWords = make("span");
    this.trendLine = make("p", { class: "trend", "data-trend": "none" }, this.trendSign, this.trendWords);
    this.sure = make("p", { class: "sure" });
    this.caution = make("p", { class: "caution" });
    this.voice = make("p", { class: "unseen", role: "status", "aria-live": "polite", "aria-atomic": "true" });
    const button = (text, action, attributes = {}) => {
      const element = make("button", { type: "button", text, ...attributes });
      element.addEventListener("click", action);
      return element;
    };
    this.aloudButton = button("Read aloud", () => this.setAloud(!this.aloud), { "aria-pressed": "false" });
    this.aloudButton.hidden = !("speechSynthesis" in globalThis);
    const buttons = [
      button("Close", actions.close, { class: "main" }),
      button("Next person", () => actions.next(1)),
      ...(actions.swap ? [button("Swap", actions.swap, { "aria-label": "Swap who seeks and who is sought" })] : []),
      this.aloudButton,
    ];
    section.append(
      this.title, this.arrow.element, this.distance, this.order, this.trendLine, this.sure,
      this.caution, make("div", { class: "actions" }, ...buttons), this.voice,
    );
    section.addEventListener("keydown", (event) => {
      if (event.key === "Escape") actions.close();
    });
  }

  get open() {
    return this.to !== null;
  }

  start(from, to, { focus = true } = {}) {
    this.from = from;
    this.to = to;
    this.trend = new Trend();
    this.announcer = new Announcer();
    this.previous = null;
    this.section.hidden = false;
    document.body.classList.add("finding");
    if (focus) this.title.focus();
  }

  stop() {
    this.from = this.to = null;
    this.section.hidden = true;
    document.body.classList.remove("finding");
    setText(this.voice, "");
    if (this.aloud) globalThis.speechSynthesis?.cancel();
  }

  setAloud(aloud) {
    this.aloud = aloud;
    setAttribute(this.aloudButton, "aria-pressed", String(aloud));
    this.announcer = new Announcer();
    if (!aloud) globalThis.speechSynthesis?.cancel();
  }

  update(team, connected = true) {
    if (!this.open) return;
    const [seeker, target] = [team.person(this.from), team.person(this.to)];
    const name = (person, node) => person?.name ?? `Node ${node}`;
    const targetName = name(target, this.to);
    const last = target !== null && !isFresh(target);
    const fresh = isFresh(seeker);
    setText(this.title, `${name(seeker, this.from)} → ${targetName}${last ? ": last place" : ""}`);
    setAttribute(this.section, "data-last", String(last || !fresh));
    setAttribute(this.title, "aria-label", `Guiding ${name(seeker, this.from)} to ${last ? "the last place of " : ""}${targetName}`);
    const relation = team.relation(this.from, this.to);
    const guide = guidance(relation, this.previous, { last, fresh });
    this.previous = guide.key;
    this.arrow.point(guide.arrowRad);
    setText(this.distance, relation ? distance(relation.distanceM, relation.sigmaM) : "?");
    setText(this.order, guide.words);
    // Nearer to a place is not warmer: the person may have gone on.
    if (last || !fresh) this.trend = new Trend();
    else if (relation && team.timeS !== null) this.trend.add(team.timeS, relation.distanceM);
    const trend = this.trend.direction;
    this.trendLine.hidden = last || !fresh;
    setAttribute(this.trendLine, "data-trend", trend ?? "none");
    setText(this.trendSign, TREND_SIGNS[trend] ?? "");
    setText(this.trendWords, TREND_WORDS[trend] ?? "warmer or colder: walk to find out");
    setText(this.sure, accuracyWords(seeker, target, relation));
    const caution = cautions(team, seeker, target, connected);
    setText(this.caution, caution);
    this.caution.hidden = caution === "";
    const key = `${guide.key} ${caution.replace(/\d+/g, "")}`;
    if (this.announcer.due(Date.now(), { key, distanceM: relation?.distanceM ?? 0, trend })) {
      this.say(`${spoken(last ? `last place of ${targetName}` : targetName, relation, guide, trend)} ${caution}`.trim());
    }
  }

  say(text) {
    setText(this.voice, text);
    if (!this.aloud) return;
    const synthesis = globalThis.speechSynthesis;
    // Voices of the device alone: others would be fetched from somewhere.
    const voice = synthesis.getVoices().find((v) => v.localService && v.lang.startsWith("en"));
    if (!voice) return;
    const words = new SpeechSynthesisUtterance(text);
    words.voice = voice;
    synthesis.cancel();
    synthesis.speak(words);
  }
}

/** Standard deviations of distance, direction and both positions, in words. */
export function accuracyWords(seeker, target, relation) {
  if (!relation) return "";
  const parts = [`distance ${plusMinus(relation.sigmaM)}`];
  if (relation.relativeRad !== null) parts.push(`direction ±${Math.round(degrees(relation.sigmaRad))}°`);
  for (const person of [seeker, target]) {
    if (Number.isFinite(person.sigma_major_m)) parts.push(`${person.name} ${plusMinus(person.sigma_major_m)}`);
  }
  return parts.join(" · ");
}

/** Reasons for caution; empty where there are none. */
export function cautions(team, seeker, target, connected) {
  const words = [];
  if (!connected) words.push("No connection: all of this is old.");
  for (const person of [target, seeker]) {
    if (!person) continue;
    if (person.status === "unlocated") words.push(`${person.name} is not located.`);
    else if (person.status === "lost" || person.status === "stale") {
      words.push(`${person.name}: last heard ${ago(person.seen_s)}, last known place, on foot up to ${distance(reachM(person), 9)} from there.`);
    } else if (person.status === "ambiguous") {
      const here = team.possible().here.get(person.node);
      words.push(here < 0.97
        ? `${person.name} may be elsewhere: ${probability(here)} where shown.`
        : `${person.name}: position not certain yet.`);
    }
  }
  return words.join(" ");
}
