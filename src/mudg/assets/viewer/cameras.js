// Where the page looks from: along the recorded drive, behind or above the vehicle, round a point, or freely.
//
// A view is {width, height, fx, fy, cx, cy, eye, axes: [right, down, ahead], gain, offset, ground}: a pinhole camera in the world; `ground`:
// what nothing covers below the horizon is drawn as ground. The recorded sky reaches below the horizon, too, but is right from the path only.

import { PoseKeys, add, clamp, cross, dot, keysAround, quaternionOf, rotationOf, slerp, sub, unit } from "mudg/math";
import { along } from "mudg/path";

/** Ways to look, with their names for people. */
export const MODES = { recorded: "Recorded camera", chase: "Behind the vehicle", top: "From above", orbit: "Round a point", fly: "Free", path: "Along your path" };
/** The recorded path, as it was recorded. */
export const HOME = { mode: "recorded", shift: 0, up: 0, fov: 0 };
const UP = [0, 0, 1], SAME = { gain: [1, 1, 1], offset: [0, 0, 0], ground: true };
const MIDDLE = [0.3, 0.4, 0.5, 0.6, 0.7]; // places in a view, across and down, that tell whether a recorded camera looked there
const HEIGHT_OF_VIEW = 0.9; // radians, of cameras that are not recorded ones

/** The recorded views of every camera, and the vehicle's path. */
export class Drive {
  constructor(facts, log) {
    this.facts = facts;
    this.ego = new PoseKeys(log.keys.subarray(8 * facts.ego_keys[0], 8 * (facts.ego_keys[0] + facts.ego_keys[1])));
    this.frames = {};
    for (const frame of facts.frames) (this.frames[frame.camera] ??= []).push(frame);
    this.times = {};
    for (const [name, frames] of Object.entries(this.frames)) this.times[name] = frames.map((frame) => frame.t);
  }

  /** The frame of a camera that is nearest in time. */
  nearestFrame(camera, t) {
    const times = this.times[camera], found = keysAround(times, clamp(t, times[0], times[times.length - 1]));
    return this.frames[camera][found[2] < 0.5 ? found[0] : found[1]];
  }

  /** Pose of a recorded camera: eye and axes; between frames interpolated, at a frame exactly its own. */
  pose(camera, t) {
    const times = this.times[camera], [before, after, u] = keysAround(times, clamp(t, times[0], times[times.length - 1]));
    const [p, q] = [this.frames[camera][before].pose, this.frames[camera][after].pose];
    const place = (m) => [m[3], m[7], m[11]], rotation = (m) => [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]];
    if (before === after) return { eye: place(p), axes: axesOf(rotation(p)) };
    return { eye: add(place(p), sub(place(q), place(p)), u), axes: axesOf(rotationOf(slerp(quaternionOf(rotation(p)), quaternionOf(rotation(q)), u))) };
  }

  /** The vehicle's velocity in the world between the recorded poses around a time, m/s. */
  velocity(t) {
    const { times, positions } = this.ego;
    if (times.length < 2) return [0, 0, 0];
    const found = times.findIndex((one) => one >= t), after = clamp(found < 0 ? times.length : found, 1, times.length - 1);
    return sub(positions[after], positions[after - 1]).map((v) => v / (times[after] - times[after - 1]));
  }

  /** The vehicle's own left at a time, made horizontal. */
  left(t) {
    const r = this.ego.nearest(t).rotation;
    return unit([r[1], r[4], 0]);
  }
}

/** Columns of a rotation world from camera: right, down, ahead. */
const axesOf = (r) => [[r[0], r[3], r[6]], [r[1], r[4], r[7]], [r[2], r[5], r[8]]];

/** Axes of a camera that looks along a direction with its horizon level. */
function level(ahead) {
  const right = unit(cross(ahead, Math.abs(ahead[2]) > 0.999 ? [1, 0, 0] : UP));
  return [right, cross(ahead, right), ahead];
}

const direction = (yaw, pitch) => [Math.cos(pitch) * Math.cos(yaw), Math.cos(pitch) * Math.sin(yaw), Math.sin(pitch)];

/** What the viewer looks at and from where; changed by the controls, turned into a view by `view`. */
export class Cameras {
  constructor(drive, state) {
    this.drive = drive;
    this.state = state;
  }

  /** The view in pixels of a picture of at most width x height, and whether it keeps the proportions of a recorded camera. */
  view(width, height) {
    const { mode, camera, t, shift, up, fov } = this.state, recorded = this.drive.facts.cameras[camera];
    const colors = { gain: recorded.gain, offset: recorded.offset };
    if (mode === "recorded") {
      const scale = Math.min(width / recorded.width, height / recorded.height);
      const w = Math.max(1, Math.round(recorded.width * scale)), h = Math.max(1, Math.round(recorded.height * scale));
      return { ...this.shifted(camera, t, shift, up), ...lens(recorded, w, h, fov), ...colors };
    }
    const f = fov ? focal(width, fov) : 0.5 * height / Math.tan(HEIGHT_OF_VIEW / 2);
    return { ...this.free(), width, height, fx: f, fy: f, cx: width / 2, cy: height / 2, ...SAME };
  }

  /** A recorded camera moved sideways and up. */
  shifted(camera, t, shift, up) {
    const { eye, axes } = this.drive.pose(camera, t);
    return { eye: add(add(eye, this.drive.left(t), shift), UP, up), axes };
  }

  /** The recorded camera of a frame with its exact intrinsics, optionally at another width and with another field of view. */
  exact(camera, t, shift = 0, up = 0, width = 0, fov = 0) {
    const recorded = this.drive.facts.cameras[camera], w = width || recorded.width;
    const h = Math.max(1, Math.round(recorded.height * w / recorded.width));
    return { ...this.shifted(camera, t, shift, up), ...lens(recorded, w, h, fov), gain: recorded.gain, offset: recorded.offset };
  }

