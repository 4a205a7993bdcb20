// How one person sees another: distance and direction with their standard deviations.

import { isFresh } from "./age.js";
import { relative, wrap } from "./angles.js";

/** Standard deviation of a bearing of which nothing is known: a uniform angle's. */
export const ANY_ANGLE_RAD = Math.PI / Math.sqrt(3);

/** From this standard deviation on no direction is shown: 60 degrees, half of all round. */
export const VAGUE_RAD = Math.PI / 3;

/** Position covariance [xx, yy, xy] in m^2 of an ellipse given by semi-axes and direction. */
export function covariance(person) {
  const major = (person.sigma_major_m ?? 0) ** 2;
  const minor = (person.sigma_minor_m ?? 0) ** 2;
  const c = Math.cos(person.sigma_angle_rad ?? 0);
  const s = Math.sin(person.sigma_angle_rad ?? 0);
  return [c * c * major + s * s * minor, s * s * major + c * c * minor, c * s * (major - minor)];
}

export function isPlaced(person) {
  return person != null && person.status !== "unlocated" &&
    Number.isFinite(person.x_m) && Number.isFinite(person.y_m);
}

/** Distance and bearing by the two positions alone, their errors taken as independent. */
function byPositions(from, to) {
  const dx = to.x_m - from.x_m;
  const dy = to.y_m - from.y_m;
  const distance = Math.hypot(dx, dy);
  const [a, b] = [covariance(from), covariance(to)];
  const [xx, yy, xy] = [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
  if (distance === 0) {
    return [0, Math.sqrt(Math.max(0.5 * (xx + yy), 0)), 0, ANY_ANGLE_RAD];
  }
  const c = dx / distance;
  const s = dy / distance;
  const along = c * c * xx + 2 * c * s * xy + s * s * yy;
  const across = s * s * xx - 2 * c * s * xy + c * c * yy;
  return [
    distance,
    Math.sqrt(Math.max(along, 0)),
    Math.atan2(dy, dx),
    Math.min(Math.sqrt(Math.max(across, 0)) / distance, ANY_ANGLE_RAD),
  ];
}

/**
 * `to` as `from` sees it, or null where either is not placed.
 *
 * `pair` is the view's [node, peer, distance_m, sigma_distance_m, bearing_rad,
 * sigma_bearing_rad] of the two in either order, where it has one: it includes the correlation
 * of the two. `relativeRad` is null while the heading of `from` is unknown or not of now, or the
 * direction too uncertain to show.
 */
export function relation(from, to, pair = null) {
  if (!isPlaced(from) || !isPlaced(to) || from.node === to.node) return null;
  let [distanceM, sigmaM, bearingRad, sigmaBearingRad] = pair ? pair.slice(2) : byPositions(from, to);
  if (pair && pair[0] !== from.node) bearingRad = wrap(bearingRad + Math.PI);
  const sigmaHeadingRad = from.sigma_heading_rad ?? ANY_ANGLE_RAD;
  const sigmaRad = Math.min(Math.hypot(sigmaBearingRad, sigmaHeadingRad), ANY_ANGLE_RAD);
  const faces = isFresh(from) && !from.post && Number.isFinite(from.heading_rad);
  const shown = faces && sigmaRad < VAGUE_RAD;
  return {
    distanceM,
    sigmaM,
    bearingRad,
    sigmaBearingRad,
    relativeRad: shown ? relative(bearingRad, from.heading_rad) : null,
    sigmaRad,
    headingKnown: faces && sigmaHeadingRad < VAGUE_RAD,
  };
}

/** The key under which the pair of two nodes is kept, whichever comes first. */
export function pairKey(a, b) {
  return a < b ? `${a}-${b}` : `${b}-${a}`;
}
