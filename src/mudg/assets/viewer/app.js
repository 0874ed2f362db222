// Holds the page together: data, state, renderer and overlay; decides what is drawn when. The controls are in ui.js.

import { Arrival } from "mudg/arrival";
import { Cameras, Drive, rayOf } from "mudg/cameras";
import { SplatScene, bytesOf, inflate, sectionsOf } from "mudg/data";
import { PoseKeys, clamp } from "mudg/math";
import { Overlay } from "mudg/overlay";
import { Renderer } from "mudg/renderer";
import { fromHash, initialState, toHash } from "mudg/state";

const REST_MS = 180; // without a change: draw at full size
const SLOW_MS = 45, QUICK_MS = 18; // of a frame while moving: draw smaller, or larger again
const SMALLEST = 0.22;
const FRESH_MS = 250, FRESH_TIMES = 10; // at least, between pictures with more and more of a scene; and in times of the last one
const CERTAIN = 0.2; // certainty from which on a surface is called determined by the recording
const HORIZON = 0.03; // what nothing covers and lies so far below the horizon, as a sine, is ground, not sky
const LONGEST_MS = 2500, LOADING_MS = 300; // of a picture at rest, and while chunks arrive: what would take longer is drawn smaller
const PROBES = [SMALLEST, 0.4]; // sizes of the first pictures, which tell how long larger ones take
const MOST_PIXELS = 2560 * 1440;
const GROUND = ["road", "sidewalk", "terrain"]; // classes that snow covers

export class App {
  /** @param facts of the page. @param parts {canvas, overlay, stage}: elements. */
  constructor(facts, parts) {
    this.facts = facts;
    Object.assign(this, parts);
    this.state = fromHash(location.hash, initialState(facts), facts);
    this.renderer = new Renderer(parts.canvas, facts);
    this.loaded = [];
    this.images = new Map();
    this.quality = 0.3;
    this.timed = {}; // layer -> the last two pictures of different size: [share of the pixels, milliseconds]
    this.changed = 0;
    this.last = { area: [0, 0, 1, 1], view: null };
    this.listeners = new Set();
    this.ready = false;
    this.fresh = false; // chunks have come that were not drawn
    this.drawnAt = 0;
    this.drawMs = 0;
  }

  /** Brings the log and a coarse picture, starts, and goes on with the rest; `progress` gets a share between 0 and 1. */
  async load(progress) {
    const { facts } = this;
    const log = sectionsOf(await inflate(await bytesOf(facts.log.file)), facts.log.directory);
    progress(0.3);
    this.drive = new Drive(facts, log);
    this.cameras = new Cameras(this.drive, this.state);
    this.renderer.velocity = (t) => this.drive.velocity(t);
    const tracks = facts.tracks.map((track) => ({ ...track, pose: new PoseKeys(log.keys.subarray(8 * track.keys[0], 8 * (track.keys[0] + track.keys[1]))) }));
    const sweeps = facts.lidar.map(({ t, first, count }) => {
      const points = new Float32Array(3 * count), all = log.lidar.length / 3;
      for (let i = 0; i < 3 * count; i++) points[i] = facts.lidar_low[i % 3] + log.lidar[(i % 3) * all + first + Math.floor(i / 3)] * facts.lidar_step[i % 3];
      return { t, points };
    });
    this.tracks = tracks;
    this.ground = log.ground ?? null; // levels of heights
    for (const scene of facts.scenes) {
      const sections = sectionsOf(await inflate(await bytesOf(scene.file)), scene.directory);
      this.loaded.push(this.renderer.load(new SplatScene(scene, sections, GROUND.map((name) => facts.class_names.indexOf(name)))));
    }
    progress(0.5);
    for (const node of this.loaded[0].scene.nodes) { // boxes as the fit corrected them
      const track = tracks.find((one) => one.id === node.name);
      if (track && node.pose) track.pose = node.pose;
    }
    this.overlayDrawer = new Overlay(this.overlay, tracks, sweeps, this.drive);
    this.arrival = new Arrival(this.renderer, this.loaded, () => this.last.view?.eye ?? this.drive.ego.nearest(this.state.t).position,
      () => { const { left, right } = this.used(); return [left, right]; });
    await this.arrival.first();
    this.photographs = null;
    this.rest = this.loadRest();
    this.ready = true;
    progress(1);
    this.start();
  }

