// Floors: who is on which, the switch above the map, and the building from the side.

import { inkOn } from "./colours.js";
import { byId, make, setAttribute, setText } from "./dom.js";
import { number, t } from "./i18n.js";
import { pathMarker, signOf } from "./marker.js";
import { isPlaced } from "./relation.js";
import { toScreen } from "./transform.js";

/** A floor that is less probable is shown as not known. */
const LEAST = 0.5;
/** From this standard deviation of the height on no floor is known; between floors it is less. */
const VAGUE_M = 1.5;
const PALE = 0.45;
/** Height of the section that is shown at least. */
const LEAST_M = 4;

/** What people call a floor. */
let names = {};
export function nameFloors(given = {}) {
  names = given;
}

/** "basement", or "floor -1" where nobody has named it. */
export function floorWords(floor) {
  return names[floor] ?? t("state.floor", { floor });
}

const titleOf = (floor) => names[floor] ?? t("floors.title", { floor });

/** The floor that a person is on, 0 being the start's; null where it is not known. */
export function floorOf(person) {
  return Number.isInteger(person?.floor) && (person.floor_probability ?? 1) >= LEAST ? person.floor : null;
}

/** Whether nobody can say the floor: a node without pressure, or one that joined late. */
export function floorUnknown(person) {
  return floorOf(person) === null && person.sigma_z_m > VAGUE_M;
}

/** By how many floors `to` is above `from`; null where it is not known. */
export function floorsApart(from, to) {
  const [a, b] = [floorOf(from), floorOf(to)];
  return a === null || b === null ? null : b - a;
}

/** "two floors above you"; empty on the same floor and where it is not known. */
export function apartWords(apart) {
  if (!apart) return "";
  return t(apart > 0 ? "floors.above" : "floors.below", { count: Math.abs(apart) });
}

/** All floors with somebody on them, the highest first. */
export function floorsOf(people) {
  return [...new Set(people.map(floorOf).filter((floor) => floor !== null))].sort((a, b) => b - a);
}

export class Floors {
  /** `changed` is called when another floor is chosen, `name` gets a floor and what it is called. */
  constructor(team, changed, name) {
    this.team = team;
    this.changed = changed;
    /** What the chosen floor is called: a field below the buttons. */
    this.field = make("input", { type: "text", maxlength: "40" });
    this.field.addEventListener("change", () => {
      name(this.chosen, this.field.value);
      this.field.blur();
    });
    /** The chosen floor; null: all. */
    this.chosen = null;
    this.buttons = byId("floors");
    this.section = byId("section");
    this.canvas = byId("section-canvas");
    this.section.addEventListener("toggle", changed);
  }

  choose(floor) {
    this.chosen = floor;
    this.field.value = names[floor] ?? "";
    this.changed();
  }

  /** Whether the map shows a person as ever: on the chosen floor, or nobody knows on which. */
  isHere(person) {
    const floor = floorOf(person);
    return this.chosen === null || floor === null || floor === this.chosen;
  }

  update() {
    const people = this.team.list();
    const floors = floorsOf(people);
    if (this.chosen !== null && !floors.includes(this.chosen)) floors.push(this.chosen);
    floors.sort((a, b) => b - a);
    this.buttons.hidden = this.section.hidden = floors.length < 2 && this.chosen === null;
    const count = (floor) => this.team.wearers().filter((p) => floorOf(p) === floor).length;
    const wanted = floors.map((f) => `${f}:${count(f)}`).join() + document.documentElement.lang + JSON.stringify(names);
    this.field.hidden = this.chosen === null;
    setAttribute(this.field, "aria-label", t("floors.name"));
    setAttribute(this.field, "placeholder", t("floors.name"));
    if (this.buttons.dataset.floors !== wanted && document.activeElement !== this.field) {
      this.buttons.dataset.floors = wanted;
      const focused = document.activeElement?.dataset?.floor;
      this.buttons.replaceChildren(this.button(null, t("floors.all")), ...floors.map((floor) => this.button(
        floor, t("floors.count", { floor: titleOf(floor), count: count(floor) }),
      )), this.field);
      if (focused !== undefined) this.buttons.querySelector(`[data-floor="${focused}"]`)?.focus();
    }
    for (const button of this.buttons.querySelectorAll("button")) {
      setAttribute(button, "aria-pressed", String(button.dataset.floor === String(this.chosen)));
    }
    setAttribute(this.canvas, "aria-label", floors.map((floor) => t("floors.on", {
      floor: titleOf(floor), names: people.filter((p) => floorOf(p) === floor).map((p) => p.name).join(", "),
    })).join(". "));
  }

