import { Announcer, guidance, spoken, Trend, turnOrder } from "/static/js/finding.js";
import { radians } from "/static/js/angles.js";
import { equal, ok, test } from "./check.js";

const seen = (distanceM, deg, more = {}) => ({
  distanceM, sigmaM: 0.3, relativeRad: deg === null ? null : radians(deg), bearingRad: 0, headingKnown: true, ...more,
});

test("orders are those that one gives to a walker", () => {
  equal([0, 20, -40, 100, -100, 170, -179].map((deg) => turnOrder(radians(deg))),
    ["ahead", "ahead", "bear-right", "left", "right", "around", "around"]);
});

test("an order does not flutter at its border", () => {
  let order = turnOrder(radians(24));
  equal(order, "ahead");
  order = turnOrder(radians(27), order);
  equal(order, "ahead");
  order = turnOrder(radians(33), order);
  equal(order, "bear-left");
  equal(turnOrder(radians(23), order), "bear-left");
  equal(turnOrder(radians(17), order), "ahead");
});

test("from ahead to the other side the order changes hands", () => {
  equal(turnOrder(radians(-40), "bear-left"), "bear-right");
});

test("within reach the instruction is to search, not to turn", () => {
  equal(guidance(seen(1.2, 120)).key, "there");
  equal(guidance(seen(4, 120, { sigmaM: 3 })).key, "there");
  equal(guidance(seen(4, 120)).key, "left");
});

test("without a known heading the instruction says how to get one", () => {
  const guide = guidance(seen(9, null, { headingKnown: false }));
  equal(guide.arrowRad, null);
  ok(guide.words.startsWith("walk a few steps"), guide.words);
  equal(guidance(null).key, "unknown");
});

const walk = (trend, from, speed, seconds, noise = 0) => {
  for (let t = 0; t <= seconds; t += 0.5) {
    trend.add(from.t + t, from.d + speed * t + noise * Math.sin(9 * t));
  }
};

test("coming closer is warmer, going away colder, standing neither", () => {
  for (const [speed, expected] of [[-1, "warmer"], [1, "colder"], [0, "same"]]) {
    const trend = new Trend();
    walk(trend, { t: 0, d: 20 }, speed, 6, 0.2);
    equal(trend.direction, expected);
  }
});

test("no trend is shown before it can be known", () => {
  const trend = new Trend();
  equal(trend.direction, null);
  walk(trend, { t: 0, d: 20 }, -1, 2);
  equal(trend.direction, null);
});

test("a turn from colder to warmer shows within the window", () => {
  const trend = new Trend();
  walk(trend, { t: 0, d: 10 }, 1, 10);
  equal(trend.direction, "colder");
  walk(trend, { t: 10.5, d: 20 }, -1, 6);
  equal(trend.direction, "warmer");
});

test("what is read aloud is a sentence", () => {
  const relation = seen(12.3, 95);
  equal(spoken("Ben", relation, guidance(relation), "warmer"), "Ben, 12 metres, left: turn left, getting closer.");
  equal(spoken("Ben", null, guidance(null), null), "Ben: position unknown.");
});

test("an instruction is spoken when something has changed, and not too often", () => {
  const announcer = new Announcer();
  ok(announcer.due(0, { key: "ahead", distanceM: 20, trend: null }));
  ok(!announcer.due(1000, { key: "left", distanceM: 20, trend: null }), "too soon");
  ok(announcer.due(4100, { key: "left", distanceM: 20, trend: null }));
  ok(!announcer.due(20000, { key: "left", distanceM: 19.2, trend: null }), "nothing new");
  ok(announcer.due(21000, { key: "left", distanceM: 17.5, trend: null }));
  ok(announcer.due(26000, { key: "left", distanceM: 17.5, trend: "warmer" }));
});

test("a recording that was moved back is warmer or colder by what comes then", () => {
  const trend = new Trend();
  for (let k = 0; k < 20; k += 1) trend.add(100 + 0.5 * k, 20 - 0.5 * k);
  equal(trend.direction, "warmer");
  for (let k = 0; k < 20; k += 1) trend.add(30 + 0.5 * k, 5 + 0.5 * k);
  equal(trend.direction, "colder");
});
