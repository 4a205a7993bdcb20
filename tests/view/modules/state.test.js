import { Alarms } from "/static/js/alarms.js";
import { delayS, judge } from "/static/js/backoff.js";
import { overlap, placeLabels, placeWhereFree } from "/static/js/labels.js";
import { Team } from "/static/js/team.js";
import { MAX_POINTS, Track } from "/static/js/tracks.js";
import { equal, near, ok, test } from "./check.js";

test("twenty labels in a crowd do not cover each other or a marker", () => {
  const items = [];
  for (let k = 0; k < 20; k += 1) {
    items.push({ id: k, x: 300 + 37 * (k % 5), y: 250 + 31 * Math.floor(k / 5), radius: 15, width: 70, height: 18 });
  }
  const placed = placeLabels(items, [800, 600]);
  equal(placed.size, 20);
  const boxes = [...placed.values()].map((p) => p.box);
  boxes.forEach((a, k) => {
    for (const b of boxes.slice(k + 1)) near(overlap(a, b), 0);
    for (const item of items) {
      near(overlap(a, [item.x - 15, item.y - 15, 30, 30]), 0);
    }
    ok(a[0] >= 0 && a[1] >= 0 && a[0] + a[2] <= 800 && a[1] + a[3] <= 600);
  });
});

test("a label stays on its side as long as there is room", () => {
  const item = { id: 1, x: 100, y: 100, radius: 10, width: 50, height: 20 };
  const left = placeLabels([item], [400, 400], new Map([[1, 1]])).get(1);
  equal(left.candidate, 1);
  ok(left.box[0] + left.box[2] < 100);
  // On the border there is none on that side.
  const moved = placeLabels([{ ...item, x: 20 }], [400, 400], new Map([[1, 1]])).get(1);
  equal(moved.candidate, 0);
});

test("a label without room is left out rather than drawn over", () => {
  const box = [10, 10, 30, 10];
  const found = placeWhereFree([{ id: "a", places: [box] }, { id: "b", places: [box, [60, 10, 30, 10]] },
    { id: "c", places: [box] }], [200, 100], []);
  equal([...found.keys()], ["a", "b"]);
  equal(found.get("b"), [60, 10, 30, 10]);
});

test("a track keeps steps, not jitter", () => {
  const track = new Track();
  ok(track.add(0, 0, 0));
  ok(!track.add(1, 0.1, 0.1));
  ok(track.add(2, 1, 0));
  ok(!track.add(1.5, 5, 0), "time does not run backwards");
  ok(!track.add(3, NaN, 0));
  equal(track.points.length, 2);
});

test("a position that jumps leaves no line", () => {
  const track = new Track();
  track.add(0, 0, 0);
  track.add(1, 1.2, 0);
  track.add(2, 20, 0);
  track.add(3, 21.2, 0);
  equal(track.points.map((p) => p[3]), [true, false, true, false]);
});

test("no line crosses the map where somebody was lost and found elsewhere", () => {
  const track = new Track();
  track.add(0, 0, 0);
  track.add(1, 1, 0);
  track.add(40, 30, 0);
  track.add(41, 31, 0);
  // Who stood for a minute goes on from there.
  track.add(101, 31.5, 0);
  equal(track.points.map((p) => p[3]), [true, false, true, false, false]);
});

test("a track of hours, thinned to a point every sixteen seconds, is restored as a line", () => {
  const track = new Track();
  track.restore(Array.from({ length: 1000 }, (_, k) => [16 * k, 12 * k, 0]));
  equal(track.points.filter((p) => p[3]).length, 1);
  track.add(16 * 999 + 40, 12 * 999 + 30, 0);
  ok(track.points.at(-1)[3], "who is lost now is still lost");
});

test("hours of walking stay bounded and keep their newest part whole", () => {
  const track = new Track();
  for (let k = 0; k < 20000; k += 1) track.add(k, k, 0);
  ok(track.points.length <= MAX_POINTS, String(track.points.length));
  const newest = track.points.slice(-500).map((p) => p[0]);
  equal(newest, Array.from({ length: 500 }, (_, k) => 19500 + k));
  ok(track.redrawn > 0);
  near(track.points[0][0], 0);
});

test("the part of a track since a time is found", () => {
  const track = new Track();
  for (let k = 0; k < 10; k += 1) track.add(k, k, 0);
  equal([track.since(-1), track.since(4), track.since(4.5), track.since(99)], [0, 4, 5, 10]);
});

