// The list of people beside the map.

import { isFresh } from "./age.js";
import { hold } from "./board_view.js";
import { inkOn } from "./colours.js";
import { arrow, healthSign, make, setAttribute, setText } from "./dom.js";
import { floorOf, floorUnknown, floorWords } from "./floors.js";
import { t, said } from "./i18n.js";
import { signOf } from "./marker.js";
import {
  ago, compass, dbm, directionWords, distance, healthWords, percent, plusMinus, probability, seconds,
  timeOfDay, UNKNOWN, volts,
} from "./words.js";

/** An alarm of somebody who is known to be well: a sentry, a node on a table. */
const SHELVE_S = 600;

/** What a selected person's card says of the node: the word of a message, and the figure in words. */
const FACTS = [
  ["supply", (person) => volts(person.battery_v)],
  ["radio", (person) => dbm(person.rssi_dbm)],
  ["loss", (person) => percent(person.frame_loss)],
  ["ranging", (person) => percent(person.ranging)],
  ["hears", (person) => (Number.isFinite(person.neighbours) ? String(person.neighbours) : UNKNOWN)],
];

/** A person's state in words. */
export function stateWords(person, alarm, here) {
  if (person.post) return isFresh(person) ? t("post.state") : t("state.stale", { ago: ago(person.seen_s) });
  const words = [];
  if (alarm?.kind === "lost" || person.status === "lost") words.push(t("state.lost", { ago: ago(person.seen_s) }));
  else if (!isFresh(person)) words.push(t("state.stale", { ago: ago(person.seen_s) }));
  if (person.status === "unlocated") words.push(t("state.unlocated"));
  else if (person.status === "ambiguous") {
    words.push(here < 0.97 ? t("state.ambiguous-here", { probability: probability(here) }) : t("state.ambiguous"));
  }
  if (alarm?.kind === "fall") words.push(t("state.fell"));
  if (alarm?.kind === "still") words.push(t(isFresh(person) ? "state.still" : "state.was-still", { time: seconds(person.still_s) }));
  else if (person.moving === false && person.still_s >= 3 && isFresh(person)) {
    words.push(t("state.stands", { time: seconds(person.still_s) }));
  } else if (person.moving && isFresh(person)) words.push(t("state.moves"));
  if (floorOf(person) !== null) words.push(floorWords(floorOf(person)));
  else if (floorUnknown(person)) words.push(t("state.floor-unknown"));
  return words.join(" · ");
}

class Card {
  constructor(node, actions) {
    this.node = node;
    this.disc = make("span", { class: "disc" });
    this.label = make("span", { class: "label" });
    this.name = make("button", { type: "button", class: "name", "aria-pressed": "false" }, this.disc, this.label);
    this.sign = healthSign();
    this.health = make("span");
    this.arrow = arrow("small-arrow");
    this.far = make("span", { class: "far" });
    this.sigma = make("span", { class: "sigma" });
    this.direction = make("span", { class: "direction" });
    this.compass = make("span", { class: "compass" });
    this.where = make("div", { class: "where" }, this.arrow.element,
      make("p", {}, this.far, " ", this.sigma), make("p", {}, this.direction));
    this.state = make("p", { class: "state" });
    this.facts = FACTS.map(() => make("dd"));
    const facts = FACTS.map(([word], k) => make("div", {}, make("dt", { "data-t": `fact.${word}` }), this.facts[k]));
    this.reasons = make("p", { class: "reasons" });
    this.shelveButton = make("button", { type: "button" });
    this.shelveButton.addEventListener("click", () => actions.shelve(node, this.shelved ? 0 : SHELVE_S));
    this.maydayButton = make("button", { type: "button", class: "mayday", "data-t": "mayday.hold" });
    hold(this.maydayButton, () => actions.mayday(node));
    this.followButton = make("button", { type: "button", "aria-pressed": "false", "data-t": "follow" });
    this.findButton = make("button", { type: "button", "data-t": "find" });
    this.name.addEventListener("click", () => actions.select(node));
    this.followButton.addEventListener("click", () => actions.follow(node));
    this.findButton.addEventListener("click", () => actions.find(node));
    this.details = make("div", { class: "details" }, this.compass, this.reasons,
      make("dl", { class: "facts" }, ...facts), make("div", { class: "buttons" }, this.followButton, this.maydayButton, this.shelveButton));
    this.element = make("li", { class: "person", "data-node": node },
      make("div", { class: "who" }, this.name, make("span", { class: "health" }, this.sign.element, this.health)),
      this.where, this.findButton,
      this.state, this.details);
  }

