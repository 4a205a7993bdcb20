// The list of people beside the map, and the map as a table.

import { isFresh, reachM } from "./age.js";
import { hold } from "./board_view.js";
import { inkOn } from "./colours.js";
import { arrow, healthSign, make, setAttribute, setText } from "./dom.js";
import { isPlaced, VAGUE_RAD } from "./relation.js";
import {
  ago, compass, compassShort, dbm, distance, HEALTH_WORDS, percent, plusMinus, probability, seconds,
  STATUS_WORDS, timeOfDay, UNKNOWN, volts, whereabouts, directionWords,
} from "./words.js";

/** An alarm of somebody who is known to be well: a sentry, a node on a table. */
const SHELVE_S = 600;

/** A person's state in words. */
export function stateWords(person, alarm, here) {
  const words = [];
  if (alarm?.kind === "lost" || person.status === "lost") words.push(`Lost: last heard ${ago(person.seen_s)}`);
  else if (person.status === "stale") words.push(`Not heard: last news ${ago(person.seen_s)}`);
  else if (person.status === "unlocated") words.push("Not located yet");
  else if (person.status === "ambiguous") {
    words.push(here < 0.97 ? `Ambiguous: ${probability(here)} where shown` : "Ambiguous");
  }
  if (alarm?.kind === "still") words.push(`${isFresh(person) ? "Has" : "Had"} not moved for ${seconds(person.still_s)}`);
  else if (person.moving === false && person.still_s >= 3 && isFresh(person)) {
    words.push(`Stands still, ${seconds(person.still_s)}`);
  } else if (person.moving && isFresh(person)) words.push("Moves");
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
    this.facts = {};
    const facts = ["Supply", "Radio", "Loss", "Ranging", "Hears"].map((word) => {
      const value = make("dd");
      this.facts[word] = value;
      return make("div", {}, make("dt", { text: word }), value);
    });
    this.reasons = make("p", { class: "reasons" });
    this.shelveButton = make("button", { type: "button", text: "Shelve alarms 10 min" });
    this.shelveButton.addEventListener("click", () => actions.shelve(node, this.shelved ? 0 : SHELVE_S));
    this.maydayButton = make("button", { type: "button", class: "mayday", text: "MAYDAY (hold)" });
    hold(this.maydayButton, () => actions.mayday(node));
    this.followButton = make("button", { type: "button", "aria-pressed": "false", text: "Follow" });
    this.findButton = make("button", { type: "button", text: "Find" });
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
    setText(this.disc, String(person.node));
    setText(this.label, me ? `${person.name} (me)` : person.name);
    setAttribute(this.name, "aria-pressed", String(selected));
    this.sign.show(person.health);
    setText(this.health, fresh || person.health === "unknown" ? HEALTH_WORDS[person.health] ?? person.health : "node silent");
    this.where.hidden = me || meName === null;
    this.shelved = person.shelved_s > 0;
    setText(this.shelveButton, this.shelved ? `Alarms shelved, ${seconds(person.shelved_s)} left: end` : "Shelve alarms 10 min");
    this.details.hidden = !selected;
    setAttribute(this.name, "aria-expanded", String(selected));
    if (!this.where.hidden) {
      this.arrow.point(relation?.relativeRad ?? null);
      setText(this.far, relation ? distance(relation.distanceM, relation.sigmaM) : UNKNOWN);
      setText(this.sigma, !relation ? "" : fresh && meFresh ? plusMinus(relation.sigmaM) : lastPlace(fresh ? null : heardMs));
      setText(this.direction, !relation ? "position unknown"
        : directionWords(relation));
      setText(this.compass, relation ? compassShort(relation.bearingRad, northRad) : "");
    }
    setText(this.state, stateWords(person, alarm, here));
    const facts = {
      Supply: volts(person.battery_v), Radio: dbm(person.rssi_dbm),
      Loss: percent(person.loss), Ranging: percent(person.ranging),
      Hears: Number.isFinite(person.neighbours) ? String(person.neighbours) : UNKNOWN,
    };
    for (const [word, value] of Object.entries(facts)) setText(this.facts[word], value);
    // That a node is silent is said above.
    setText(this.reasons, (person.reasons ?? []).filter((reason) => fresh || !reason.startsWith("silent")).join("; "));
    setAttribute(this.followButton, "aria-pressed", String(followed));
    setAttribute(this.followButton, "aria-label", `Follow ${person.name}`);
    setAttribute(this.findButton, "aria-label", `Find ${person.name}`);
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
    const people = [...team.list()].sort((a, b) => trouble(look.alarms, b) - trouble(look.alarms, a) || a.node - b.node);
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
  return heardMs === null ? "to the last place" : `to the last place, ${timeOfDay(heardMs)}`;
}

