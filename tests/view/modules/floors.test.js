import { apartWords, floorOf, floorsApart, floorsOf } from "/static/js/floors.js";
import { equal, test } from "./check.js";

const on = (floor, more = {}) => ({ floor, floor_probability: 0.99, ...more });

test("a floor counts where it is stated and more probable than not", () => {
  equal([on(2), on(-1), on(0), on(null), {}, null, on(1, { floor_probability: 0.4 })].map(floorOf),
    [2, -1, 0, null, null, null, null]);
  equal(floorsOf([on(0), on(2), on(2), on(-1), on(null)]), [2, 0, -1]);
});

test("floors apart are known where both are", () => {
  equal(floorsApart(on(0), on(2)), 2);
  equal(floorsApart(on(1), on(-1)), -2);
  equal(floorsApart(on(1), on(null)), null);
});

test("floors apart are said as one says them", () => {
  equal([2, 1, -1, -3, 0, null].map(apartWords), [
    "2 floors above you", "one floor above you", "one floor below you", "3 floors below you", "", "",
  ]);
});
