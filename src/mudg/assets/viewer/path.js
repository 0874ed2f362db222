// A camera path of one's own: keys in time, the way between them, and the path as a file for `mudg render --path`.

import { add, keysAround, quaternionOf, rotationOf, slerp, sub } from "mudg/math";

/** Of a path that is saved, and of videos and pictures of a drive. */
export const FRAMES_PER_S = 10;
const MOST_KEYS = 1000;

/** The keys with a view at a time; a key at the same time gives way. A key is {t, eye, turn}: the quaternion of the camera in the world. */
export function withKey(keys, t, { eye, axes: [right, down, ahead] }) {
  const turn = quaternionOf([0, 1, 2].flatMap((k) => [right[k], down[k], ahead[k]]));
  return [...keys.filter((key) => Math.abs(key.t - t) > 1e-3), { t, eye: [...eye], turn }].sort((a, b) => a.t - b.t).slice(0, MOST_KEYS);
}

/** Eye and axes on the path at a time, before and after it at its ends: a smooth curve through the places, turns along the shorter arc. */
export function along(keys, t) {
  const times = keys.map((key) => key.t), [i, j, u] = keysAround(times, Math.min(Math.max(t, times[0]), times[times.length - 1])), p = keys[i], q = keys[j];
  const r = rotationOf(slerp(p.turn, q.turn, u)), axes = [0, 1, 2].map((k) => [r[k], r[3 + k], r[6 + k]]);
  if (i === j) return { eye: p.eye, axes };
  const pace = (k) => { // metres per second at a key, as between its neighbours
    const a = keys[Math.max(0, k - 1)], b = keys[Math.min(keys.length - 1, k + 1)];
    return sub(b.eye, a.eye).map((v) => v / (b.t - a.t));
  };
  const span = q.t - p.t, way = add(p.eye, sub(q.eye, p.eye), u * u * (3 - 2 * u));
  return { eye: add(add(way, pace(i), span * u * (1 - u) ** 2), pace(j), span * u * u * (u - 1)), axes };
}

/** The path as nerfstudio's transforms.json, which `mudg render --path` reads: camera axes right, up, back; times of the log's clock. */
export function pathText(keys, begin_s) {
  const first = keys[0].t, last = keys[keys.length - 1].t, count = Math.floor((last - first) * FRAMES_PER_S - 1e-6) + 1;
  const times = [...Array.from({ length: count }, (_, k) => first + k / FRAMES_PER_S), last];
  const frames = times.map((t) => {
    const { eye, axes: [right, down, ahead] } = along(keys, t);
    return { time: begin_s + t, transform_matrix: [...[0, 1, 2].map((k) => [right[k], -down[k], -ahead[k], eye[k]]), [0, 0, 0, 1]] };
  });
  return JSON.stringify({ camera_model: "OPENCV", frames });
}

/** Keys as text for an address, and back; null for what is no such text. */
export const keysText = (keys) => keys.map(({ t, eye, turn }) => [t, ...eye, ...turn].map((v) => +v.toFixed(4)).join(",")).join(";");

export function keysOf(text, end_s) {
  const rows = text.split(";").map((row) => row.split(",").map(Number)), length = ([, , , , ...q]) => Math.hypot(...q);
  const good = rows.every((row, k) => row.length === 8 && row.every(Number.isFinite) && row[0] >= 0 && row[0] <= end_s + 1e-3
    && Math.abs(length(row) - 1) < 0.01 && (k === 0 || row[0] > rows[k - 1][0] + 1e-3));
  if (!good || rows.length > MOST_KEYS) return null;
  return rows.map((row) => ({ t: Math.min(row[0], end_s), eye: row.slice(1, 4), turn: row.slice(4).map((v) => v / length(row)) }));
}