  /** The recorded images, and all further chunks, which are shown as they come. */
  async loadRest() {
    this.arrival.listeners.add(() => { this.fresh = true; });
    if (this.facts.images.count) {
      bytesOf(this.facts.images.file).then((bytes) => { this.photographs = bytes; this.change(); },
        (error) => { document.getElementById("note").textContent = `No recorded images: ${error.message}`; });
    }
    await this.arrival.begin();
  }

  start() {
    new ResizeObserver(() => this.change()).observe(this.stage);
    addEventListener("hashchange", () => { if (location.hash !== this.hash) { fromHash(location.hash, this.state, this.facts); this.change(); } });
    this.change();
    const step = (now) => { this.frame(now); requestAnimationFrame(step); };
    requestAnimationFrame(step);
  }

  /** Notes that something changed: sort, draw, tell the controls. */
  change(values = {}) {
    Object.assign(this.state, values);
    this.dirty = true;
    this.sharp = false;
    this.exact = null;
    this.changed = performance.now();
    for (const listener of this.listeners) listener(this.state);
  }

  /** Draws the same once more, because something that was missing is there. */
  again() {
    this.dirty = true;
    this.sharp = false;
  }

  /** The scenes in use: the one that is shown, and the one it is compared with. */
  used() {
    const { scene, compare } = this.state, mode = compare.split("-")[0], other = compare.split("-")[1];
    const right = mode === "none" ? null : other === "recorded" || this.loaded.length < 2 ? "recorded" : this.loaded[1 - scene];
    return { left: this.loaded[scene], right, mode: mode === "none" ? "one" : mode };
  }

  /** The time that is played, seconds: that of the path, or of the drive. */
  span() {
    const { mode, keys } = this.state;
    return mode === "path" ? [keys[0].t, keys[keys.length - 1].t] : [0, this.facts.end_s];
  }

  frame(now) {
    const s = this.state;
    if (s.playing) {
      const t = s.t + Math.min(0.25, (now - (this.before ?? now)) / 1000) * s.speed, [begin, end] = this.span();
      if (t > end && !s.loop) this.change({ t: end, playing: false });
      else this.change({ t: t > end ? begin : Math.max(begin, t) });
    }
    this.move?.(Math.min(0.25, (now - (this.before ?? now)) / 1000));
    this.before = now;
    if (this.fresh && now - this.drawnAt > Math.max(FRESH_MS, FRESH_TIMES * this.drawMs)) { // more Gaussians, but not at the cost of the controls
      this.fresh = false;
      this.again();
    }
    const resting = now - this.changed > REST_MS && !s.playing;
    if (!this.dirty && (this.sharp || !resting)) return;
    this.draw(resting ? this.restQuality() : this.quality, resting);
  }

  /** How large a picture at rest may be. Its time is a constant, of the Gaussians, and a part that grows with its pixels. */
  restQuality() {
    const timed = this.timed[this.state.layer] ?? [];
    if (timed.length < 2) return PROBES[timed.length && timed[0][0] === PROBES[0] ** 2 ? 1 : 0];
    const [[p, a], [q, b]] = timed, perPixel = Math.max((b - a) / (q - p), 1e-3), constant = Math.max(0, b - perPixel * q);
    const longest = this.arrival.state() === "loading" ? LOADING_MS : LONGEST_MS;
    return clamp(Math.sqrt(Math.max(longest - constant, constant) / perPixel), SMALLEST, 1);
  }

  /** Notes how long a picture took. */
  time(quality, ms) {
    const timed = this.timed[this.state.layer] ??= [], pixels = quality * quality;
    this.timed[this.state.layer] = [...timed.filter(([share]) => Math.abs(share - pixels) > 0.02), [pixels, ms]].slice(-2);
  }

  /** Sizes of canvas and picture in pixels: [canvas width, height, ratio]. */
  size() {
    const box = this.stage.getBoundingClientRect(), wish = Math.min(2, devicePixelRatio || 1);
    const ratio = Math.min(wish, Math.sqrt(MOST_PIXELS / Math.max(1, box.width * box.height)));
    return [Math.max(2, Math.round(box.width * ratio)), Math.max(2, Math.round(box.height * ratio)), ratio];
  }

