// Guidance to a person: arrow, distance and instruction, large enough for gloves and smoke.

import { isFresh, reachM } from "./age.js";
import { degrees } from "./angles.js";
import { arrow, make, setAttribute, setHidden, setText } from "./dom.js";
import { Announcer, guidance, isThere, spoken, Trend } from "./finding.js";
import { apartWords, floorsApart } from "./floors.js";
import { current, number, t } from "./i18n.js";
import { ago, distance, nodeName, plusMinus, probability, whereabouts } from "./words.js";

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
    this.floor = make("p", { class: "floor" });
    this.trendSign = make("span", { "aria-hidden": "true" });
    this.trendWords = make("span");
    this.trendLine = make("p", { class: "trend", "data-trend": "none" }, this.trendSign, this.trendWords);
    this.sure = make("p", { class: "sure" });
    this.caution = make("p", { class: "caution" });
    this.voice = make("p", { class: "unseen", role: "status", "aria-live": "polite", "aria-atomic": "true" });
    const button = (key, action, attributes = {}) => {
      const element = make("button", { type: "button", "data-t": key, ...attributes });
      element.addEventListener("click", action);
      return element;
    };
    this.aloudButton = button("find.aloud", () => this.setAloud(!this.aloud), { "aria-pressed": "false" });
    this.aloudButton.hidden = !("speechSynthesis" in globalThis);
    const buttons = [
      button("close.button", actions.close, { class: "main" }),
      button("find.next", () => actions.next(1)),
      ...(actions.swap ? [button("find.swap", actions.swap, { "data-t-label": "find.swap.label" })] : []),
      this.aloudButton,
    ];
    section.append(
      this.title, this.arrow.element, this.distance, this.order, this.floor, this.trendLine, this.sure,
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
    const name = (person, node) => person?.name ?? nodeName(node);
    const targetName = name(target, this.to);
    const last = target !== null && !isFresh(target);
    const fresh = isFresh(seeker);
    setText(this.title, `${name(seeker, this.from)} → ${last ? t("find.last", { name: targetName }) : targetName}`);
    setAttribute(this.section, "data-last", String(last || !fresh));
    setAttribute(this.title, "aria-label", t(last ? "find.guiding-last" : "find.guiding", { from: name(seeker, this.from), to: targetName }));
    const relation = team.relation(this.from, this.to);
    const floor = fresh ? apartWords(floorsApart(seeker, target)) : "";
    let guide = guidance(relation, this.previous, { last, fresh });
    // Right above each other nobody is within reach.
    if (floor && relation && isThere(relation)) guide = { key: floor, words: floor, arrowRad: null };
    setText(this.floor, guide.words === floor ? "" : floor);
    setHidden(this.floor, this.floor.textContent === "");
    this.previous = guide.key;
    this.arrow.point(guide.arrowRad);
    setText(this.distance, relation ? distance(relation.distanceM, relation.sigmaM) : "?");
    setText(this.order, guide.words);
    // Nearer to a place is not warmer: the person may have gone on.
    if (last || !fresh) this.trend = new Trend();
    else if (relation && team.timeS !== null) this.trend.add(team.timeS, relation.distanceM);
    const trend = this.trend.direction;
    setHidden(this.trendLine, last || !fresh);
    setAttribute(this.trendLine, "data-trend", trend ?? "none");
    setText(this.trendSign, TREND_SIGNS[trend] ?? "");
    setText(this.trendWords, t(`find.${trend ?? "walk"}`));
    setText(this.sure, accuracyWords(seeker, target, relation));
    const caution = cautions(team, seeker, target, connected);
    const other = fresh && !last ? elsewhereWords(team, this.from, this.to) : "";
    setText(this.caution, `${caution} ${other}`.trim());
    setHidden(this.caution, this.caution.textContent === "");
    const key = `${guide.key} ${floor} ${caution.replace(/\d+/g, "")}`;
    if (this.announcer.due(Date.now(), { key, distanceM: relation?.distanceM ?? 0, trend })) {
      this.say(`${spoken(last ? t("find.last.spoken", { name: targetName }) : targetName, relation, guide, trend)} ${this.floor.textContent} ${this.caution.textContent}`.trim());
    }
  }

  say(text) {
    setText(this.voice, text);
    if (!this.aloud) return;
    const synthesis = globalThis.speechSynthesis;
    // Voices of the device alone: others would be fetched from somewhere.
    const voice = synthesis.getVoices().find((v) => v.localService && v.lang.startsWith(current()));
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
  const parts = [t("find.distance", { sigma: plusMinus(relation.sigmaM) })];
  if (relation.relativeRad !== null) parts.push(t("find.direction", { sigma: `±${number(degrees(relation.sigmaRad))}°` }));
  for (const person of [seeker, target]) {
    if (Number.isFinite(person.sigma_major_m)) parts.push(`${person.name} ${plusMinus(person.sigma_major_m)}`);
  }
  return parts.join(" · ");
}

/** Where else the other may be, as the seeker sees it; a phone has no map that shows it. */
function elsewhereWords(team, from, to) {
  const other = team.elsewhere(from, to);
  if (!other) return "";
  return t("caution.or", { probability: probability(other.probability), where: whereabouts(other.relation, team.northRad) });
}

/** Reasons for caution; empty where there are none. */
export function cautions(team, seeker, target, connected) {
  const words = [];
  if (!connected) words.push(t("caution.link"));
  for (const person of [target, seeker]) {
    if (!person) continue;
    if (person.status === "unlocated") words.push(t("caution.unlocated", { name: person.name }));
    else if (person.status === "lost" || person.status === "stale") {
      words.push(t("caution.last", { name: person.name, ago: ago(person.seen_s), distance: distance(reachM(person), 9) }));
    } else if (person.status === "ambiguous") {
      const here = team.possible().here.get(person.node);
      words.push(here < 0.97
        ? t("caution.elsewhere", { name: person.name, probability: probability(here) })
        : t("caution.uncertain", { name: person.name }));
    }
  }
  return words.join(" ");
}
