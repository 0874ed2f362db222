// Rigid motions, pose keys and projection. Plain arrays; matrices are rows; world z is up, cameras look along z with y down.

export const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
export const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const unit = (a) => { const l = Math.hypot(...a) || 1; return [a[0] / l, a[1] / l, a[2] / l]; };

/** Rotation as nine numbers, rows one after the other, of a unit quaternion (w, x, y, z). */
export function rotationOf([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

/** Unit quaternion (w, x, y, z) of a rotation (nine numbers, rows). */
export function quaternionOf(r) {
  const squares = [1 + r[0] + r[4] + r[8], 1 + r[0] - r[4] - r[8], 1 - r[0] + r[4] - r[8], 1 - r[0] - r[4] + r[8]];
  const largest = squares.indexOf(Math.max(...squares));
  const q = [
    [squares[0], r[7] - r[5], r[2] - r[6], r[3] - r[1]],
    [r[7] - r[5], squares[1], r[1] + r[3], r[2] + r[6]],
    [r[2] - r[6], r[1] + r[3], squares[2], r[5] + r[7]],
    [r[3] - r[1], r[2] + r[6], r[5] + r[7], squares[3]],
  ][largest];
  const length = Math.hypot(...q);
  return q.map((value) => value / length);
}

/** Spherical interpolation along the shorter arc. */
export function slerp(a, b, u) {
  let cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
  const sign = cosine < 0 ? -1 : 1;
  cosine *= sign;
  let p = 1 - u, q = u;
  if (cosine < 1 - 1e-6) {
    const angle = Math.acos(cosine);
    p = Math.sin((1 - u) * angle) / Math.sin(angle);
    q = Math.sin(u * angle) / Math.sin(angle);
  }
  const mixed = a.map((value, i) => p * value + q * sign * b[i]);
  const length = Math.hypot(...mixed);
  return mixed.map((value) => value / length);
}

/** Applies a rotation (nine numbers) to a vector. */
export const turn = (r, v) => [
  r[0] * v[0] + r[1] * v[1] + r[2] * v[2],
  r[3] * v[0] + r[4] * v[1] + r[5] * v[2],
  r[6] * v[0] + r[7] * v[1] + r[8] * v[2],
];

/**
 * The two keys around a time and the way between them. Times are increasing; a time within a tenth of a millisecond of a key is that key.
 * @returns {[number, number, number] | null} indices before and after, fraction; null outside the span.
 */
export function keysAround(times, t) {
  const n = times.length, near = 1e-4;
  if (!n || t < times[0] - near || t > times[n - 1] + near) return null;
  let low = 0, high = n - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] < t) low = middle + 1; else high = middle;
  }
  if (Math.abs(times[low] - t) <= near) return [low, low, 0];
  if (low > 0 && Math.abs(times[low - 1] - t) <= near) return [low - 1, low - 1, 0];
  return [low - 1, low, (t - times[low - 1]) / (times[low] - times[low - 1])];
}

/** Poses at times: rows of (t, x, y, z, qw, qx, qy, qz), as the section "keys" holds them. */
export class PoseKeys {
  constructor(rows) {
    this.times = [];
    this.positions = [];
    this.turns = [];
    for (let i = 0; i < rows.length; i += 8) {
      this.times.push(rows[i]);
      this.positions.push([rows[i + 1], rows[i + 2], rows[i + 3]]);
      const q = [rows[i + 4], rows[i + 5], rows[i + 6], rows[i + 7]], length = Math.hypot(...q) || 1;
      this.turns.push(q.map((value) => value / length));
    }
  }

  /** {position, rotation, around} at a time; null where there is none. */
  at(t) {
    const around = keysAround(this.times, t);
    if (!around) return null;
    const [before, after, u] = around;
    const p = this.positions[before], q = this.positions[after];
    const position = before === after ? p : [0, 1, 2].map((i) => p[i] + u * (q[i] - p[i]));
    const rotation = rotationOf(before === after ? this.turns[before] : slerp(this.turns[before], this.turns[after], u));
    return { position, rotation, around };
  }

  /** Like `at`, with the first or last key outside the span. */
  nearest(t) {
    return this.at(clamp(t, this.times[0], this.times[this.times.length - 1]));
  }

  /** Speed in metres per second. */
  speed(t, step = 0.1) {
    const first = this.times[0], last = this.times[this.times.length - 1];
    const a = clamp(t - step, first, last), b = clamp(t + step, first, last);
    if (b - a < 1e-6) return 0;
    return Math.hypot(...sub(this.at(b).position, this.at(a).position)) / (b - a);
  }
}

/**
 * What a camera sees of a world point: [x, y, depth] in pixels and metres.
 * @param view see cameras.js: eye, axes (right, down, ahead), fx, fy, cx, cy.
 */
export function project(view, point) {
  const d = sub(point, view.eye);
  const z = dot(view.axes[2], d);
  return [view.fx * dot(view.axes[0], d) / z + view.cx, view.fy * dot(view.axes[1], d) / z + view.cy, z];
}