function trouble(alarms, person) {
  const alarm = alarms.active.get(person.node);
  return alarm ? ["low", "medium", "high"].indexOf(alarm.level) + 1 : 0;
}

const number = (value) => (Number.isFinite(value) ? value.toFixed(1) : UNKNOWN);

/** The cells of one person's row: what the map draws, in words. */
export function tableRow(team, person, me) {
  const ranges = team.ranges
    .filter(([node, peer]) => node === person.node || peer === person.node)
    .map(([node, peer, rangeM]) => {
      const other = team.person(node === person.node ? peer : node);
      return `${other?.name ?? "?"} ${rangeM.toFixed(1)}`;
    });
  const faces = isFresh(person) && Number.isFinite(person.heading_rad) && (person.sigma_heading_rad ?? 0) < VAGUE_RAD;
  const placed = isPlaced(person);
  return [
    person.name,
    [STATUS_WORDS[person.status] ?? person.status, isFresh(person) ? "" : `last heard ${ago(person.seen_s)}`,
      person.moving === false ? `still ${seconds(person.still_s)}` : "",
      HEALTH_WORDS[person.health] ?? ""].filter(Boolean).join(", "),
    placed ? number(person.x_m) : UNKNOWN,
    placed ? number(person.y_m) : UNKNOWN,
    placed ? number(person.sigma_major_m + reachM(person)) : UNKNOWN,
    placed && faces ? compass(person.heading_rad, team.northRad) : UNKNOWN,
    me === null ? UNKNOWN : me === person.node ? "me" : `${whereabouts(team.relation(me, person.node), team.northRad)}${isFresh(person) ? "" : " (last place)"}`,
    ranges.join(", ") || UNKNOWN,
  ];
}

export function updateTable(body, team, me) {
  const rows = team.list().map((person) => tableRow(team, person, me));
  while (body.rows.length > rows.length) body.deleteRow(-1);
  rows.forEach((cells, k) => {
    let row = body.rows[k];
    if (!row) {
      row = body.insertRow();
      row.append(make("th", { scope: "row" }), ...cells.slice(1).map(() => make("td")));
    }
    cells.forEach((text, c) => setText(row.cells[c], text));
  });
}

/** The other possible places in words; empty while nothing is ambiguous. */
export function alternativeWords(team) {
  const { here, places, rings } = team.possible();
  const name = (node) => team.person(node)?.name ?? `Node ${node}`;
  const words = rings.map((ring) => `${name(ring.node)} is somewhere on a ring of ${distance(ring.sigma_major_m)} about x ${number(ring.x_m)}, y ${number(ring.y_m)}.`);
  const listed = new Set();
  for (const place of places) {
    if (!listed.has(place.node) && here.has(place.node)) {
      words.push(`${name(place.node)} is where shown with ${probability(here.get(place.node))}.`);
    }
    listed.add(place.node);
    words.push(place.shape === "ring"
      ? `With ${probability(place.probability)} ${name(place.node)} is on a ring of ${distance(place.sigma_major_m)} about x ${number(place.x_m)}, y ${number(place.y_m)}.`
      : `With ${probability(place.probability)} ${name(place.node)} is at x ${number(place.x_m)}, y ${number(place.y_m)}.`);
  }
  return words.join(" ");
}