const still = (node, alert, still_s, more = {}) => ({ node, name: `N${node}`, alert, still_s, seen_s: 1, ...more });

test("a warning that becomes an alarm has to be acknowledged anew", () => {
  const alarms = new Alarms();
  equal(alarms.update([still(1, "still_warning", 20)]).raised.length, 1);
  equal(alarms.sounding, "low");
  equal(alarms.update([still(1, "still_warning", 21)]).raised.length, 0);
  alarms.acknowledge(1);
  equal(alarms.sounding, null);
  equal(alarms.update([still(1, "still_warning", 22)]).raised.length, 0);
  equal(alarms.update([still(1, "still_alarm", 30)]).raised.length, 1);
  equal(alarms.sounding, "high");
  equal(alarms.list()[0].seconds, 30);
});

test("an alarm acknowledged elsewhere is silent here", () => {
  const alarms = new Alarms();
  equal(alarms.update([still(1, "lost", 0, { acknowledged: true })]).raised.length, 0);
  equal(alarms.sounding, null);
  equal(alarms.list().length, 1);
});

test("a person who moves again is announced once", () => {
  const alarms = new Alarms();
  alarms.update([still(1, "still_alarm", 40), still(2, "lost", 0)]);
  const { cleared } = alarms.update([still(1, null, 0), still(2, "lost", 0)]);
  equal(cleared.map((a) => a.node), [1]);
  equal(alarms.update([still(1, null, 0), still(2, "lost", 0)]).cleared.length, 0);
  equal(alarms.list().map((a) => a.node), [2]);
});

test("silence of everybody at once is one alarm, and high: nobody can call for help", () => {
  const alarms = new Alarms();
  const all = [1, 2, 3, 4, 5].map((node) => still(node, "lost", 0, { seen_s: 12 }));
  alarms.update(all);
  equal(alarms.rows().map((r) => [r.kind, r.level, r.nodes.length]), [["nobody", "high", 5]]);
  // One is heard: the others were lost together.
  alarms.update([...all.slice(1), still(1, null, 0)]);
  equal(alarms.rows().map((r) => [r.kind, r.level, r.nodes.length]), [["together", "medium", 4]]);
  // Those who fell silent one by one are told one by one.
  alarms.update([still(1, null, 0), ...all.slice(1).map((p, k) => ({ ...p, seen_s: 12 + 20 * k }))]);
  equal(alarms.rows().map((r) => r.kind), ["lost", "lost", "lost", "lost"]);
});

test("a flood of alarms hides nobody who lies still", () => {
  let ms = 0;
  const alarms = new Alarms(() => ms);
  const people = [];
  for (let node = 1; node <= 12; node += 1) {
    people.push(still(node, node === 7 ? "still_alarm" : "still_warning", 25 + node));
    ms += 20_000;
    alarms.update(people);
  }
  ok(alarms.flood);
  equal(alarms.rows().map((r) => [r.kind, r.nodes.length]), [["still", 1], ["flood", 11]]);
  equal(alarms.sounding, "high");
  alarms.acknowledge(7);
  equal(alarms.sounding, null);
  ms += 600_000;
  ok(!alarms.flood);
});

test("a shelved alarm is silent and comes back by itself", () => {
  const alarms = new Alarms();
  equal(alarms.update([still(1, "still_alarm", 40, { shelved_s: 12 })]).raised.length, 0);
  equal([alarms.sounding, alarms.rows().length], [null, 0]);
  alarms.update([still(1, "still_alarm", 52, { shelved_s: 0 })]);
  equal([alarms.sounding, alarms.rows().length], ["high", 1]);
});

test("the worst alarm comes first", () => {
  const alarms = new Alarms();
  alarms.update([still(1, "still_warning", 25), still(2, "still_alarm", 31), still(3, "still_alarm", 90)]);
  alarms.acknowledge(3);
  equal(alarms.list().map((a) => a.node), [2, 1, 3]);
});

const HELLO = { type: "hello", protocol: 1, session: { name: "a", started_unix_s: 5 }, limits: {} };
const person = (node, x_m, more = {}) => ({ node, name: `N${node}`, x_m, y_m: 0, status: "ok", ...more });

