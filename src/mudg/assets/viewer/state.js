// What the page shows, as plain values, and as the part of its address behind "#", so that a link shows the same.

import { LAYERS } from "mudg/shaders";
import { HOME, MODES } from "mudg/cameras";
import { clamp } from "mudg/math";
import { keysOf, keysText } from "mudg/path";

/** Fields of view to choose from, degrees from left to right. */
export const FOV_DEG = [20, 130];

/** State at the beginning. */
export function initialState(facts) {
  return {
    ...HOME, camera: Object.keys(facts.cameras)[0], t: 0, layer: "color", playing: false, speed: 1, loop: true,
    compare: "none", divider: 0.5, scene: 0, boxes: false, paths: false, lidar: false, cameras: false, hidden: new Set(), selected: null, edits: [], edition: 0,
    eye: [0, 0, 2], yaw: 0, pitch: 0, target: [0, 0, 0], distance: 12, behind: 12, height: 45, turn: 0, tilt: 0, keys: [],
  };
}

const round = (value) => Math.round(value * 1000) / 1000;
const FLAGS = ["boxes", "paths", "lidar", "cameras"];

/** The state as text for an address. */
export function toHash(s) {
  const parts = { m: s.mode, c: s.camera, t: round(s.t), l: s.layer };
  if (s.shift) parts.s = round(s.shift);
  if (s.up) parts.u = round(s.up);
  if (s.fov) parts.w = round(s.fov);
  if (s.compare !== "none") Object.assign(parts, { v: s.compare, d: round(s.divider) });
  if (s.scene) parts.f = s.scene;
  const flags = FLAGS.filter((name) => s[name]);
  if (flags.length) parts.o = flags.join(",");
  if (s.hidden.size) parts.h = [...s.hidden].join(",");
  if (s.mode === "fly") parts.p = [...s.eye, s.yaw, s.pitch].map(round).join(",");
  if (s.mode === "orbit") parts.p = [...s.target, s.yaw, s.pitch, s.distance].map(round).join(",");
  if (s.keys.length) parts.k = keysText(s.keys);
  return "#" + new URLSearchParams(Object.entries(parts).map(([k, v]) => [k, String(v)])).toString();
}

/** Takes what an address says into the state; what it does not understand is left as it is. */
export function fromHash(hash, s, facts) {
  const given = new URLSearchParams(hash.replace(/^#/, ""));
  const number = (name, low, high, fallback) => {
    const value = given.has(name) ? Number(given.get(name)) : NaN;
    return Number.isFinite(value) ? clamp(value, low, high) : fallback;
  };
  if (Object.hasOwn(facts.cameras, given.get("c") ?? "")) s.camera = given.get("c");
  if (LAYERS.includes(given.get("l"))) s.layer = given.get("l");
  s.t = number("t", 0, facts.end_s, s.t);
  s.shift = number("s", -8, 8, s.shift);
  s.up = number("u", -2, 8, s.up);
  s.fov = number("w", FOV_DEG[0], FOV_DEG[1], s.fov);
  s.divider = number("d", 0, 1, s.divider);
  s.scene = Math.round(number("f", 0, facts.scenes.length - 1, s.scene));
  if (["none", "divider", "difference"].includes((given.get("v") ?? "").split("-")[0])) s.compare = given.get("v");
  for (const name of FLAGS) s[name] = (given.get("o") ?? "").split(",").includes(name);
  const known = new Set(facts.scenes.flatMap((scene) => scene.nodes.map((node) => node.name)));
  s.hidden = new Set((given.get("h") ?? "").split(",").filter((name) => known.has(name)));
  s.keys = (given.has("k") && keysOf(given.get("k"), facts.end_s)) || [];
  const p = (given.get("p") ?? "").split(",").map(Number);
  const mode = given.get("m");
  if (mode === "fly" && p.length === 5 && p.every(Number.isFinite)) Object.assign(s, { mode, eye: p.slice(0, 3), yaw: p[3], pitch: p[4] });
  else if (mode === "orbit" && p.length === 6 && p.every(Number.isFinite)) Object.assign(s, { mode, target: p.slice(0, 3), yaw: p[3], pitch: p[4], distance: p[5] });
  else if (mode !== "fly" && mode !== "orbit" && Object.hasOwn(MODES, mode ?? "") && (mode !== "path" || s.keys.length)) s.mode = mode;
  return s;
}
