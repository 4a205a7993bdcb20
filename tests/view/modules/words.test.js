import { contrast, inkOn, palette, personColour } from "/static/js/colours.js";
import { connectionWords, dataAgeS } from "/static/js/status_line.js";
import {
  ago, alarmText, compass, dbm, distance, duration, percent, plusMinus, probability, seconds, side,
  spokenDistance, volts, whereabouts, directionWords,
} from "/static/js/words.js";
import { equal, near, ok, test } from "./check.js";

const plain = (text) => text.replaceAll("\u00a0", " ");

test("distances have tenths where they are near and sure", () => {
  equal([4.24, 9.94, 9.96, 23.4, 3.2].map((m) => plain(distance(m))), ["4.2 m", "9.9 m", "10 m", "23 m", "3.2 m"]);
  equal(plain(distance(4.24, 1.5)), "4 m");
  equal(distance(null), "–");
});

test("a standard deviation is never shown as zero", () => {
  equal([0.01, 0.42, 1.26, 12.3].map((m) => plain(plusMinus(m))), ["±0.1 m", "±0.4 m", "±1.3 m", "±12 m"]);
  equal(plusMinus(undefined), "");
});

test("durations have the unit of everyday speech", () => {
  equal([0.3, 7, 59.6, 119, 185, 3725, 8000].map((s) => plain(duration(s))), ["0.3 s", "7 s", "60 s", "119 s", "3:05 min", "62:05 min", "2:13 h"]);
  equal([0.9, 34.9, 130].map((s) => plain(seconds(s))), ["0 s", "34 s", "2:10 min"]);
  equal([0.3, 1.9, 2.1, 42].map((s) => plain(ago(s))), ["now", "now", "2 s ago", "42 s ago"]);
  equal(ago(null), "–");
  ok(!duration(42).includes(" "), "a line breaks between a figure and its unit");
});

test("unknown figures are dashes, and zero volts are unknown", () => {
  equal([volts(null), volts(0), volts(4.987), dbm(null), dbm(-61.4), percent(null), percent(0.034)],
    ["–", "–", "4.99 V", "–", "−61 dBm", "–", "3 %"]);
});

test("a probability is neither certain nor impossible while it is not", () => {
  equal([0, 0.003, 0.5, 0.994, 1].map(probability), ["0 %", "<1 %", "50 %", ">99 %", "100 %"]);
});

test("sides are those of the body", () => {
  equal([0, 0.8, 1.5, 2.4, 3.1, -3.1, -1.6, -0.7].map(side),
    ["ahead", "ahead left", "left", "behind left", "behind", "behind", "right", "ahead right"]);
});

test("compass words say whose north it is", () => {
  equal([compass(0, Math.PI / 2), compass(0, null)], ["east", "map east"]);
  // North lies along the map's x axis: what is up on it is west.
  equal(compass(Math.PI / 2, 0), "west");
});

test("whereabouts are one line for the ear", () => {
  const relation = { distanceM: 12.3, sigmaM: 0.42, relativeRad: -1.05, bearingRad: 0.8 };
  equal(plain(whereabouts(relation, null)), "12 m ±0.4 m · 2 o'clock, ahead right · map north-east");
  equal(whereabouts(null, true), "position unknown");
});

test("an unknown direction is not shown", () => {
  equal(directionWords({ relativeRad: null, distanceM: 8, sigmaM: 1 }), "direction unknown");
  equal(directionWords({ relativeRad: null, distanceM: 0.5, sigmaM: 0.3 }), "close by");
});

test("alarms name who and how long", () => {
  equal(plain(alarmText({ kind: "still", name: "Ben", seconds: 31.4 })), "Ben has not moved for 31 s");
  equal(plain(alarmText({ kind: "lost", name: "Ben", seconds: 125 })), "Ben is lost: not heard for 2:05 min");
});

test("spoken distances have no tenths", () => {
  equal([0.3, 1.2, 4.6, 23].map(spokenDistance), ["half a metre", "1 metre", "5 metres", "23 metres"]);
});

test("people's colours stand out from both maps, and their numbers from them", () => {
  for (const [dark, ground] of [[false, "#ffffff"], [true, "#0b1016"]]) {
    for (const colour of palette(dark)) {
      ok(contrast(colour, ground) >= 4.5, `${colour} on ${ground}: ${contrast(colour, ground)}`);
      ok(contrast(colour, inkOn(colour)) >= 4.5, `number on ${colour}`);
    }
    equal(new Set(palette(dark)).size, palette(dark).length);
    equal(personColour(1, dark), personColour(1 + palette(dark).length, dark));
  }
});

test("contrast is that of WCAG", () => {
  near(contrast("#000000", "#ffffff"), 21);
  near(contrast("#777777", "#ffffff"), 4.478, 1e-3);
});

test("the data's age counts the time at the server and the time here", () => {
  near(dataAgeS({ unixS: 1000, arrivedUnixS: 999.5, receivedMs: 5000, nowMs: 7000 }), 2.5);
  // A clock that was set back makes nothing younger than it was.
  near(dataAgeS({ unixS: 1000, arrivedUnixS: 999.5, receivedMs: 5000, nowMs: 4000 }), 0.5);
  near(dataAgeS({ unixS: 1000, arrivedUnixS: null, receivedMs: 5000, nowMs: 6000 }), 1);
  equal(dataAgeS({ unixS: null, arrivedUnixS: null, receivedMs: null, nowMs: 6000 }), null);
});

test("an old view is never called live", () => {
  equal(connectionWords("live", 0.2, null), { state: "live", words: "Live", age: "data now" });
  equal(plain(connectionWords("live", 7, null).age), "data 7 s old");
  equal(connectionWords("waiting", 12, 3).words, "Not connected, next try in 3 s");
  equal(connectionWords("live", null, null).age, "no data yet");
});
