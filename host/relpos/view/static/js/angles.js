// Angles as the Picture has them: radians, counter-clockwise, bearings from the map's x axis.
// People read directions clockwise: the clock's hours and the compass.

export const TAU = 2 * Math.PI;

/** The same angle in (-pi, pi]. */
export function wrap(rad) {
  const turned = ((rad % TAU) + TAU) % TAU;
  return turned > Math.PI ? turned - TAU : turned;
}

/** A bearing relative to a heading: 0 ahead, positive to the left. */
export function relative(bearingRad, headingRad) {
  return wrap(bearingRad - headingRad);
}

/** Hour of the clock, 12 straight ahead, 3 to the right, for an angle from `relative`. */
export function clockHour(relativeRad) {
  const hour = Math.round(-relativeRad / (TAU / 12));
  return ((hour % 12) + 12) % 12 || 12;
}

const POINTS = ["n", "ne", "e", "se", "s", "sw", "w", "nw"];

/** The nearest of eight compass points: "ne"; `words.js` puts it into words. */
export function compassPoint(bearingRad, northRad = Math.PI / 2) {
  const eighth = Math.round((northRad - bearingRad) / (TAU / 8));
  return POINTS[((eighth % 8) + 8) % 8];
}

export function degrees(rad) {
  return (rad * 180) / Math.PI;
}

export function radians(deg) {
  return (deg * Math.PI) / 180;
}
