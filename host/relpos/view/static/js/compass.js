// A phone's compass as a heading of the team's frame.
//
// Phones tell degrees clockwise from magnetic north; a heading here is radians counter-clockwise
// from x, with x east and y north (REP-103, ENU): heading = pi/2 - degrees * pi/180. Magnetic
// north: no declination is corrected.

import { radians, wrap } from "./angles.js";

/** Standard deviation where the phone gives none: indoors compasses are 15 degrees off. */
export const DEFAULT_SIGMA_RAD = radians(15);

/** Radians counter-clockwise from east, of degrees clockwise from north. */
export function headingOfCompass(degreesFromNorth) {
  return wrap(Math.PI / 2 - radians(degreesFromNorth));
}

/**
 * Heading of a person who holds the phone with its screen towards them, flat or upright, from
 * the angles of a `deviceorientationabsolute` event in degrees; `screenDeg` is how far the
 * screen's content is turned.
 *
 * The rotation is R = Rz(alpha) Rx(beta) Ry(gamma) with x east, y north, z up. Flat, the top edge
 * points ahead; upright, the back does. Between the two both do, so their sum is taken.
 */
export function headingOfOrientation(alphaDeg, betaDeg, gammaDeg, screenDeg = 0) {
  const [a, b, g] = [alphaDeg, betaDeg, gammaDeg].map(radians);
  const [ca, sa, cb, sb, cg, sg] = [
    Math.cos(a), Math.sin(a), Math.cos(b), Math.sin(b), Math.cos(g), Math.sin(g),
  ];
  // Columns of R: the device's axes (right, top, out of the screen) in east and north.
  const right = [ca * cg - sa * sb * sg, sa * cg + ca * sb * sg];
  const top = [-sa * cb, ca * cb];
  const out = [ca * sg + sa * sb * cg, sa * sg - ca * sb * cg];
  const t = radians(screenDeg);
  const up = [0, 1].map((k) => Math.cos(t) * top[k] + Math.sin(t) * right[k]);
  const east = up[0] - out[0];
  const north = up[1] - out[1];
  if (Math.hypot(east, north) < 0.2) return null; // it points up or down: no heading
  return wrap(Math.atan2(north, east));
}

/** {heading_rad, sigma_rad} of an event, or null of one without a compass. */
export function headingOfEvent(event, screenDeg = 0) {
  if (Number.isFinite(event.webkitCompassHeading)) {
    const sigmaDeg = event.webkitCompassAccuracy;
    if (sigmaDeg < 0) return null; // not calibrated
    return {
      heading_rad: headingOfCompass(event.webkitCompassHeading + screenDeg),
      sigma_rad: Math.max(radians(sigmaDeg || 0), DEFAULT_SIGMA_RAD),
    };
  }
  if (event.absolute !== true || !Number.isFinite(event.alpha)) return null;
  const heading = headingOfOrientation(event.alpha, event.beta ?? 0, event.gamma ?? 0, screenDeg);
  return heading === null ? null : { heading_rad: heading, sigma_rad: DEFAULT_SIGMA_RAD };
}

/** Mean of directions; null where they cancel out. */
export function meanHeading(headings) {
  const east = headings.reduce((sum, h) => sum + Math.cos(h), 0);
  const north = headings.reduce((sum, h) => sum + Math.sin(h), 0);
  if (headings.length === 0 || Math.hypot(east, north) < 0.5 * headings.length) return null;
  return Math.atan2(north, east);
}
