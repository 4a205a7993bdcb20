// Where people have been: points thinned as they come, so that hours stay light.

const MIN_STEP_M = 0.3; // less is the position's own jitter
const FASTEST_M_S = 5; // faster than that the picture has changed its mind, not the person its place
const MIN_JUMP_M = 3;
const GAP_S = 10; // as long as the session waits before it calls somebody lost
export const MAX_POINTS = 3000;

/** The track of one person: `points` of [time_s, x_m, y_m, starts], the last `starts` a line. */
export class Track {
  constructor() {
    this.points = [];
    /** Grows whenever points that were there have changed: then a drawing must begin anew. */
    this.redrawn = 0;
  }

  /** Restore the server's points: [[t, x, y], ...], in time order. */
  restore(points) {
    this.points = [];
    this.redrawn += 1;
    // Those of hours are thinned: they lie far apart without anybody having been lost.
    const apartS = points.length > 1 ? (points.at(-1)[0] - points[0][0]) / (points.length - 1) : 0;
    for (const [t, x, y] of points) this.add(t, x, y, Math.max(GAP_S, 3 * apartS));
  }

  /** Go on to a point; false where it is too near to be one. Who is not heard for `gapS` was lost. */
  add(t, x, y, gapS = GAP_S) {
    if (!Number.isFinite(x) || !Number.isFinite(y)) return false;
    const last = this.points[this.points.length - 1];
    let starts = true;
    if (last) {
      if (t < last[0]) return false;
      const step = Math.hypot(x - last[1], y - last[2]);
      if (step < MIN_STEP_M) return false;
      // Nobody knows the path of somebody who was lost meanwhile: no line is drawn across the map.
      const passed = t - last[0];
      starts = step > (passed > gapS ? MIN_JUMP_M : Math.max(MIN_JUMP_M, FASTEST_M_S * passed));
    }
    this.points.push([t, x, y, starts]);
    if (this.points.length > MAX_POINTS) this.thin();
    return true;
  }

  /** Every second point of the older half goes. */
  thin() {
    const half = this.points.length / 2;
    this.points = this.points.filter((point, k) => k > half || k % 2 === 0 || point[3]);
    this.redrawn += 1;
  }

  /** Index of the first point that is not older than `time_s`. */
  since(timeS) {
    let low = 0;
    let high = this.points.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.points[middle][0] < timeS) low = middle + 1;
      else high = middle;
    }
    return low;
  }
}
