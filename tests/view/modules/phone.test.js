import { radians } from "/static/js/angles.js";
import { best, exchange, measureOffset } from "/static/js/clock.js";
import {
  DEFAULT_SIGMA_RAD, headingOfCompass, headingOfEvent, headingOfOrientation, meanHeading,
} from "/static/js/compass.js";
import { PressQueue, randomId } from "/static/js/queue.js";
import { equal, near, ok, test } from "./check.js";

test("an exchange is wrong by at most half its round trip", () => {
  // The server is 1000 ms ahead; 10 ms there, 90 ms back.
  const { offsetMs, roundTripMs } = exchange(5000, 6010, 5100);
  near(roundTripMs, 100);
  ok(Math.abs(offsetMs - 1000) <= roundTripMs / 2);
});

test("of several exchanges the quickest counts", () => {
  near(best([exchange(0, 150, 200), exchange(0, 105, 10), exchange(0, 190, 300)]).offsetMs, 100);
  equal(best([]), null);
  equal(best([{ offsetMs: NaN, roundTripMs: 1 }, { offsetMs: 1, roundTripMs: -5 }]), null);
});

test("the offset of a clock is found through a slow network", async () => {
  let now = 0;
  const delays = [[40, 5], [8, 9], [300, 2], [30, 60]];
  const found = await measureOffset(async () => {
    const [there, back] = delays.shift();
    now += there;
    const server = now - 37_000;
    now += back;
    return server;
  }, { times: 4, now: () => now });
  near(found.offsetMs, -37_000, 8.5);
});

test("degrees clockwise from north become radians from east", () => {
  near(headingOfCompass(0), Math.PI / 2);
  near(headingOfCompass(90), 0);
  near(headingOfCompass(180), -Math.PI / 2);
  near(headingOfCompass(270), Math.PI);
});

// The specification's rotation, by multiplying matrices: Z-X'-Y'', x east, y north, z up.
function turned(alpha, beta, gamma, v) {
  const [a, b, g] = [alpha, beta, gamma].map(radians);
  const apply = (m, w) => m.map((row) => row.reduce((sum, value, k) => sum + value * w[k], 0));
  const ry = [[Math.cos(g), 0, Math.sin(g)], [0, 1, 0], [-Math.sin(g), 0, Math.cos(g)]];
  const rx = [[1, 0, 0], [0, Math.cos(b), -Math.sin(b)], [0, Math.sin(b), Math.cos(b)]];
  const rz = [[Math.cos(a), -Math.sin(a), 0], [Math.sin(a), Math.cos(a), 0], [0, 0, 1]];
  return apply(rz, apply(rx, apply(ry, v)));
}

test("a flat phone's heading is where its top edge points", () => {
  for (const alpha of [0, 33, 120, 250]) {
    const top = turned(alpha, 0, 0, [0, 1, 0]);
    near(Math.cos(headingOfOrientation(alpha, 0, 0) - Math.atan2(top[1], top[0])), 1);
  }
});

test("an upright phone's heading is where its back looks", () => {
  for (const alpha of [0, 33, 120, 250]) {
    const back = turned(alpha, 90, 0, [0, 0, -1]);
    near(Math.cos(headingOfOrientation(alpha, 90, 0) - Math.atan2(back[1], back[0])), 1);
  }
});

test("tilting a phone between flat and upright does not turn it", () => {
  for (const beta of [0, 20, 45, 70, 90, 110]) near(headingOfOrientation(75, beta, 0), headingOfOrientation(75, 0, 0), 1e-9);
});

test("a phone held sideways has the heading of its screen's upper edge", () => {
  // Screen turned by 90: the device's right edge is up for the reader.
  const right = turned(40, 0, 0, [1, 0, 0]);
  near(Math.cos(headingOfOrientation(40, 0, 0, 90) - Math.atan2(right[1], right[0])), 1);
});

test("an orientation without north is no heading", () => {
  equal(headingOfEvent({ absolute: false, alpha: 10, beta: 0, gamma: 0 }), null);
  equal(headingOfEvent({ absolute: true, alpha: null }), null);
  equal(headingOfEvent({ webkitCompassHeading: 30, webkitCompassAccuracy: -1 }), null);
});

