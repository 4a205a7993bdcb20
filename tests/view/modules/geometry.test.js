import { clockHour, compassPoint, radians, relative, wrap } from "/static/js/angles.js";
import { covariance, relation } from "/static/js/relation.js";
import {
  fit, gridStep, headingUp, isLoose, pan, scaleBar, toMap, toScreen, zoomAt,
} from "/static/js/transform.js";
import { equal, near, ok, test } from "./check.js";

const VIEW = { x: 3, y: -2, scale: 17, rotation: 0.7, width: 800, height: 600 };

test("an angle is wrapped into the half-open circle", () => {
  near(wrap(Math.PI), Math.PI);
  near(wrap(-Math.PI), Math.PI);
  near(wrap(7), 7 - 2 * Math.PI);
  near(wrap(-100), -100 + 32 * Math.PI, 1e-9);
});

test("the clock's hours go clockwise from straight ahead", () => {
  equal([0, -90, 90, 180, -45, 45, -15.1].map((deg) => clockHour(radians(deg))), [12, 3, 9, 6, 2, 11, 1]);
  equal(clockHour(radians(14.9)), 12);
});

test("the compass has east along x and north along y", () => {
  equal([0, 90, 180, -90, 45, -135].map((deg) => compassPoint(radians(deg))),
    ["e", "n", "w", "s", "ne", "sw"]);
  equal(compassPoint(radians(700)), "e");
});

test("somebody to the right of me is at a negative angle", () => {
  // I look north, the other is in the east.
  near(relative(0, Math.PI / 2), -Math.PI / 2);
  near(relative(-3, 3), 2 * Math.PI - 6);
});

const person = (node, x_m, y_m, more = {}) => ({
  node, x_m, y_m, heading_rad: 0, sigma_heading_rad: 0.1, sigma_major_m: 0.5, sigma_minor_m: 0.5,
  sigma_angle_rad: 0, status: "ok", ...more,
});

test("whoever is not heard, or is nobody, faces nowhere that is known", () => {
  for (const status of ["stale", "lost"]) {
    const seen = relation(person(1, 0, 0, { status, seen_s: 20 }), person(2, 4, 0));
    equal([seen.relativeRad, seen.headingKnown, seen.distanceM], [null, false, 4]);
    near(relation(person(2, 4, 0), person(1, 0, 0, { status, seen_s: 20 })).relativeRad, Math.PI);
  }
  // Nor does the command post's node, which lies on a table.
  equal(relation(person(1, 0, 0, { post: true }), person(2, 4, 0)).relativeRad, null);
});

test("a pair in the other order has the opposite bearing", () => {
  const pair = [1, 2, 5, 0.2, 0.3, 0.1];
  near(relation(person(1, 0, 0), person(2, 1, 1), pair).bearingRad, 0.3);
  near(relation(person(2, 1, 1), person(1, 0, 0), pair).bearingRad, 0.3 - Math.PI);
  near(relation(person(2, 1, 1), person(1, 0, 0), pair).distanceM, 5);
});

test("without a pair distance and its deviation follow from the ellipses", () => {
  const long = person(1, 0, 0, { sigma_major_m: 2, sigma_minor_m: 0.1, sigma_angle_rad: Math.PI / 2 });
  const sure = person(2, 10, 0, { sigma_major_m: 0.3, sigma_minor_m: 0.3 });
  const seen = relation(long, sure);
  near(seen.distanceM, 10);
  near(seen.bearingRad, 0);
  // The long axis lies across the line of sight: it makes the bearing unsure, not the distance.
  near(seen.sigmaM, Math.hypot(0.1, 0.3));
  near(seen.sigmaBearingRad, Math.hypot(2, 0.3) / 10);
});

test("an ellipse's covariance has its axes as eigenvectors", () => {
  const [xx, yy, xy] = covariance({ sigma_major_m: 3, sigma_minor_m: 1, sigma_angle_rad: 0.6 });
  const [c, s] = [Math.cos(0.6), Math.sin(0.6)];
  near(xx * c + xy * s, 9 * c);
  near(xy * c + yy * s, 9 * s);
  near(-xx * s + xy * c, -s);
});

