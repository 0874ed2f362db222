// Boxes, paths, LiDAR points and recorded cameras, drawn over the picture. They are not hidden by what stands before them.

import { add, dot, project, sub, turn } from "mudg/math";
import { boxOf } from "mudg/erase";
import { along } from "mudg/path";

const EDGES = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];
const NEAREST = 0.25;
const EGO_COLOR = "hsl(0 0% 100%)", PATH_COLOR = "#ffd54a", PATH_STEPS = 100; // of the camera path
const LABELS_WITHIN_M = 60; // names farther away would be of specks
const EGO = { id: "", label: "recording vehicle", size_m: [4.6, 1.9, 1.5], ahead_m: 1.35 }; // a usual car, from its rear axle: logs do not know

/** A colour that belongs to a track, the same on every page. */
export function trackColor(id) {
  let hash = 0;
  for (const letter of id) hash = (hash * 31 + letter.codePointAt(0)) >>> 0;
  return `hsl(${hash % 360} 85% 62%)`;
}

/** The part of a stretch in the world that lies before the camera, as two places in the picture; null where nothing does. */
export function ahead(view, p, q) {
  const z = (place) => dot(view.axes[2], sub(place, view.eye)), [a, b] = [z(p) - NEAREST, z(q) - NEAREST];
  if (a < 0 && b < 0) return null;
  const cut = () => add(p, sub(q, p), a / (a - b));
  return [a < 0 ? cut() : p, b < 0 ? cut() : q].map((place) => project(view, place));
}

