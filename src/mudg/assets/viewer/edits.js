// What edit scripts do to the paths of objects, as far as the page can show it by itself: remove, move, stop. The rules, and their order
// of operations, are those of the program (core/edit.py, core/edit.py), so that the page shows what `mudg render --edits` draws.

import { PoseKeys, add, clamp, cross, dot, keysAround, quaternionOf, rotationOf, sub, turn, unit } from "mudg/math";

const STEP_S = 0.05; // distance of the keys that describe a changed stretch of a path
const TILT_M = 2;
const DEFAULT_RAMP_S = 1, DEFAULT_BRAKE_M_S2 = 4;
/** Verbs that the page shows by itself; the server behind `mudg view` knows the paths of the others. */
export const SHOWN = ["remove", "move", "stop", "erase"];

// ---- the ground ----

/** Heights of the ground on a grid, NaN where they are not known. */
export class Ground {
  /** @param facts {origin, cell_m, shape: [x, y], low, step}. @param levels u16, 65535 = not known. */
  constructor(facts, levels) {
    Object.assign(this, facts);
    this.levels = levels;
  }

  cell(i, j) {
    const level = this.levels[i * this.shape[1] + j];
    return level === 65535 ? NaN : this.low + level * this.step;
  }

  /** Height under a place. */
  height(x, y) {
    const a = (x - this.origin[0]) / this.cell_m, b = (y - this.origin[1]) / this.cell_m, [n, m] = this.shape;
    if (!(a >= 0 && b >= 0 && a <= n - 1 && b <= m - 1)) return NaN;
    const i = Math.min(Math.floor(a), n - 2), j = Math.min(Math.floor(b), m - 2), u = a - i, v = b - j;
    return (1 - u) * ((1 - v) * this.cell(i, j) + v * this.cell(i, j + 1)) + u * ((1 - v) * this.cell(i + 1, j) + v * this.cell(i + 1, j + 1));
  }

  /** Unit normal under a place, upwards; vertical where the slope is not known. */
  normal(x, y) {
    const slope = (dx, dy) => (this.height(x + dx, y + dy) - this.height(x - dx, y - dy)) / (2 * TILT_M) || 0;
    return unit([-slope(TILT_M, 0), -slope(0, TILT_M), 1]);
  }
}

// ---- paths ----

/** A path as keys; each also says which moment of the recording it shows, for what moves within a box. */
export class Motion extends PoseKeys {
  constructor(times, positions, turns, source, recorded) {
    super([]);
    Object.assign(this, { times, positions, turns, source, recorded });
  }

  static of(keys) {
    if (keys instanceof Motion) return keys;
    const times = keys.times.map((t) => Math.round(t * 1e6) / 1e6); // 32-bit times would ask for one key more than the program's
    return new Motion(times, keys.positions, keys.turns, times, times);
  }

  at(t) {
    const pose = super.at(t);
    if (!pose) return null;
    const [before, after, u] = pose.around, { source, recorded } = this;
    return { ...pose, around: keysAround(recorded, clamp(source[before] + u * (source[after] - source[before]), recorded[0], recorded[recorded.length - 1])) };
  }

  get last() { return this.times[this.times.length - 1]; }

  /** Place, quaternion and moment of the recording at a time within the span. */
  sample(t) {
    const inside = clamp(t, this.times[0], this.last), { position, rotation } = super.at(inside), [before, after, u] = keysAround(this.times, inside);
    return { position, turn: quaternionOf(rotation), source: this.source[before] + u * (this.source[after] - this.source[before]) };
  }

  /** The same path with keys at these times. */
  resampled(times) {
    const found = times.map((t) => this.sample(t));
    return new Motion(times, found.map((one) => one.position), found.map((one) => one.turn), found.map((one) => one.source), this.recorded);
  }

  withKeysBetween(begin, end) {
    const from = Math.max(begin, this.times[0]), to = Math.min(end, this.last);
    if (to <= from) return this;
    const count = Math.max(2, Math.ceil((to - from) / STEP_S) + 1);
    const more = Array.from({ length: count }, (_, i) => from + (to - from) * i / (count - 1)).filter((t) => !this.times.some((one) => Math.abs(one - t) < 1e-4));
    return this.resampled([...this.times, ...more].sort((a, b) => a - b));
  }