  button(floor, text) {
    const button = make("button", { type: "button", "data-floor": String(floor) });
    setText(button, text);
    button.addEventListener("click", () => this.choose(floor));
    return button;
  }

  /** Somebody on another floor: pale, with an arrow and how many floors it is. */
  drawElsewhere(map, person) {
    const { context, view, colours, unit } = map;
    const [px, py] = toScreen(view, person.x_m, person.y_m);
    const apart = floorOf(person) - this.chosen;
    context.globalAlpha = PALE;
    context.strokeStyle = map.colourOf(person.node);
    context.fillStyle = colours.ground;
    context.lineWidth = 2.5 * unit;
    pathMarker(context, person, px, py, 9 * unit);
    context.fill();
    context.stroke();
    context.globalAlpha = 0.8;
    context.fillStyle = colours.soft;
    context.font = map.font(11, true);
    context.textBaseline = "middle";
    context.textAlign = "center";
    context.fillText(signOf(person), px, py + 0.5 * unit);
    context.textAlign = "left";
    context.fillText(`${apart > 0 ? "▲" : "▼"}${number(Math.abs(apart))}`, px + 12 * unit, py);
    context.globalAlpha = 1;
  }

  /** The building from the side: height over where people stand on the map, left to right. */
  drawSection(map) {
    if (this.section.hidden || !this.section.open) return;
    const { colours, unit } = map;
    const ratio = Math.min(globalThis.devicePixelRatio || 1, 3);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      [this.canvas.width, this.canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    }
    const context = this.canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = colours.ground;
    context.fillRect(0, 0, width, height);
    const people = this.team.list().filter((p) => isPlaced(p) && Number.isFinite(p.z_m));
    if (!people.length) return;
    const heights = people.map((p) => p.z_m);
    const low = Math.min(...heights) - 1.5;
    const span = Math.max(Math.max(...heights) + 1.5 - low, LEAST_M);
    const margin = 14 * unit;
    const up = (z) => height - margin - ((z - low) / span) * (height - 2 * margin);
    const places = people.map((p) => toScreen(map.view, p.x_m, p.y_m)[0]);
    const [left, right] = [Math.min(...places), Math.max(...places)];
    const across = (px) => 30 * unit + ((px - left) / Math.max(right - left, 1)) * (width - 60 * unit);
    context.font = map.font(11, false);
    context.textBaseline = "middle";
    for (const floor of floorsOf(people)) {
      const on = people.filter((p) => floorOf(p) === floor);
      const z = on.reduce((sum, p) => sum + p.z_m, 0) / on.length;
      context.strokeStyle = colours.grid;
      context.lineWidth = (floor === this.chosen ? 3 : 1.5) * unit;
      context.beginPath();
      context.moveTo(0, up(z));
      context.lineTo(width, up(z));
      context.stroke();
      context.fillStyle = colours.soft;
      context.textAlign = "left";
      context.fillText(names[floor] ?? number(floor), 3 * unit, up(z) - 8 * unit);
    }
    people.forEach((person, k) => {
      const colour = map.colourOf(person.node);
      context.globalAlpha = this.isHere(person) ? 1 : PALE;
      context.fillStyle = colour;
      pathMarker(context, person, across(places[k]), up(person.z_m), 9 * unit);
      context.fill();
      context.globalAlpha = 1;
      context.fillStyle = this.isHere(person) ? inkOn(colour) : colours.ink;
      context.textAlign = "center";
      context.fillText(signOf(person), across(places[k]), up(person.z_m) + 0.5 * unit);
    });
  }
}