export class Overlay {
  /** @param tracks [{id, label, size_m, pose: PoseKeys}]. @param sweeps [{t, points: Float32Array}] in the world. */
  constructor(canvas, tracks, sweeps, drive) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    Object.assign(this, { tracks, sweeps, drive });
    this.thumbnails = []; // where recorded cameras were drawn: {x, y, frame}
  }

  /** Draws what the state asks for. @param area of the picture in the canvas, from its upper left corner: [x, y, width, height]. */
  draw(view, area, state, ratio) {
    const c = this.context;
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.clearRect(0, 0, this.canvas.width, this.canvas.height);
    this.thumbnails = [];
    this.labels = [];
    const flown = state.mode !== "path" && state.keys.length > 0;
    const empty = !(flown || state.boxes || state.paths || state.lidar || state.cameras || state.selected || boxOf(state.edits));
    this.canvas.style.visibility = empty ? "hidden" : "visible"; // a canvas that is only cleared may keep its old picture on the screen
    if (empty) return;
    c.save();
    c.beginPath();
    c.rect(...area);
    c.clip();
    c.translate(area[0], area[1]);
    this.ratio = ratio;
    if (state.lidar) this.points(view, state.t);
    if (state.cameras) this.frustums(view, state);
    for (const track of this.tracks) {
      if (track.removed) continue;
      const chosen = state.selected === track.id;
      if (state.paths || chosen) this.path(view, track, state.t);
      if (state.boxes || chosen) this.box(view, track, state.t, chosen);
    }
    if (state.boxes && state.mode !== "recorded") this.box(view, { ...EGO, pose: this.egoKeys() }, state.t, false, EGO_COLOR);
    this.names();
    if (state.paths) this.line(view, this.drive.ego.positions, "rgb(255 255 255 / .8)", 2);
    if (flown) this.flown(view, state.keys);
    if (state.selected) this.gizmo?.draw(c, view, ratio);
    this.brush?.draw(c, view, ratio);
    c.restore();
  }

  line(view, points, color, width, dash = []) {
    const c = this.context;
    c.strokeStyle = color;
    c.lineWidth = width * this.ratio;
    c.setLineDash(dash.map((v) => v * this.ratio));
    c.beginPath();
    let last = null;
    for (let i = 1; i < points.length; i++) {
      const part = ahead(view, points[i - 1], points[i]);
      if (!part) continue;
      const [[x0, y0], [x1, y1]] = part;
      if (!last || last[0] !== x0 || last[1] !== y0) c.moveTo(x0, y0);
      c.lineTo(x1, y1);
      last = [x1, y1];
    }
    c.stroke();
    c.setLineDash([]);
  }

  /** The camera path, a mark at each key. */
  flown(view, keys) {
    const begin = keys[0].t, step = (keys[keys.length - 1].t - begin) / PATH_STEPS, c = this.context;
    this.line(view, Array.from({ length: PATH_STEPS + 1 }, (_, k) => along(keys, begin + k * step).eye), PATH_COLOR, 2);
    c.fillStyle = PATH_COLOR;
    for (const [x, y, z] of keys.map((key) => project(view, key.eye))) if (z >= NEAREST) c.fillRect(x - 4 * this.ratio, y - 4 * this.ratio, 8 * this.ratio, 8 * this.ratio);
  }

  path(view, track, t) {
    const { times, positions } = track.pose, color = trackColor(track.id), here = track.pose.at(t)?.position;
    const past = positions.filter((_, i) => times[i] <= t), future = positions.filter((_, i) => times[i] >= t);
    this.line(view, here ? [...past, here] : past, color, 2.5);
    this.line(view, here ? [here, ...future] : future, color, 1.5, [5, 4]);
  }

  /** The recording vehicle's path, of the middle of its box: on the ground where that is known. */
  egoKeys() {
    const { ego } = this.drive, up = [0, 0, EGO.size_m[2] / 2];
    const middle = ({ position: [x, y, z], rotation }) => add(add([x, y, this.gizmo?.editor.ground?.height(x, y) || z], turn(rotation, [EGO.ahead_m, 0, 0])), up);
    const at = (pose) => pose && { ...pose, position: middle(pose) };
    return { at: (t) => at(ego.at(t)), speed: (t) => ego.speed(t) };
  }

  /** Names of boxes: the chosen one, then the nearest; one that would cover another is left out. */
  names() {
    const c = this.context, unit = this.ratio, placed = [];
    c.font = `${12 * unit}px system-ui, sans-serif`;
    for (const { text, color, place: [x, y] } of this.labels.sort((a, b) => a.far - b.far)) {
      const wide = c.measureText(text).width, box = [x - wide / 2 - 7 * unit, y - 19 * unit, x + wide / 2 + 4 * unit, y - 3 * unit];
      if (placed.some((other) => box[0] < other[2] && box[2] > other[0] && box[1] < other[3] && box[3] > other[1])) continue;
      placed.push(box);
      c.fillStyle = "rgb(12 14 18 / .78)";
      c.fillRect(box[0] + 3 * unit, box[1], wide + 8 * unit, 16 * unit);
      c.fillStyle = color;
      c.fillRect(box[0], box[1], 3 * unit, 16 * unit);
      c.fillStyle = "#f2f4f8"; // some colours of boxes are hard to read
      c.fillText(text, x - wide / 2, y - 7 * unit);
    }
    this.named = placed.length;
  }

  box(view, track, t, chosen, color = trackColor(track.id)) {
    const pose = track.pose.at(t);
    if (!pose) return;
    const half = track.size_m.map((v) => v / 2), c = this.context;
    const places = Array.from({ length: 8 }, (_, k) => add(pose.position,
      turn(pose.rotation, [(k & 4 ? 1 : -1) * half[0], (k & 2 ? 1 : -1) * half[1], (k & 1 ? 1 : -1) * half[2]])));
    const corners = places.map((place) => project(view, place)).filter(([, , z]) => z >= NEAREST);
    if (!corners.length) return;
    c.strokeStyle = color;
    c.lineWidth = (chosen ? 3 : 1.5) * this.ratio;
    c.beginPath();
    for (const [a, b] of EDGES) {
      const edge = ahead(view, places[a], places[b]);
      if (edge) { c.moveTo(edge[0][0], edge[0][1]); c.lineTo(edge[1][0], edge[1][1]); }
    }
    c.stroke();
    c.fillStyle = color.replace(")", " / .22)"); // the front face
    c.beginPath();
    [4, 5, 7, 6].forEach((k, i, face) => ahead(view, places[k], places[face[(i + 1) % 4]])?.forEach(([x, y]) => c.lineTo(x, y)));
    c.fill();
    if (!chosen && corners[0][2] > LABELS_WITHIN_M) return;
    const top = corners.reduce((best, corner) => (corner[1] < best[1] ? corner : best));
    const speed = track.pose.speed(t), text = `${track.id} ${track.label}${speed > 0.2 ? ` ${(speed * 3.6).toFixed(0)} km/h` : ""}`.trim();
    this.labels.push({ text, color, place: top, far: chosen ? 0 : corners[0][2] });
  }

  points(view, t) {
    if (!this.sweeps.length) return;
    const sweep = this.sweeps.reduce((best, one) => (Math.abs(one.t - t) < Math.abs(best.t - t) ? one : best)), c = this.context, p = sweep.points;
    for (let i = 0; i < p.length; i += 3) {
      const [x, y, z] = project(view, [p[i], p[i + 1], p[i + 2]]);
      if (z < NEAREST || x < 0 || y < 0 || x > view.width || y > view.height) continue;
      const size = Math.max(1.2, Math.min(4, 24 / z)) * this.ratio;
      c.fillStyle = `hsl(${Math.max(0, 250 - 5 * z)} 90% 60%)`;
      c.fillRect(x - size / 2, y - size / 2, size, size);
    }
  }

  frustums(view, state) {
    const c = this.context;
    for (const [name, frames] of Object.entries(this.drive.frames)) {
      const camera = this.drive.facts.cameras[name];
      for (const frame of frames) {
        const m = frame.pose, eye = [m[3], m[7], m[11]], chosen = name === state.camera && Math.abs(frame.t - state.t) < 0.04;
        const corners = [[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]].map(([u, v]) => {
          const ray = [(u - camera.cx) / camera.fx * 0.5, (v - camera.cy) / camera.fy * 0.5, 0.5];
          return project(view, [0, 1, 2].map((k) => m[4 * k] * ray[0] + m[4 * k + 1] * ray[1] + m[4 * k + 2] * ray[2] + eye[k]));
        });
        const tip = project(view, eye);
        if (tip[2] < 1 || corners.some((corner) => corner[2] < NEAREST)) continue;
        c.strokeStyle = chosen ? "#ffd54a" : "rgb(120 190 255 / .75)";
        c.lineWidth = (chosen ? 2.5 : 1) * this.ratio;
        c.beginPath();
        for (const corner of corners) { c.moveTo(tip[0], tip[1]); c.lineTo(corner[0], corner[1]); }
        c.moveTo(corners[3][0], corners[3][1]);
        for (const corner of corners) c.lineTo(corner[0], corner[1]);
        c.stroke();
        const mean = [0, 1].map((k) => corners.reduce((sum, corner) => sum + corner[k], 0) / 4);
        this.thumbnails.push({ x: mean[0], y: mean[1], frame });
      }
    }
  }

  /** The recorded camera that is drawn at a place of the picture. */
  frameAt(x, y, reach = 14) {
    let best = null, least = (reach * this.ratio) ** 2;
    for (const one of this.thumbnails) {
      const d = (one.x - x) ** 2 + (one.y - y) ** 2;
      if (d < least) { least = d; best = one.frame; }
    }
    return best;
  }
}
