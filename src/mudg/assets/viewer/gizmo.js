// Handles at the selected object: along and across its own axes on the ground, free on the ground, and a turn about the vertical.

import { add, clamp, dot, project, sub, turn, unit } from "mudg/math";
import { withMove } from "mudg/edits";

const REACH_PX = 20; // of a finger, in pixels of the page
const BEYOND_M = 0.9, FARTHEST_M = 200, NEAREST_M = 0.3;
const COLORS = { along: "#ff6b5e", left: "#5ee07a", free: "#ffd54a", yaw: "#6cb2ff" };

/** Direction of a pixel of a view in the world; not of unit length. */
export const rayOf = (view, x, y) => add(add(view.axes[2], view.axes[0], (x - view.cx) / view.fx), view.axes[1], (y - view.cy) / view.fy);

/** The object whose box a pixel shows, the nearest one; null where there is none. */
export function objectAt(view, x, y, tracks, t) {
  const ray = rayOf(view, x, y);
  let best = null, least = Infinity;
  for (const track of tracks) {
    const pose = track.removed ? null : track.pose.at(t);
    if (!pose) continue;
    const r = pose.rotation, back = [r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]];
    const from = turn(back, sub(view.eye, pose.position)), way = turn(back, ray);
    let near = 0, far = Infinity;
    for (let k = 0; k < 3; k++) {
      const half = track.size_m[k] / 2, a = (-half - from[k]) / way[k], b = (half - from[k]) / way[k];
      near = Math.max(near, Math.min(a, b));
      far = Math.min(far, Math.max(a, b));
    }
    if (near <= far && near > 0 && near < least) { least = near; best = track.id; }
  }
  return best;
}

export class Gizmo {
  /** @param editor see editor.js. */
  constructor(app, editor) {
    Object.assign(this, { app, editor, held: null });
  }

  /** Where the handles of the selected object are in the world; null where there is nothing to hold. */
  frame() {
    const { selected, t } = this.app.state, track = this.app.tracks.find((one) => one.id === selected);
    if (!track || track.removed || !this.editor.can(selected)) return null;
    const pose = track.pose.at(t);
    if (!pose) return null;
    const r = pose.rotation, [length, width, height] = track.size_m;
    const base = sub(pose.position, turn(r, [0, 0, height / 2])), ahead = unit([r[0], r[3], 0]), left = [-ahead[1], ahead[0], 0];
    return { base, ahead, left, along: add(base, ahead, length / 2 + BEYOND_M), side: add(base, left, width / 2 + BEYOND_M),
      back: add(base, ahead, -length / 2 - BEYOND_M), radius: length / 2 + BEYOND_M };
  }

  /** Places of the handles on the picture by name. */
  handles(view, frame) {
    const places = { along: frame.along, left: frame.side, free: frame.base, yaw: frame.back };
    return Object.fromEntries(Object.entries(places).map(([name, place]) => [name, project(view, place)]).filter(([, p]) => p[2] > NEAREST_M));
  }

  draw(c, view, ratio) {
    const frame = this.frame();
    if (!frame) return;
    const places = this.handles(view, frame), ring = Array.from({ length: 49 }, (_, k) => {
      const angle = k * Math.PI / 24;
      return project(view, add(add(frame.base, frame.ahead, frame.radius * Math.cos(angle)), frame.left, frame.radius * Math.sin(angle)));
    });
    const stroke = (points, color, width) => {
      for (const [look, wide] of [["rgb(0 0 0 / .55)", width + 2], [color, width]]) {
        c.strokeStyle = look;
        c.lineWidth = wide * ratio;
        c.beginPath();
        let down = false;
        for (const [x, y, z] of points) { if (z < NEAREST_M) down = false; else if (down) c.lineTo(x, y); else { c.moveTo(x, y); down = true; } }
        c.stroke();
      }
    };
    stroke(ring, COLORS.yaw, 1.5);
    for (const name of ["along", "left"]) if (places[name] && places.free) stroke([places.free, places[name]], COLORS[name], 3);
    for (const [name, [x, y]] of Object.entries(places)) {
      c.fillStyle = COLORS[name];
      c.strokeStyle = "rgb(0 0 0 / .7)";
      c.lineWidth = 1.5 * ratio;
      c.beginPath();
      c.arc(x, y, (this.held?.name === name ? 10 : 7.5) * ratio, 0, 2 * Math.PI);
      c.fill();
      c.stroke();
    }
  }

  /** Takes hold of the handle at a place of the picture; whether there is one. */
  take(x, y) {
    const { view, ratio = 1 } = this.app.last, frame = view && this.frame();
    if (!frame) return false;
    let name = null, least = (REACH_PX * ratio) ** 2;
    for (const [one, place] of Object.entries(this.handles(view, frame))) {
      const d = (place[0] - x) ** 2 + (place[1] - y) ** 2;
      if (d < least) { least = d; name = one; }
    }
    const from = name && this.onGround(view, x, y, frame.base[2]);
    if (!from) return false;
    this.held = { name, from, frame, id: this.app.state.selected, entries: this.app.state.edits };
    this.app.change({ playing: false });
    return true;
  }

  /** The held handle follows the pointer. */
  drag(x, y) {
    const { name, from, frame, id, entries } = this.held, to = this.onGround(this.app.last.view, x, y, frame.base[2]);
    if (!to) return;
    const way = sub(to, from), by = {};
    if (name === "along" || name === "free") by.along_m = dot(way, frame.ahead);
    if (name === "left" || name === "free") by.left_m = dot(way, frame.left);
    if (name === "yaw") {
      const angle = (p) => Math.atan2(p[1] - frame.base[1], p[0] - frame.base[0]), apart = angle(to) - angle(from);
      by.yaw_deg = Math.atan2(Math.sin(apart), Math.cos(apart)) * 180 / Math.PI;
    }
    this.editor.show(withMove(entries, id, by));
  }

  release() {
    const { entries } = this.held;
    this.held = null;
    this.editor.noted(entries);
  }

  onGround(view, x, y, z) {
    const ray = rayOf(view, x, y), s = (z - view.eye[2]) / ray[2], reach = s * Math.hypot(...ray);
    return s > 0 && reach < FARTHEST_M ? add(view.eye, ray, clamp(s, 0, FARTHEST_M)) : null;
  }
}