  draw(quality, resting) {
    const began = performance.now(), [width, height, ratio] = this.size(), s = this.state;
    this.dirty = false;
    if (this.canvas.width !== width || this.canvas.height !== height) {
      for (const one of [this.canvas, this.overlay]) Object.assign(one, { width, height });
    }
    const whole = this.cameras.view(width, height), area = [Math.round((width - whole.width) / 2), Math.round((height - whole.height) / 2), whole.width, whole.height];
    this.last = { area, view: whole, ratio };
    this.overlayDrawer.draw(whole, area, s, ratio);
    const small = scaled(whole, quality), { left, right, mode } = this.used();
    for (const one of new Set([left, right])) if (one?.sorter) this.ensureOrder(one, small);
    if (left.drawn === null) return;
    const below = [area[0], height - area[1] - area[3], area[2], area[3]];
    const pictures = [this.pictureOf("left", left, small), right === "recorded" ? this.photo() : right ? this.pictureOf("right", right, small) : null];
    this.putExact(pictures);
    this.renderer.present(pictures[0] ?? pictures[1] ?? this.pictureOf("left", left, small, "color"), pictures[1], below, mode, s.divider);
    this.renderer.gl.readPixels(0, 0, 1, 1, this.renderer.gl.RGBA, this.renderer.gl.UNSIGNED_BYTE, new Uint8Array(4)); // waits: the time is the true one
    const ms = performance.now() - began;
    if (this.drawnBefore) this.time(quality, ms); // the first one also compiles the programs
    this.drawnBefore = true;
    this.drawnAt = performance.now();
    this.drawMs = ms;
    if (resting && this.timed[s.layer]?.length === 2) this.rested();
    else if (!resting) this.quality = clamp(quality * (ms > SLOW_MS ? 0.8 : ms < QUICK_MS ? 1.12 : 1), SMALLEST, 0.999);
    this.told(ms, quality);
  }

  /** Puts exact frames, where there are some of this view, in the place of the page's own pictures. */
  putExact(pictures) {
    this.exact?.images.forEach((image, k) => { pictures[k] = this.renderer.photograph(`exact ${k}`, this.exact.key, image); });
  }

  /** Changes the state and returns when every scene in use is sorted for it. */
  async settled(values) {
    this.change(values);
    const [width, height, ratio] = this.size(), view = this.cameras.view(width, height), { left, right } = this.used(), { state } = this;
    for (const one of new Set([left, right])) {
      if (!one?.sorter) continue;
      let order = null;
      while (!order) order = await one.sorter.order(this.renderer.request(one, view, state.t, state.hidden)); // the page may ask in between
      this.renderer.use(one, order);
    }
    const frame = this.drive.nearestFrame(state.camera, state.t);
    while (frame.image && this.photographs && !this.image(frame)) await new Promise((resolve) => setTimeout(resolve, 10));
    const area = [Math.round((width - view.width) / 2), Math.round((height - view.height) / 2), view.width, view.height];
    this.last = { area, view, ratio };
    this.overlayDrawer.draw(view, area, state, ratio);
  }

  /** Keeps the order of a scene up to date; draws again when a better one is there. */
  ensureOrder(loaded, view) {
    const key = [loaded.present, this.state.t, ...view.eye, ...view.axes[2], [...this.state.hidden].join(), this.state.edition].join();
    if (loaded.key === key) return;
    loaded.key = key;
    this.renderer.sort(loaded, view, this.state.t, this.state.hidden, (there) => { if (there) this.again(); });
  }

  pictureOf(name, loaded, view, layer = this.state.layer) {
    if (layer === "recorded") return this.photo();
    return this.renderer.picture(name, loaded, view, this.state.t, layer, this.state.hidden);
  }

  told(ms, quality) {
    const data = document.documentElement.dataset;
    data.frameMs = ms.toFixed(1);
    data.drawn = String(this.used().left.drawn);
    if (!data.firstPictureMs) data.firstPictureMs = performance.now().toFixed(0);
    this.stats?.(ms, quality);
  }

  /** What happens when the camera rests: the address is renewed, the exact frame asked for. */
  rested() {
    this.sharp = true;
    if (document.documentElement.dataset.rested === undefined) document.documentElement.dataset.rested = "yes";
    this.hash = toHash(this.state);
    history.replaceState(null, "", this.hash);
    this.onRest?.();
  }