  /** Metres per second over 0.2 s. */
  speedAt(t) {
    const before = clamp(t - 0.1, this.times[0], this.last), after = clamp(t + 0.1, this.times[0], this.last);
    if (after <= before) return 0;
    return Math.hypot(...sub(this.sample(after).position, this.sample(before).position)) / (after - before);
  }

  /** The same keys with other poses. @param change (position, rotation, time) -> {position, rotation}. */
  mapped(change) {
    const made = this.times.map((t, i) => change(this.positions[i], rotationOf(this.turns[i]), t));
    return new Motion(this.times, made.map((one) => one.position), made.map((one) => quaternionOf(one.rotation)), this.source, this.recorded);
  }
}

const product = (a, b) => Array.from({ length: 9 }, (_, k) => [0, 1, 2].reduce((sum, i) => sum + a[3 * Math.floor(k / 3) + i] * b[3 * i + k % 3], 0));
const quintic = (s) => { const u = clamp(s, 0, 1); return u ** 3 * (10 - 15 * u + 6 * u ** 2); };

/** The smallest rotation that takes one unit vector to another. */
function turnBetween(a, b) {
  const [x, y, z] = cross(a, b), skew = [0, -z, y, z, 0, -x, -y, x, 0], more = product(skew, skew), scale = 1 / (1 + dot(a, b));
  return [1, 0, 0, 0, 1, 0, 0, 0, 1].map((one, k) => one + skew[k] + scale * more[k]);
}

function grounded(position, rotation, before, ground) {
  const rise = ground.height(position[0], position[1]) - ground.height(before[0], before[1]);
  if (!Number.isFinite(rise)) return { position, rotation };
  const tilt = turnBetween(ground.normal(before[0], before[1]), ground.normal(position[0], position[1]));
  return { position: add(position, [0, 0, rise]), rotation: product(tilt, rotation) };
}

/** A path displaced in the object's own frame. @param edit settings of the verb. @param begin of the page's clock in the scene's. */
export function moved(motion, edit, ground, begin) {
  const { along_m: along = 0, left_m: left = 0, up_m: up = 0, yaw_deg: yaw = 0, from_s: from = null, ground: wheels = true } = edit;
  const ramp = Math.max(edit.ramp_s ?? DEFAULT_RAMP_S, 1e-3), start = from === null ? null : from - begin;
  const keyed = start === null ? motion : motion.withKeysBetween(start, start + ramp);
  return keyed.mapped((position, rotation, t) => {
    const share = start === null ? 1 : quintic((t - start) / ramp), angle = share * yaw * Math.PI / 180, c = Math.cos(angle), s = Math.sin(angle);
    const place = add(position, turn(rotation, [share * along, share * left, share * up])), heading = product(rotation, [c, -s, 0, s, c, 0, 0, 0, 1]);
    return wheels && ground ? grounded(place, heading, position, ground) : { position: place, rotation: heading };
  });
}

/** Linear interpolation in a table with increasing first column. */
function interpolated(x, xs, ys) {
  if (x <= xs[0]) return ys[0];
  const after = xs.findIndex((one) => one >= x);
  if (after < 0) return ys[ys.length - 1];
  return ys[after - 1] + (ys[after] - ys[after - 1]) * (x - xs[after - 1]) / (xs[after] - xs[after - 1]);
}

/** A path that brakes evenly until it stands; null where it is not there at that time. */
export function stopped(motion, { at_s: at, brake_m_s2: brake = DEFAULT_BRAKE_M_S2 }, begin) {
  const t = at - begin;
  if (t < motion.times[0] || t > motion.last) return null;
  const keyed = motion.withKeysBetween(t, motion.last), way = [0], speed = motion.speedAt(t);
  for (let i = 1; i < keyed.times.length; i++) way.push(way[i - 1] + Math.hypot(...sub(keyed.positions[i], keyed.positions[i - 1])));
  const begun = interpolated(t, keyed.times, way), first = keyed.times.findIndex((one) => one >= t);
  const rising = keyed.times.map((_, i) => i).filter((i) => i >= first && (i === first || way[i] - way[i - 1] > 1e-9));
  const recording = keyed.times.map((now, i) => {
    if (i < first) return now;
    if (speed < 0.1) return t;
    const passed = Math.min(now - t, speed / brake), reached = Math.min(begun + speed * passed - brake / 2 * passed ** 2, way[i]);
    return interpolated(reached, rising.map((k) => way[k]), rising.map((k) => keyed.times[k]));
  });
  const found = recording.map((moment) => motion.sample(moment));
  return new Motion(keyed.times, found.map((one) => one.position), found.map((one) => one.turn), found.map((one) => one.source), motion.recorded);
}

