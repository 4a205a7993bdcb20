import { aged, isFresh, LINK_LOST_S, reachM } from "/static/js/age.js";
import { guidance } from "/static/js/finding.js";
import { stateWords } from "/static/js/people.js";
import { replayWords } from "/static/js/status_line.js";
import { Team } from "/static/js/team.js";
import { equal, near, ok, test } from "./check.js";

const ben = { node: 2, name: "Ben", status: "ok", seen_s: 0.4, moving: true, still_s: 0, health: "green" };

test("what a person's news say grows older while nothing comes, and is a last place after 3.5 s", () => {
  equal(aged(ben, 0), ben);
  near(aged(ben, 2).seen_s, 2.4);
  ok(isFresh(aged(ben, LINK_LOST_S - 0.1)));
  const old = aged(ben, LINK_LOST_S);
  equal([old.status, old.moving, old.health], ["stale", null, "unknown"]);
  equal(aged({ ...ben, status: "lost" }, 60).status, "lost");
  equal(aged({ ...ben, status: "unlocated" }, 60).status, "unlocated");
});

test("who is not heard is not of now, located or not", () => {
  for (const status of ["unlocated", "ambiguous"]) {
    const person = { ...ben, status };
    ok(isFresh(person));
    ok(!isFresh({ ...person, seen_s: 4 }), status);
    const words = stateWords({ ...person, seen_s: 60 }, undefined, 0.6);
    ok(words.includes("last news"), words);
    ok(!words.includes("Moves"), words);
  }
});

test("nobody who is heard can have gone on", () => {
  equal(reachM(ben), 0);
  near(reachM({ ...ben, status: "lost", seen_s: 100 }), 140);
});

test("ranges grow old with the link and go after ten seconds", () => {
  const team = new Team();
  team.handle({ type: "picture", time_s: 1, unix_s: 1, people: [ben], ranges: [[1, 2, 5.5, 1], [2, 3, 4, 7]] });
  team.age(4);
  equal(team.ranges, [[1, 2, 5.5, 5]]);
  team.age(0);
  equal(team.ranges.length, 2);
});

test("guidance from a person who is not heard gives no direction", () => {
  const there = { distanceM: 5, sigmaM: 0.5, relativeRad: 0, headingKnown: true };
  equal(guidance(there, null, { fresh: false }).arrowRad, null);
  equal(guidance({ ...there, distanceM: 1 }, null, { last: true }).words, "last place reached: search from here");
});

test("a recording that does not know its day says how far it is", () => {
  equal(replayWords("live", { recorded_unix_s: null }, 61.2).age, "second 61 of the recording");
  equal(replayWords("waiting", { recorded_unix_s: null }, 61.2).state, "waiting");
});
