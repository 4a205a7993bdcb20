// The map as a table: what it draws, in words.

import { isFresh, reachM } from "./age.js";
import { make, setText } from "./dom.js";
import { number as figure, t } from "./i18n.js";
import { isPlaced, VAGUE_RAD } from "./relation.js";
import {
  ago, compass, distance, healthWords, nodeName, probability, seconds, statusWords, UNKNOWN, whereabouts,
} from "./words.js";

/** The columns: attributes of the header, and the text of a person's cell. */
const COLUMNS = [
  [{ "data-t": "table.person" }, (person) => person.name],
  [{ "data-t": "table.state" }, stateOf],
  [{ text: "x (m)" }, (person) => coordinate(person, person.x_m)],
  [{ text: "y (m)" }, (person) => coordinate(person, person.y_m)],
  [{ text: "± (m)" }, (person) => coordinate(person, person.sigma_major_m + reachM(person))],
  [{ "data-t": "table.faces" }, facing],
  [{ id: "from-title" }, from],
  [{ "data-t": "table.ranges" }, rangesOf],
];

const number = (value) => (Number.isFinite(value) ? figure(value, 1) : UNKNOWN);
const coordinate = (person, value) => (isPlaced(person) ? number(value) : UNKNOWN);

function stateOf(person) {
  return [person.post ? t("post") : statusWords(person.status), isFresh(person) ? "" : t("table.heard", { ago: ago(person.seen_s) }),
    person.moving === false && !person.post ? t("map.still", { time: seconds(person.still_s) }) : "",
    healthWords(person.health)].filter(Boolean).join(", ");
}

function facing(person, team) {
  const faces = isFresh(person) && !person.post && Number.isFinite(person.heading_rad) && (person.sigma_heading_rad ?? 0) < VAGUE_RAD;
  return isPlaced(person) && faces ? compass(person.heading_rad, team.northRad) : UNKNOWN;
}

function from(person, team, me) {
  if (me === null) return UNKNOWN;
  if (me === person.node) return t("me");
  const where = whereabouts(team.relation(me, person.node), team.northRad);
  return isFresh(person) ? where : t("table.from-last", { where });
}

function rangesOf(person, team) {
  return team.ranges
    .filter(([node, peer]) => node === person.node || peer === person.node)
    .map(([node, peer, rangeM]) => {
      const other = team.person(node === person.node ? peer : node);
      return `${other?.name ?? "?"} ${figure(rangeM, 1)}`;
    }).join(", ") || UNKNOWN;
}

export function updateTable(table, team, me) {
  const header = table.tHead.rows[0];
  if (!header.cells.length) header.append(...COLUMNS.map(([attributes]) => make("th", { scope: "col", ...attributes })));
  const body = table.tBodies[0];
  const people = team.list();
  while (body.rows.length > people.length) body.deleteRow(-1);
  people.forEach((person, k) => {
    let row = body.rows[k];
    if (!row) {
      row = body.insertRow();
      row.append(make("th", { scope: "row" }), ...COLUMNS.slice(1).map(() => make("td")));
    }
    COLUMNS.forEach(([, cell], c) => setText(row.cells[c], cell(person, team, me)));
  });
}

/** The other possible places in words; empty while nothing is ambiguous. */
export function alternativeWords(team) {
  const { here, places, rings } = team.possible();
  const name = (node) => team.person(node)?.name ?? nodeName(node);
  const placed = (place) => ({
    name: name(place.node), probability: probability(place.probability), radius: distance(place.sigma_major_m),
    x: number(place.x_m), y: number(place.y_m),
  });
  const words = rings.map((ring) => t("other.ring", placed(ring)));
  const listed = new Set();
  for (const place of places) {
    if (!listed.has(place.node) && here.has(place.node)) {
      words.push(t("other.shown", { name: name(place.node), probability: probability(here.get(place.node)) }));
    }
    listed.add(place.node);
    words.push(t(place.shape === "ring" ? "other.on-ring" : "other.at", placed(place)));
  }
  return words.join(" ");
}
