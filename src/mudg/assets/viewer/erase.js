// The verb `erase` of edit scripts: balls of the street that are taken away, and a box outside which nothing of it is kept.

const erasures = (entries) => entries.flatMap((entry) => entry.erase ?? []);

/** All balls of a script, [x, y, z, radius] each. */
export const ballsOf = (entries) => erasures(entries).flatMap(({ balls }) => balls ?? []);

/** The last box of a script, {center, size_m, yaw_deg}; null where it has none. */
export const boxOf = (entries) => erasures(entries).findLast(({ keep }) => keep)?.keep ?? null;

/** Entries that also erase this: balls as an entry of their own, a box in the place of the one before. */
export function withErased(entries, { balls, keep }) {
  if (balls) return balls.length ? [...entries, { erase: { balls } }] : entries;
  const rest = entries.filter(({ erase }) => !erase?.keep || erase.balls);
  return keep ? [...rest, { erase: { keep } }] : rest;
}

/** Cosine and sine of the heading of a box. */
export function headingOf({ yaw_deg: yaw = 0 }) {
  const angle = yaw * Math.PI / 180;
  return [Math.cos(angle), Math.sin(angle)];
}

/** The corners of a box in the world: those of its bottom round about, then those of its top. */
export function cornersOf(box) {
  const [c, s] = headingOf(box), [length, width, height] = box.size_m;
  return [-1, 1].flatMap((up) => [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([ahead, left]) => {
    const x = ahead * length / 2, y = left * width / 2;
    return [box.center[0] + c * x - s * y, box.center[1] + s * x + c * y, box.center[2] + up * height / 2];
  }));
}
