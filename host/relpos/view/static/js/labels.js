// Places labels so that none covers another label or a marker.

/** Overlap of two boxes [x, y, width, height] in square pixels. */
export function overlap(a, b) {
  const across = Math.min(a[0] + a[2], b[0] + b[2]) - Math.max(a[0], b[0]);
  const down = Math.min(a[1] + a[3], b[1] + b[3]) - Math.max(a[1], b[1]);
  return across > 0 && down > 0 ? across * down : 0;
}

// Right of the marker first: that is where one reads on. Then round, then farther out.
const DIRECTIONS = [
  [1, 0], [-1, 0], [0, -1], [0, 1], [0.8, -0.8], [0.8, 0.8], [-0.8, -0.8], [-0.8, 0.8],
];
const REACHES = [0, 26, 58, 96, 140, 190];

function candidate(item, index) {
  const reach = REACHES[Math.floor(index / DIRECTIONS.length)];
  const [dx, dy] = DIRECTIONS[index % DIRECTIONS.length];
  const gap = item.radius + 4 + reach;
  const x = item.x + dx * gap + (dx > 0.1 ? 0 : dx < -0.1 ? -item.width : -item.width / 2);
  const y = item.y + dy * gap + (dy > 0.1 ? 0 : dy < -0.1 ? -item.height : -item.height / 2);
  return [x, y, item.width, item.height];
}

const CANDIDATES = DIRECTIONS.length * REACHES.length;

/**
 * Place the labels of `items` {id, x, y, radius, width, height}, the most important first.
 *
 * `bounds` is [width, height] of the screen, `taken` further boxes to keep free. `previous` (id ->
 * candidate) keeps labels from jumping: the previous place is tried first. Returns a Map of id
 * -> {box, candidate, far}; `far` labels need a line to their marker.
 */
export function placeLabels(items, bounds, previous = new Map(), taken = []) {
  const markers = items.map((item) => [
    item.x - item.radius, item.y - item.radius, 2 * item.radius, 2 * item.radius,
  ]);
  const placed = [...taken];
  const result = new Map();
  for (const item of items) {
    let best = null;
    const before = previous.get(item.id);
    // A label that had to go far away comes back as soon as there is room.
    const first = before < DIRECTIONS.length ? before : undefined;
    for (let k = first === undefined ? 0 : -1; k < CANDIDATES; k += 1) {
      const index = k === -1 ? first : k;
      const box = candidate(item, index);
      let cost = outside(box, bounds);
      for (const other of markers) cost += overlap(box, other);
      for (const other of placed) cost += overlap(box, other);
      if (best === null || cost < best.cost - 1e-9) best = { box, index, cost };
      if (cost === 0) break;
    }
    placed.push(best.box);
    result.set(item.id, {
      box: best.box,
      candidate: best.index,
      far: best.index >= DIRECTIONS.length,
    });
  }
  return result;
}

/** Square pixels of a box that lie outside [width, height]. */
function outside(box, [width, height]) {
  return box[2] * box[3] - overlap(box, [0, 0, width, height]);
}

/**
 * Keep those of `boxes` {id, places: [box, ...]} that find a free place; the rest is left out.
 * Returns a Map of id -> box.
 */
export function placeWhereFree(boxes, bounds, taken) {
  const placed = [...taken];
  const result = new Map();
  for (const { id, places } of boxes) {
    const free = places.find(
      (box) => outside(box, bounds) === 0 && placed.every((other) => overlap(box, other) === 0),
    );
    if (free) {
      placed.push(free);
      result.set(id, free);
    }
  }
  return result;
}