test("another session begins with an empty map, a reconnection does not", () => {
  const team = new Team();
  team.handle(HELLO);
  team.handle({ type: "picture", seq: 1, time_s: 1, people: [person(1, 0)] });
  team.handle(HELLO);
  equal(team.people.size, 1);
  team.handle({ ...HELLO, session: { name: "b", started_unix_s: 6 } });
  equal(team.people.size, 0);
  equal(team.tracks.size, 0);
});

test("a server of another protocol, or an unknown message, is noticed", () => {
  const team = new Team();
  equal(team.handle({ ...HELLO, protocol: 2 }), "unknown");
  equal(team.handle({ type: "surprise" }), "unknown");
  equal(team.handle(null), "unknown");
  equal(team.handle({ type: "ping" }), "ping");
});

test("only a certain position leaves a track", () => {
  const team = new Team();
  team.handle(HELLO);
  ["ok", "ambiguous", "lost", "unlocated", "stale"].forEach((status, k) => {
    team.handle({ type: "picture", seq: k, time_s: k, people: [person(1, k, { status })] });
  });
  equal(team.tracks.get(1).points.map((p) => p[1]), [0, 4]);
});

const ghost = (node, x_m, shape = "ellipse", sigma = 0.2) => (
  { node, x_m, y_m: 0, shape, sigma_major_m: shape === "ring" ? 3 : sigma, sigma_minor_m: 0.2 });

function ambiguous(alternatives) {
  const team = new Team();
  team.handle(HELLO);
  team.handle({
    type: "picture", seq: 1, time_s: 1, ambiguous: true, alternatives,
    people: [person(1, 0), person(2, 10), person(3, null, { status: "unlocated" })],
  });
  return team.possible();
}

test("the position shown is separated from the alternatives", () => {
  const { shown, places, rings } = ambiguous([
    { probability: 0.3, people: [ghost(1, 0), ghost(2, -10), ghost(3, 5, "ring")] },
    { probability: 0.7, people: [ghost(1, 0), ghost(2, 10), ghost(3, 5, "ring")] },
  ]);
  equal(shown.probability, 0.7);
  equal(places.map((p) => [p.node, p.x_m, p.probability]), [[2, -10, 0.3]]);
  equal(rings.map((r) => [r.node, r.x_m]), [[3, 5]]);
});

test("the probabilities of one person's place in several hypotheses add up", () => {
  const { here, places } = ambiguous([
    { probability: 0.4, people: [ghost(1, 0), ghost(2, 10)] },
    { probability: 0.3, people: [ghost(1, 6), ghost(2, 10.2)] },
    { probability: 0.2, people: [ghost(1, 6.1), ghost(2, -4)] },
    { probability: 0.1, people: [ghost(1, 0.1), ghost(2, -4.1)] },
  ]);
  const round = (p) => Math.round(100 * p);
  equal([round(here.get(1)), round(here.get(2))], [50, 70]);
  equal(places.map((p) => [p.node, p.x_m, round(p.probability)]), [[1, 6, 50], [2, -4, 30]]);
});

test("places of low probability are left out", () => {
  const { places } = ambiguous([
    { probability: 0.98, people: [ghost(1, 0), ghost(2, 10)] },
    { probability: 0.02, people: [ghost(1, 8), ghost(2, 10)] },
  ]);
  equal(places, []);
});

test("places closer than the uncertainty of the shown one are merged", () => {
  const far = { probability: 0.4, people: [ghost(1, 2)] };
  equal(ambiguous([{ probability: 0.6, people: [ghost(1, 0, "ellipse", 2)] }, far]).places, []);
  equal(ambiguous([{ probability: 0.6, people: [ghost(1, 0)] }, far]).places.length, 1);
});

test("a person without a name is called by their number", () => {
  const team = new Team();
  team.handle({ type: "picture", seq: 1, time_s: 1, people: [person(4, 0, { name: "" })] });
  equal(team.person(4).name, "Node 4");
});

test("attempts become rarer, never rarer than twelve seconds", () => {
  const delays = [0, 1, 2, 3, 4, 5, 50].map((n) => delayS(n, 0.5));
  equal(delays, [0.5, 1, 2, 4, 8, 10, 10]);
  ok(delayS(50, 0.999) < 12);
  ok(delayS(0, 0) > 0.3);
});

test("silence is not loss", () => {
  equal([0, 2.1, 5, 9.9, 10].map(judge), ["live", "live", "silent", "silent", "dead"]);
});