  free() {
    const s = this.state, { position, rotation } = this.drive.ego.nearest(s.t);
    if (s.mode === "path") return along(s.keys, s.t);
    const heading = Math.atan2(rotation[3], rotation[0]);
    if (s.mode === "fly") return { eye: s.eye, axes: level(direction(s.yaw, s.pitch)) };
    if (s.mode === "orbit") return { eye: add(s.target, direction(s.yaw, s.pitch), -s.distance), axes: level(direction(s.yaw, s.pitch)) };
    if (s.mode === "top") {
      const pitch = -1.45, ahead = direction(heading + s.turn, pitch);
      return { eye: add(add(position, ahead, -s.height), UP, 0), axes: level(ahead) };
    }
    const ahead = direction(heading + s.turn, clamp(-0.22 + s.tilt, -1.5, 1.2)), at = add(position, UP, 1.5);
    return { eye: add(at, ahead, -s.behind), axes: level(ahead) };
  }

  /** Goes on freely from where the camera is. */
  letGo() {
    const s = this.state;
    if (s.mode === "fly") return;
    const { eye, axes } = s.mode === "recorded" ? this.shifted(s.camera, s.t, s.shift, s.up) : this.free();
    Object.assign(s, { mode: "fly", eye, yaw: Math.atan2(axes[2][1], axes[2][0]), pitch: Math.asin(clamp(axes[2][2], -1, 1)) });
  }

  /** Round a point, from where the camera is. */
  orbit(target) {
    this.letGo();
    const s = this.state, way = sub(target, s.eye), distance = Math.max(1, Math.hypot(...way));
    Object.assign(s, { mode: "orbit", target, distance, yaw: Math.atan2(way[1], way[0]), pitch: Math.asin(clamp(way[2] / distance, -1, 1)) });
  }

  /** Turns by a drag of pixels. */
  drag(dx, dy, height) {
    const s = this.state, per = HEIGHT_OF_VIEW / height;
    if (s.mode === "recorded" || s.mode === "path") this.letGo();
    if (s.mode === "chase" || s.mode === "top") {
      s.turn -= dx * per * 2;
      s.tilt = clamp(s.tilt - dy * per * 2, -1.2, 1.2);
    } else {
      const sign = s.mode === "orbit" ? -2 : 1;
      s.yaw += sign * dx * per;
      s.pitch = clamp(s.pitch + sign * dy * per, -1.5, 1.5);
    }
  }

  /** Nearer or farther, by a factor. */
  zoom(factor) {
    const s = this.state;
    if (s.mode === "recorded" || s.mode === "path") this.letGo();
    if (s.mode === "chase") s.behind = clamp(s.behind * factor, 2, 80);
    else if (s.mode === "top") s.height = clamp(s.height * factor, 8, 300);
    else if (s.mode === "orbit") s.distance = clamp(s.distance * factor, 0.5, 300);
    else s.eye = add(s.eye, direction(s.yaw, s.pitch), Math.log(1 / factor) * 8);
  }

  /** Flies: metres to the right, ahead and up. */
  move(right, ahead, up) {
    this.letGo();
    const s = this.state, axes = level(direction(s.yaw, s.pitch));
    s.eye = add(add(add(s.eye, axes[0], right), axes[2], ahead), UP, up);
  }

  /** Distance of the nearest recorded camera from where the view is, metres. */
  offPath(eye) {
    let least = Infinity;
    for (const frame of this.drive.facts.frames) {
      const d = sub(eye, [frame.pose[3], frame.pose[7], frame.pose[11]]);
      least = Math.min(least, dot(d, d));
    }
    return Math.sqrt(least);
  }

  /** Share of the directions in the middle of a view, 0 to 1, in which a recorded camera looked, from wherever it was. */
  looked(view) {
    const { cameras, frames } = this.drive.facts, rays = [];
    for (const y of MIDDLE) for (const x of MIDDLE) rays.push(rayOf(view, x * view.width - 0.5, y * view.height - 0.5));
    const inside = (ray, { camera, pose: m }) => {
      const { width, height, fx, fy, cx, cy } = cameras[camera], along = (k) => m[k] * ray[0] + m[4 + k] * ray[1] + m[8 + k] * ray[2], z = along(2);
      const u = fx * along(0) / z + cx, v = fy * along(1) / z + cy;
      return z > 0 && u >= 0 && u <= width && v >= 0 && v <= height;
    };
    return rays.filter((ray) => frames.some((frame) => inside(ray, frame))).length / rays.length;
  }
}

/** Direction in the world, of length 1, in which a pixel looks. */
export function rayOf({ axes: [right, down, ahead], fx, fy, cx, cy }, x, y) {
  return unit(add(add(ahead, right, (x + 0.5 - cx) / fx), down, (y + 0.5 - cy) / fy));
}

/** Focal length of a field of view, degrees from left to right; and back. */
const focal = (width, fov) => 0.5 * width / Math.tan(fov * Math.PI / 360);
export const fovOf = ({ width, fx }) => 360 / Math.PI * Math.atan(0.5 * width / fx);

/** Intrinsics for another size of the same picture, and another field of view as of `mudg render --fov-deg` (0: as recorded). */
function lens(camera, width, height, fov) {
  const sx = fov ? focal(width, fov) / camera.fx : width / camera.width, sy = fov ? sx : height / camera.height;
  return { width, height, fx: camera.fx * sx, fy: camera.fy * sy, cx: camera.cx * width / camera.width, cy: camera.cy * height / camera.height };
}
