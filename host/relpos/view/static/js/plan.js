// A plan under the map: a similarity from its pixels to metres, by two points in closed form.
//
// With a pixel as z = px - i py (y up) and its place as w = x + i y: w = a z + b, a = (w2 - w1) / (z2 - z1).

const times = ([a, b], [c, d]) => [a * c - b * d, a * d + b * c];
const minus = ([a, b], [c, d]) => [a - c, b - d];
const over = ([a, b], [c, d]) => {
  const size = c * c + d * d;
  return [(a * c + b * d) / size, (b * c - a * d) / size];
};
const pixel = (point) => [point[0], -point[1]];
const place = (point) => [point[2], point[3]];
const LEAST_PX = 3;

/** {a, b, residualM} of two or three points [px, py, x_m, y_m]; null of fewer, or of two that are one. */
export function align(points) {
  if (points.length < 2) return null;
  const [z1, z2] = points.map(pixel);
  const [w1, w2] = points.map(place);
  if (Math.hypot(...minus(z2, z1)) < LEAST_PX || Math.hypot(...minus(w2, w1)) === 0) return null;
  const a = over(minus(w2, w1), minus(z2, z1));
  const b = minus(w1, times(a, z1));
  const third = points[2];
  const residualM = third ? Math.hypot(...minus(toPlace({ a, b }, third[0], third[1]), place(third))) : null;
  return { a, b, residualM };
}

/** Before it is aligned: as wide as the view, in its middle. */
export function provisional(view, width, height) {
  const scale = (0.8 * view.width) / view.scale / width;
  return { a: [scale, 0], b: [view.x - (scale * width) / 2, view.y + (scale * height) / 2], residualM: null };
}

/** The place of a pixel. */
export function toPlace({ a, b }, px, py) {
  const [x, y] = times(a, [px, -py]);
  return [x + b[0], y + b[1]];
}

/** The pixel at a place. */
export function toPixel({ a, b }, x, y) {
  const [px, up] = over(minus([x, y], b), a);
  return [px, -up];
}