test("no direction is shown while my heading is unknown", () => {
  equal(relation(person(1, 0, 0, { sigma_heading_rad: 1.8 }), person(2, 4, 0)).relativeRad, null);
  equal(relation(person(1, 0, 0, { sigma_heading_rad: null }), person(2, 4, 0)).relativeRad, null);
  near(relation(person(1, 0, 0), person(2, 4, 0)).relativeRad, 0);
});

test("a person without a position has no relation to others", () => {
  equal(relation(person(1, 0, 0), person(2, 4, 0, { status: "unlocated" })), null);
  equal(relation(person(1, null, null), person(2, 4, 0)), null);
  equal(relation(null, person(2, 4, 0)), null);
  equal(relation(person(1, 0, 0), person(1, 0, 0)), null);
});

test("two at the same spot are seen without a direction", () => {
  const seen = relation(person(1, 2, 2), person(2, 2, 2));
  near(seen.distanceM, 0);
  equal(seen.relativeRad, null);
  ok(Number.isFinite(seen.sigmaM));
});

test("the screen and the map are each other's inverse", () => {
  for (const [px, py] of [[0, 0], [800, 600], [123, 456]]) {
    const [x, y] = toMap(VIEW, px, py);
    const [qx, qy] = toScreen(VIEW, x, y);
    near(qx, px, 1e-9);
    near(qy, py, 1e-9);
  }
});

test("north up has north above and east to the right", () => {
  const view = { ...VIEW, rotation: 0 };
  const [cx, cy] = toScreen(view, 3, -2);
  const [nx, ny] = toScreen(view, 3, -1);
  const [ex, ey] = toScreen(view, 4, -2);
  equal([cx, cy], [400, 300]);
  near(nx, cx);
  near(ny, cy - 17);
  near(ex, cx + 17);
  near(ey, cy);
});

test("heading up puts what lies ahead above", () => {
  const heading = -2.1;
  const view = { ...VIEW, rotation: headingUp(heading) };
  const [px, py] = toScreen(view, 3 + Math.cos(heading), -2 + Math.sin(heading));
  near(px, 400, 1e-9);
  near(py, 300 - 17, 1e-9);
});

test("zooming leaves the point under the finger where it is", () => {
  const at = toMap(VIEW, 650, 90);
  const [px, py] = toScreen(zoomAt(VIEW, 3, 650, 90), ...at);
  near(px, 650, 1e-6);
  near(py, 90, 1e-6);
});

test("zoom stays within its limits", () => {
  near(zoomAt(VIEW, 1e9, 0, 0).scale, 400);
  near(zoomAt(VIEW, 1e-9, 0, 0).scale, 0.5);
});

test("dragging moves the map with the finger", () => {
  const at = toMap(VIEW, 200, 200);
  const [px, py] = toScreen(pan(VIEW, 31, -12), ...at);
  near(px, 231, 1e-9);
  near(py, 188, 1e-9);
});

test("fitting shows everybody, turned or not", () => {
  const points = [[-30, 4], [22, 9], [3, -41]];
  for (const rotation of [0, 1, -2.5]) {
    const view = fit({ ...VIEW, rotation }, points);
    for (const point of points) {
      const [px, py] = toScreen(view, ...point);
      ok(px > 80 && px < 720 && py > 60 && py < 540, `${px} ${py}`);
    }
    ok(!isLoose(view, view, points));
  }
});

test("a fitted view moves when somebody leaves it, not with every step", () => {
  const points = [[0, 0], [20, 10]];
  const view = fit({ ...VIEW, rotation: 0 }, points);
  const stepped = [[0, 0], [21, 10]];
  ok(!isLoose(view, fit(view, stepped), stepped));
  const left = [[0, 0], [30, 10]];
  ok(isLoose(view, fit(view, left), left));
  const together = [[0, 0], [3, 1]];
  ok(isLoose(view, fit(view, together), together));
});

test("the scale bar is round, and no longer than there is room", () => {
  for (const scale of [0.7, 3, 11, 47, 390]) {
    const { metres, pixels } = scaleBar(scale, 120);
    ok(pixels <= 120 && pixels > 40, `${pixels} at ${scale}`);
    near(pixels, metres * scale, 1e-9);
    ok([1, 2, 5].includes(Number(metres.toExponential().split("e")[0])), String(metres));
    ok(gridStep(scale, 56) * scale >= 56);
  }
});
