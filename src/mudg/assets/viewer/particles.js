// Falling rain and snow near the camera, as core/weather/air.py defines them: particles of one size stand still in a frame that falls
// with them; a hash of a cell of that frame says how many it holds and where. So the page shows the drops and flakes of an exact frame.

import { add, dot, sub } from "mudg/math";

const RAIN_EDGES_MM = [1, 1.5, 2, 3, 5], FLAKE_EDGES_MM = [0.7, 1.2, 2, 3.5];
const FLAKE_GROWTH = 10 ** (1 / 3), FLAKE_SPEED = 1, FLAKE_SWAY_M = 0.1;
const NEAREST_M = 0.25, SHUTTER_S = 0.01;
const MOST = 150000;

const mixed = (h) => {
  h = Math.imul(h ^ (h >>> 16), 0x7feb352d);
  h = Math.imul(h ^ (h >>> 15), 0x846ca68b);
  return (h ^ (h >>> 16)) >>> 0;
};
const hash = (a, b, c, d) => mixed(mixed(Math.imul(a, 0x9e3779b1) ^ (Math.imul(b, 0x85ebca77) + 0x165667b1) ^ Math.imul(c, 0xc2b2ae3d)) + Math.imul(d, 0x27d4eb2f));
const part = (h) => (h >>> 8) / 16777216;

/** Numbers per cubic metre and root mean square diameters in mm of an exponential distribution, per interval of diameters. */
function exponential(intercept, slope, edges) {
  const ends = edges.map((d) => {
    const e = intercept * Math.exp(-slope * d);
    return [e / slope, e * (d * d / slope + 2 * d / slope ** 2 + 2 / slope ** 3)];
  });
  return ends.slice(1).map((b, k) => [ends[k][0] - b[0], ends[k][1] - b[1]]).filter(([number]) => number > 0).map(([number, square]) => [number, Math.sqrt(square / number)]);
}

/** Sizes of drops at a rate in mm/h: {density per cubic metre, diameter_m, fall_m_s, sway_m}. */
export function rainSizes(rate) {
  return exponential(8000, 4.1 * rate ** -0.21, RAIN_EDGES_MM).map(([density, d]) => ({ density, diameter_m: d * 1e-3, fall_m_s: 9.65 - 10.3 * Math.exp(-0.6 * d), sway_m: 0 }));
}

/** Sizes of flakes at a rate in mm/h of water. */
export function snowSizes(rate) {
  return exponential(3800 * rate ** -0.87, 2.55 * rate ** -0.48, FLAKE_EDGES_MM)
    .map(([density, d]) => ({ density, diameter_m: d * 1e-3 * FLAKE_GROWTH, fall_m_s: FLAKE_SPEED, sway_m: FLAKE_SWAY_M }));
}

/** Extinction per metre of rain and of falling snow. */
export const rainExtinction = (rate) => (rate > 0 ? 0.312e-3 * rate ** 0.67 : 0);
export const snowExtinction = (rate) => (rate > 0 ? 2 * 3800 * rate ** -0.87 * Math.PI / 4 * FLAKE_GROWTH ** 2 * 2 / (2.55 * rate ** -0.48) ** 3 * 1e-6 : 0);

/** Chances of 0, 1, 2, ... particles or fewer in a cell. */
function atMost(mean) {
  const most = Math.trunc(mean + 7 * Math.sqrt(mean) + 8), sums = [];
  for (let k = 0, chance = Math.exp(-mean), sum = 0; k < most; k++, chance *= mean / k) sums.push(sum += chance);
  return sums;
}

/** Whether a place is in the view's pyramid up to a distance, with a margin. */
function pyramid(view, reach, margin) {
  const edges = [[-1, 0, view.cx / view.fx], [1, 0, (view.width - view.cx) / view.fx], [0, -1, view.cy / view.fy], [0, 1, (view.height - view.cy) / view.fy]]
    .map(([x, y, slope]) => [x, y, slope, Math.hypot(1, slope) * margin]);
  return (place) => {
    const d = sub(place, view.eye), x = dot(view.axes[0], d), y = dot(view.axes[1], d), z = dot(view.axes[2], d);
    return z > -margin && Math.hypot(x, y, z) < reach + margin && edges.every(([a, b, slope, most]) => a * x + b * y - slope * z < most);
  };
}

