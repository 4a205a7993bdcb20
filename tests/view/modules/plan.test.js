import { align, toPixel, toPlace } from "/static/js/plan.js";
import { equal, near, test } from "./check.js";

// A plan of 20 pixels a metre, turned by 30 degrees; the pixel (100, 40) lies at (3, -7).
const turn = Math.PI / 6;
const placeOf = (px, py) => {
  const [right, up] = [(px - 100) / 20, -(py - 40) / 20];
  return [3 + Math.cos(turn) * right - Math.sin(turn) * up, -7 + Math.sin(turn) * right + Math.cos(turn) * up];
};
const point = (px, py, offM = 0) => {
  const [x, y] = placeOf(px, py);
  return [px, py, x + offM, y];
};

test("two points align a plan, and every other pixel lies where it should", () => {
  const found = align([point(10, 20), point(400, 310)]);
  for (const [px, py] of [[0, 0], [100, 40], [640, 480]]) {
    const [x, y] = toPlace(found, px, py);
    near(x, placeOf(px, py)[0]);
    near(y, placeOf(px, py)[1]);
    const back = toPixel(found, x, y);
    near(back[0], px, 1e-6);
    near(back[1], py, 1e-6);
  }
});

test("a third point tells by how much it misses", () => {
  equal(align([point(10, 20), point(400, 310)]).residualM, null);
  near(align([point(10, 20), point(400, 310), point(200, 200, 1.5)]).residualM, 1.5, 1e-9);
});

test("fewer than two points, or one twice, align nothing", () => {
  equal(align([point(10, 20)]), null);
  equal(align([point(10, 20), point(11, 20)]), null);
});
