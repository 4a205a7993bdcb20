// From metres on the map to pixels on the screen and back.
//
// A view is {x, y, scale, rotation, width, height}: the map's point in the middle, pixels a metre,
// how far the map is turned (radians counter-clockwise), the screen in pixels. The map's y points
// up, the screen's down.

export const MIN_SCALE = 0.5; // 1000 m across a small screen
export const MAX_SCALE = 400; // 5 m across a large one

export function clampScale(scale) {
  return Math.min(Math.max(scale, MIN_SCALE), MAX_SCALE);
}

export function toScreen(view, x, y) {
  const c = Math.cos(view.rotation);
  const s = Math.sin(view.rotation);
  const dx = (x - view.x) * view.scale;
  const dy = (y - view.y) * view.scale;
  return [view.width / 2 + c * dx - s * dy, view.height / 2 - s * dx - c * dy];
}

export function toMap(view, px, py) {
  const c = Math.cos(view.rotation);
  const s = Math.sin(view.rotation);
  const across = (px - view.width / 2) / view.scale;
  const up = (view.height / 2 - py) / view.scale;
  return [view.x + c * across + s * up, view.y - s * across + c * up];
}

/** The view after the map was dragged by that many pixels. */
export function pan(view, dxPx, dyPx) {
  const [x, y] = toMap(view, view.width / 2 - dxPx, view.height / 2 - dyPx);
  return { ...view, x, y };
}

/** The view magnified by `factor` with the map's point under (px, py) staying there. */
export function zoomAt(view, factor, px, py) {
  const scale = clampScale(view.scale * factor);
  const [x, y] = toMap(view, px, py);
  const zoomed = { ...view, scale };
  const [qx, qy] = toMap(zoomed, px, py);
  return { ...zoomed, x: view.x + x - qx, y: view.y + y - qy };
}

/** The rotation that makes that heading point up. */
export function headingUp(headingRad) {
  return Math.PI / 2 - headingRad;
}

/**
 * The view that shows all points [x, y] with their reach in metres, `margin` being the share of
 * the screen that is left free all round. Nothing is magnified beyond `most` pixels a metre.
 */
export function fit(view, points, { margin = 0.14, most = 60, reachM = 2 } = {}) {
  if (points.length === 0) return view;
  const c = Math.cos(view.rotation);
  const s = Math.sin(view.rotation);
  let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const [x, y] of points) {
    const across = c * x - s * y;
    const up = s * x + c * y;
    left = Math.min(left, across);
    right = Math.max(right, across);
    low = Math.min(low, up);
    high = Math.max(high, up);
  }
  const free = 1 - 2 * margin;
  const scale = clampScale(
    Math.min(
      (view.width * free) / (right - left + 2 * reachM),
      (view.height * free) / (high - low + 2 * reachM),
      most,
    ),
  );
  const across = (left + right) / 2;
  const up = (low + high) / 2;
  return { ...view, scale, x: c * across + s * up, y: -s * across + c * up };
}

/**
 * Does an automatic view have to move? When a person nears the border, or all have come so close
 * together, or so far to one side, that much of the screen is empty.
 */
export function isLoose(view, fitted, points, border = 0.05) {
  for (const [x, y] of points) {
    const [px, py] = toScreen(view, x, y);
    if (
      px < border * view.width || px > (1 - border) * view.width ||
      py < border * view.height || py > (1 - border) * view.height
    ) {
      return true;
    }
  }
  const [px, py] = toScreen(view, fitted.x, fitted.y);
  const aside = Math.max(
    Math.abs(px - view.width / 2) / view.width,
    Math.abs(py - view.height / 2) / view.height,
  );
  return fitted.scale > 1.5 * view.scale || aside > 0.2;
}

/** A round length of at most `mostPx` pixels: {metres, pixels}. */
export function scaleBar(scale, mostPx) {
  const most = mostPx / scale;
  const power = 10 ** Math.floor(Math.log10(most));
  const metres = [5, 2, 1].map((n) => n * power).find((n) => n <= most) ?? power;
  return { metres, pixels: metres * scale };
}

/** Distance of the grid's lines in metres, at least `leastPx` pixels apart. */
export function gridStep(scale, leastPx) {
  const least = leastPx / scale;
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((n) => n * power).find((n) => n >= least);
}