/**
 * World places of the particles of one size that a camera may see.
 * @param size see `rainSizes`. @param velocity in the world, m/s. @param time_s on the clock of the log. @param key of the random numbers.
 * @returns {Float64Array} x, y, z of each.
 */
export function places(size, velocity, view, time_s, reach, key) {
  const cell = Math.min(Math.max((2 / size.density) ** (1 / 3), 0.25), 2), margin = cell + size.sway_m, name = key & 0x7fffffff;
  const moved = velocity.map((v) => v * time_s), low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity], ends = [view.eye];
  const ray = (u, v) => add(add(view.axes[2], view.axes[0], (u - view.cx) / view.fx), view.axes[1], (v - view.cy) / view.fy);
  for (const [u, v] of [[0, 0], [view.width, 0], [0, view.height], [view.width, view.height], [view.cx, view.cy]]) ends.push(add(view.eye, ray(u, v), reach));
  for (const end of ends) for (let k = 0; k < 3; k++) { low[k] = Math.min(low[k], end[k] - moved[k]); high[k] = Math.max(high[k], end[k] - moved[k]); }
  const from = low.map((v) => Math.floor((v - margin) / cell)), to = high.map((v) => Math.floor((v + margin) / cell));
  const inside = pyramid(view, reach, 0.87 * cell + size.sway_m), sums = atMost(size.density * cell ** 3), found = [];
  for (let i = from[0]; i <= to[0]; i++) for (let j = from[1]; j <= to[1]; j++) for (let k = from[2]; k <= to[2]; k++) {
    const corner = [i, j, k];
    if (!inside(corner.map((v, n) => (v + 0.5) * cell + moved[n]))) continue;
    const own = hash(i, j, k, name), chance = part(own);
    for (let number = 0; number < sums.length && sums[number] <= chance; number++) {
      const place = corner.map((v, axis) => (v + part(hash(own, number, axis, name))) * cell + moved[axis]);
      if (size.sway_m) {
        const swing = (2 + 3 * part(hash(own, number, 4, name))) * time_s + 2 * Math.PI * part(hash(own, number, 3, name));
        place[0] += size.sway_m * Math.sin(swing);
        place[1] += size.sway_m * Math.cos(swing);
      }
      found.push(...place);
    }
  }
  return new Float64Array(found);
}

/**
 * Streaks of all particles of a kind in a picture.
 * @param kind {sizes, wind: [x, y] m/s, reach, keys}. @param moving velocity of the camera in the world, m/s.
 * @returns {number[]} seven per streak: both ends in pixels, width in pixels, camera z in metres, and how much of a pixel it covers in all.
 */
export function streaks(kind, view, time_s, moving) {
  const rows = [];
  kind.sizes.forEach((size, index) => {
    const velocity = [...kind.wind, -size.fall_m_s], found = places(size, velocity, view, time_s, kind.reach, kind.keys[index]);
    const half = sub(velocity, moving).map((v) => v * SHUTTER_S / 2), step = view.axes.map((axis) => dot(axis, half));
    for (let i = 0; i < found.length && rows.length < 7 * MOST; i += 3) {
      const d = [found[i] - view.eye[0], found[i + 1] - view.eye[1], found[i + 2] - view.eye[2]], far = Math.hypot(...d);
      if (far >= kind.reach) continue;
      const [x, y, z] = view.axes.map((axis) => dot(axis, d)), a = z - step[2], b = z + step[2];
      if (a <= NEAREST_M || b <= NEAREST_M) continue;
      const width = view.fx * size.diameter_m / z;
      rows.push(view.fx * (x - step[0]) / a + view.cx, view.fy * (y - step[1]) / a + view.cy, view.fx * (x + step[0]) / b + view.cx, view.fy * (y + step[1]) / b + view.cy,
        width, z, Math.PI / 4 * width * width * far / z);
    }
  });
  return rows;
}