test("an iPhone's compass is taken with its own accuracy, never for better than it is", () => {
  const sure = headingOfEvent({ webkitCompassHeading: 90, webkitCompassAccuracy: 5 });
  near(sure.heading_rad, 0);
  near(sure.sigma_rad, DEFAULT_SIGMA_RAD);
  near(headingOfEvent({ webkitCompassHeading: 90, webkitCompassAccuracy: 30 }).sigma_rad, radians(30));
});

test("the mean of headings goes the short way round", () => {
  near(Math.cos(meanHeading([3.1, -3.1]) - Math.PI), 1);
  equal(meanHeading([0, Math.PI]), null);
  equal(meanHeading([]), null);
});

class Memory {
  constructor() {
    this.kept = {};
  }

  getItem(key) {
    return this.kept[key] ?? null;
  }

  setItem(key, value) {
    this.kept[key] = value;
  }
}

function queueAt(memory = new Memory()) {
  const clock = { ms: 1000 };
  let count = 0;
  const queue = new PressQueue(memory, { now: () => clock.ms, newId: () => `id${(count += 1)}` });
  return { queue, clock, memory };
}

test("a press can be undone for five seconds, and is not sent meanwhile", () => {
  const { queue, clock } = queueAt();
  queue.press(2, "17");
  clock.ms += 4900;
  equal(queue.batches(0), []);
  equal(queue.undo().landmark, "17");
  queue.press(2, "18");
  clock.ms += 5000;
  equal(queue.undo(), null);
  equal(queue.batches(7)[0].presses[0].landmark, "18");
});

test("presses outlive the page until the server has them", () => {
  const { queue, clock, memory } = queueAt();
  queue.press(2, "17", 30);
  queue.press(2, "18", 30);
  clock.ms += 6000;
  const later = new PressQueue(memory, { now: () => clock.ms });
  equal(later.batches(0).map((b) => [b.node, b.clock_offset_ms, b.presses.length]), [[2, 30, 2]]);
  later.accepted(["id1"]);
  equal(new PressQueue(memory).presses.map((p) => p.id), ["id2"]);
});

test("two tabs of one browser lose none of each other's presses", () => {
  const { queue, clock, memory } = queueAt();
  const other = new PressQueue(memory, { now: () => clock.ms, newId: () => "other" });
  queue.press(2, "17");
  other.press(2, "18");
  clock.ms += 6000;
  queue.accepted(["id1"]);
  equal(new PressQueue(memory).presses.map((p) => p.landmark), ["18"]);
  equal(queue.batches(0)[0].presses.map((p) => p.landmark), ["18"]);
  other.accepted(["other"]);
  equal(queue.waiting, 0);
});

test("each press goes with the clock offset that was known when it was made", () => {
  const { queue, clock } = queueAt();
  queue.press(2, "1", 100);
  queue.press(2, "2", null);
  queue.press(3, "3", 100);
  clock.ms += 6000;
  equal(queue.batches(-5).map((b) => [b.node, b.clock_offset_ms, b.presses.map((p) => p.landmark)]),
    [[2, 100, ["1"]], [2, -5, ["2"]], [3, 100, ["3"]]]);
});

test("a clock that is set back holds no press for ever", () => {
  const { queue, clock } = queueAt();
  queue.press(2, "17");
  clock.ms -= 3_600_000;
  equal(queue.batches(0).length, 1);
});

test("what cannot be read is kept aside, not lost", () => {
  const memory = new Memory();
  memory.setItem("relpos.presses", "{broken");
  const queue = new PressQueue(memory);
  equal(queue.waiting, 0);
  queue.press(1, "2");
  equal(memory.getItem("relpos.presses.unreadable"), "{broken");
});

test("ids are random UUIDs", () => {
  const ids = new Set(Array.from({ length: 100 }, randomId));
  equal(ids.size, 100);
  for (const id of ids) ok(/^[0-9a-f]{8}-[0-9a-f]{4}-4[0-9a-f]{3}-[89ab][0-9a-f]{3}-[0-9a-f]{12}$/.test(id), id);
});