  // ---- photographs ----

  /** The recorded image of the frame that is nearest in time, as a picture; null until it is decoded. */
  photo() {
    const frame = this.drive.nearestFrame(this.state.camera, this.state.t), image = this.image(frame);
    return image instanceof ImageBitmap ? this.renderer.photograph("recorded", frame.id, image) : null;
  }

  /** An address of a recorded image for <img>; null where the page has none. */
  imageUrl(frame) {
    if (!frame.image || !this.photographs) return null;
    frame.blobUrl ??= URL.createObjectURL(new Blob([this.photographs.subarray(frame.image[0], frame.image[0] + frame.image[1])], { type: "image/webp" }));
    return frame.blobUrl;
  }

  image(frame) {
    if (!frame.image || !this.photographs) return null;
    if (!this.images.has(frame.id)) {
      const bytes = this.photographs.subarray(frame.image[0], frame.image[0] + frame.image[1]);
      this.images.set(frame.id, null);
      createImageBitmap(new Blob([bytes], { type: "image/webp" }), { colorSpaceConversion: "none" })
        .then((bitmap) => { this.images.set(frame.id, bitmap); this.again(); });
    }
    return this.images.get(frame.id);
  }

  // ---- measurements ----

  /**
   * Draws one exact view and returns its numbers.
   * @param wanted {camera, t, shift, width, layers, scene}.
   * @returns {width, height, values: {layer: base64 of floats [height, width, 4], or of bytes for "class"}}
   */
  async measure({ camera, t, shift = 0, width = 0, layers = ["color"], scene = 0, hidden = [] }) {
    await this.arrival.whole;
    const view = this.cameras.exact(camera, t, shift, 0, width), loaded = this.loaded[scene], without = new Set(hidden), values = {};
    let order = null;
    while (!order) order = await loaded.sorter.order(this.renderer.request(loaded, view, t, without)); // the page may ask in between
    this.renderer.use(loaded, order);
    for (const layer of layers) {
      const picture = layer === "class" || layer === "color";
      const found = picture ? this.renderer.bytes(this.renderer.picture("measured", loaded, view, t, layer, without, true))
        : this.renderer.read(loaded, view, t, layer, without);
      values[layer] = base64(new Uint8Array(found.buffer));
    }
    loaded.key = null;
    this.change();
    return { width: view.width, height: view.height, drawn: order.length, sortMs: loaded.sorter.ms, values };
  }

  /**
   * What a small picture of this view shows, in shares of its pixels without the sky, 0 to 1. What nothing covers is sky above the horizon,
   * and below it ground that is missing.
   * @returns {sure: determined by photographs, empty: nothing is there}; null where the fit does not know, or all is sky.
   */
  seenShare(view) {
    const loaded = this.used().left;
    if (!loaded.scene.hasCertainty || loaded.drawn === null) return null;
    const small = scaled(view, Math.min(1, 96 / view.width)), sums = this.renderer.read(loaded, small, this.state.t, "confidence", this.state.hidden);
    let sure = 0, covered = 0, empty = 0;
    for (let i = 0; i < sums.length; i += 4) {
      if (sums[i + 3] >= 0.5) { covered++; if (sums[i] > CERTAIN) sure++; }
      else if (rayOf(small, (i / 4) % small.width, Math.floor(i / 4 / small.width))[2] < -HORIZON) empty++;
    }
    const all = covered + empty;
    return all ? { sure: sure / all, empty: empty / all } : null;
  }
}

/** The same view with fewer pixels, or with more. */
export function scaled(view, factor) {
  if (Math.abs(factor - 1) < 0.0015) return view;
  const width = Math.max(8, Math.round(view.width * factor)), height = Math.max(8, Math.round(view.height * factor));
  const sx = width / view.width, sy = height / view.height;
  return { ...view, width, height, fx: view.fx * sx, fy: view.fy * sy, cx: view.cx * sx, cy: view.cy * sy };
}

function base64(bytes) {
  let text = "";
  for (let i = 0; i < bytes.length; i += 32768) text += String.fromCharCode(...bytes.subarray(i, i + 32768));
  return btoa(text);
}