// ---- scripts ----

/** The one verb of an entry and its settings. */
export const verbOf = (entry) => Object.entries(entry)[0];

/**
 * What a script leaves of a path.
 * @param entries [{verb: settings}]. @param keys the recorded path.
 * @returns {{motion, removed, unknown}} unknown: a verb of the script that the page cannot show changes this object.
 */
export function carriedOut(entries, id, keys, ground, begin) {
  let motion = Motion.of(keys), removed = false, unknown = false;
  for (const entry of entries) {
    const [verb, given] = verbOf(entry);
    if (verb === "remove" && given.ids) removed ||= given.ids.includes(id);
    else if (verb === "remove") unknown = true; // chosen by kind
    else if (given?.id !== id) continue;
    else if (verb === "move") motion = moved(motion, given, ground, begin);
    else if (verb === "stop") motion = stopped(motion, given, begin) ?? motion;
    else unknown = true;
  }
  return { motion, removed, unknown };
}

const round = (value) => Math.round(value * 1000) / 1000 + 0;

/** Entries with one further move of an object; a move right after another one of the same object becomes one with it. */
export function withMove(entries, id, { along_m: along = 0, left_m: left = 0, yaw_deg: yaw = 0 }) {
  const last = entries.length ? verbOf(entries[entries.length - 1]) : [], before = last[1];
  const joins = last[0] === "move" && before.id === id && (before.from_s ?? null) === null;
  const base = joins ? before : { id }, angle = (base.yaw_deg ?? 0) * Math.PI / 180, c = Math.cos(angle), s = Math.sin(angle);
  const settings = { ...base, along_m: round((base.along_m ?? 0) + c * along - s * left), left_m: round((base.left_m ?? 0) + s * along + c * left), yaw_deg: round((base.yaw_deg ?? 0) + yaw) };
  for (const name of ["along_m", "left_m", "yaw_deg"]) if (!settings[name]) delete settings[name];
  const rest = joins ? entries.slice(0, -1) : entries;
  return Object.keys(settings).length > 1 ? [...rest, { move: settings }] : rest;
}

/** A script as text: a line per edit, values as JSON, which is YAML. What is hidden is removed. */
export function scriptText(entries, hidden = new Set()) {
  const gone = new Set(entries.flatMap((entry) => entry.remove?.ids ?? []));
  const also = [...hidden].filter((name) => !gone.has(name)).sort();
  const all = also.length ? [...entries, { remove: { ids: also } }] : entries;
  return all.map((entry) => { const [verb, given] = verbOf(entry); return `- ${verb}: ${flow(given)}\n`; }).join("");
}

const flow = (value) => Array.isArray(value) ? `[${value.map(flow).join(", ")}]`
  : value && typeof value === "object" ? `{${Object.entries(value).map(([k, v]) => `${k}: ${flow(v)}`).join(", ")}}` : JSON.stringify(value).replace(/[\u007f-\u009f\u2028\u2029\ufeff]/g, (letter) => `\\u${letter.charCodeAt(0).toString(16).padStart(4, "0")}`);

/** One line about an edit. */
export function summary(entry) {
  const [verb, given] = verbOf(entry);
  if (verb === "erase") return [given.balls && `erase ${given.balls.length} brush mark${given.balls.length > 1 ? "s" : ""}`, given.keep && `keep a box of ${given.keep.size_m.join(" x ")} m`].filter(Boolean).join(", ");
  const who = given?.ids?.join(", ") ?? given?.id ?? "";
  const short = (value) => { const text = value?.run && value.id ? value.id : typeof value === "object" ? flow(value) : String(value); return text.length > 60 ? "..." : text; };
  const rest = Object.entries(given ?? {}).filter(([name]) => name !== "id" && name !== "ids").map(([name, value]) => `${name} ${short(value)}`);
  return `${[verb, who].filter(Boolean).join(" ")}${rest.length ? `: ${rest.join(", ")}` : ""}`;
}