  show(person, { colour, me, meName, relation, northRad, alarm, here, selected, followed, heardMs, meFresh }) {
    const { element } = this;
    const fresh = isFresh(person);
    setAttribute(element, "data-status", person.status);
    setAttribute(element, "data-health", person.health);
    setAttribute(element, "data-alert", alarm?.level ?? null);
    setAttribute(element, "data-selected", String(selected));
    if (this.colour !== colour) {
      this.colour = colour;
      this.disc.style.background = colour;
      this.disc.style.color = inkOn(colour);
    }
    setText(this.disc, signOf(person));
    setAttribute(element, "data-post", person.post ? "true" : null);
    // Nobody wears it: neither lies it too still, nor can it call.
    this.maydayButton.hidden = Boolean(person.post);
    setText(this.label, me ? t("name.me", { name: person.name }) : person.name);
    setAttribute(this.name, "aria-pressed", String(selected));
    this.sign.show(person.health);
    setText(this.health, fresh || person.health === "unknown" ? healthWords(person.health) : t("health.silent"));
    this.where.hidden = me || meName === null;
    this.shelved = person.shelved_s > 0;
    setText(this.shelveButton, this.shelved ? t("shelved.left", { time: seconds(person.shelved_s) }) : t("shelve"));
    this.details.hidden = !selected;
    setAttribute(this.name, "aria-expanded", String(selected));
    if (!this.where.hidden) {
      this.arrow.point(relation?.relativeRad ?? null);
      setText(this.far, relation ? distance(relation.distanceM, relation.sigmaM) : UNKNOWN);
      setText(this.sigma, !relation ? "" : fresh && meFresh ? plusMinus(relation.sigmaM) : lastPlace(fresh ? null : heardMs));
      setText(this.direction, !relation ? t("position.unknown")
        : directionWords(relation));
      setText(this.compass, relation ? compass(relation.bearingRad, northRad) : "");
    }
    setText(this.state, stateWords(person, alarm, here));
    FACTS.forEach(([, words], k) => setText(this.facts[k], words(person)));
    // That a node is silent is said above.
    setText(this.reasons, (person.reasons ?? []).map((reason, k) => [reason, person.said?.[k]]).filter(([reason]) => fresh || !reason.startsWith("silent"))
      .map(([reason, key]) => said(key, reason)).join("; "));
    setAttribute(this.followButton, "aria-pressed", String(followed));
    setAttribute(this.followButton, "aria-label", t("follow.name", { name: person.name }));
    setAttribute(this.findButton, "aria-label", t("find.name", { name: person.name }));
  }
}

export class PeopleList {
  constructor(list, actions) {
    this.list = list;
    this.actions = actions;
    this.cards = new Map();
  }

  /** `look` is {colourOf, me, selected, followed, alarms}. */
  update(team, look) {
    const { here } = team.possible();
    const people = [...team.list()].sort((a, b) => trouble(look.alarms, b) - trouble(look.alarms, a)
      || Number(a.post ?? false) - Number(b.post ?? false) || a.node - b.node);
    for (const [node, card] of this.cards) {
      if (!team.people.has(node)) {
        card.element.remove();
        this.cards.delete(node);
      }
    }
    people.forEach((person, place) => {
      let card = this.cards.get(person.node);
      if (!card) {
        card = new Card(person.node, this.actions);
        this.cards.set(person.node, card);
      }
      // Moving an element takes the focus from it: only what is out of place is moved.
      if (this.list.children[place] !== card.element) {
        const focused = card.element.contains(document.activeElement) ? document.activeElement : null;
        this.list.insertBefore(card.element, this.list.children[place] ?? null);
        focused?.focus();
      }
      card.show(person, {
        colour: look.colourOf(person.node),
        me: person.node === look.me,
        meName: team.person(look.me)?.name ?? null,
        relation: look.me === null ? null : team.relation(look.me, person.node),
        northRad: team.northRad,
        alarm: look.alarms.active.get(person.node),
        here: here.get(person.node),
        selected: person.node === look.selected,
        followed: person.node === look.followed,
        heardMs: team.heardMs(person.node),
        meFresh: isFresh(team.person(look.me)),
      });
    });
  }
}

/** Where a distance leads that is not one of now. */
function lastPlace(heardMs) {
  return heardMs === null ? t("last.place") : t("last.place.at", { time: timeOfDay(heardMs) });
}

function trouble(alarms, person) {
  const alarm = alarms.active.get(person.node);
  return alarm ? ["low", "medium", "high"].indexOf(alarm.level) + 1 : 0;
}
