// The controls: each changes the state through App.change, and shows what the state says.

import { HOME, MODES, fovOf } from "mudg/cameras";
import { LAYERS } from "mudg/shaders";
import { clamp, project } from "mudg/math";
import { trackColor } from "mudg/overlay";
import { FOV_DEG } from "mudg/state";
import { withKey } from "mudg/path";
import { recordVideo, saveEdits, saveFrames, saveLink, savePath, savePicture } from "mudg/share";

const LAYER_NAMES = { color: "Color", depth: "Depth", class: "Classes", instance: "Objects", normal: "Normals", confidence: "Confidence", recorded: "Recorded" };
const OVERLAYS = { boxes: "Boxes", paths: "Trajectories", lidar: "LiDAR", cameras: "Recorded cameras" };
const SPEEDS = [0.1, 0.25, 0.5, 1, 2];
const SEEN = 0.6, PARTLY = 0.35; // shares of a view that the recording determines
const FAR_M = 5, LOOKED = 0.5; // farther away from all recorded cameras, or with less of the view in their directions: partly seen at best
const $ = (id) => document.getElementById(id);

/** An element with attributes and children; text is always text. */
export function make(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value !== null) made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

function radios(box, name, choices, chosen, pick) {
  for (const [value, title] of Object.entries(choices)) {
    const input = make("input", { type: "radio", name, value, checked: value === chosen, onchange: () => pick(value) });
    box.append(make("label", {}, input, make("span", {}, title)));
  }
}

function options(select, choices, pick) {
  for (const [value, title] of Object.entries(choices)) select.append(make("option", { value }, title));
  select.addEventListener("change", () => pick(select.value));
}

export class Controls {
  constructor(app) {
    this.app = app;
    const { facts, state } = app, change = (values) => app.change(values);
    const layers = Object.fromEntries(LAYERS.filter((name) => this.has(name)).map((name) => [name, LAYER_NAMES[name]]));
    radios($("layers"), "layer", layers, state.layer, (layer) => change({ layer }));
    options($("mode"), MODES, (mode) => this.mode(mode));
    options($("camera"), Object.fromEntries(Object.keys(facts.cameras).map((name) => [name, name])), (camera) => change({ camera, mode: "recorded" }));
    const others = facts.images.count || facts.scenes.length > 1;
    const compare = { none: "Nothing" };
    if (facts.scenes.length > 1) Object.assign(compare, { "divider-scene": `${facts.scenes[1].name}, divider`, "difference-scene": `${facts.scenes[1].name}, difference` });
    if (facts.images.count) Object.assign(compare, { "divider-recorded": "Recorded image, divider", "difference-recorded": "Recorded image, difference" });
    options($("compare"), compare, (value) => change({ compare: value, ...(value.endsWith("recorded") ? HOME : {}) }));
    $("compare").disabled = !others;
    for (const [name, title] of Object.entries(OVERLAYS)) {
      if (name === "lidar" && !facts.lidar.length) continue;
      const input = make("input", { type: "checkbox", id: `overlay-${name}`, onchange: ({ target }) => change({ [name]: target.checked }) });
      $("overlays").append(make("label", {}, input, make("span", {}, title)));
    }
    const scale = $("depth-scale").querySelector("canvas").getContext("2d");
    facts.depth_colors.forEach(([r, g, b], x) => { scale.fillStyle = `rgb(${r} ${g} ${b})`; scale.fillRect(x, 0, 1, 1); });
    this.timeline();
    this.shift();
    this.path();
    this.objects();
    this.buttons();
    app.listeners.add(() => this.show());
    app.stats = (ms, quality) => { $("stats").textContent = `${app.used().left.drawn.toLocaleString("en")} Gaussians, ${ms.toFixed(0)} ms${quality < 0.99 ? `, ${Math.round(quality * 100)} % size` : ""}`; };
    this.arrival();
    const rest = app.onRest;
    app.onRest = () => { rest?.(); this.seen(); };
    this.show();
  }

  /** The line that says how much of the scene is there. */
  arrival() {
    const { arrival } = this.app, tell = () => {
      $("arrival").hidden = arrival.state() === "whole";
      $("arrival-text").setAttribute("aria-live", arrival.state() === "failed" ? "polite" : "off");
      $("arrival-text").textContent = arrival.text();
      $("arrival-share").hidden = arrival.state() === "failed";
      $("arrival-share").value = arrival.haveBytes / Math.max(1, arrival.bytes);
      $("arrival-again").hidden = arrival.state() !== "failed";
      document.documentElement.dataset.arrival = arrival.state();
    };
    $("arrival-again").onclick = () => arrival.again();
    arrival.listeners.add(tell);
    tell();
  }

  has(layer) {
    const { facts } = this.app, scene = facts.scenes[0];
    if (layer === "class") return scene.classes.length > 1;
    if (layer === "confidence") return scene.certainty;
    return layer !== "recorded" || facts.images.count > 0;
  }

  mode(mode) {
    const { app } = this;
    if (mode === "path" && !app.state.keys.length) this.say("Add a key first.");
    else if (mode === "fly") app.cameras.letGo();
    else if (mode === "orbit") {
      const { view } = app.last, chosen = app.tracks.find((track) => track.id === app.state.selected)?.pose.at(app.state.t);
      app.cameras.orbit(chosen?.position ?? [0, 1, 2].map((k) => view.eye[k] + 12 * view.axes[2][k]));
    } else app.state.mode = mode;
    app.change();
  }

  timeline() {
    const { app } = this, { facts } = app;
    Object.assign($("time"), { min: 0, max: facts.end_s, step: 0.001, oninput: ({ target }) => app.change({ t: Number(target.value), playing: false }) });
    options($("speed"), Object.fromEntries(SPEEDS.map((v) => [v, `${v} x`])), (speed) => app.change({ speed: Number(speed) }));
    $("play").onclick = () => this.play();
    $("back").onclick = () => this.step(-1);
    $("forward").onclick = () => this.step(1);
    $("loop").onchange = ({ target }) => app.change({ loop: target.checked });
  }

  play() {
    const { app } = this, { t, playing } = app.state, [begin, end] = app.span();
    app.change({ playing: !playing, t: !playing && t >= end ? begin : t });
  }

  /** To the next recorded frame of the camera. */
  step(by) {
    const { app } = this, times = app.drive.times[app.state.camera], t = app.state.t;
    const next = by > 0 ? times.find((one) => one > t + 1e-3) : times.findLast((one) => one < t - 1e-3);
    app.change({ t: next ?? (by > 0 ? times[times.length - 1] : times[0]), playing: false });
  }

  shift() {
    const { app } = this, set = () => app.change({ shift: Number($("shift").value), up: Number($("up").value), mode: "recorded" });
    $("shift").oninput = set;
    $("up").oninput = set;
    Object.assign($("fov"), { min: FOV_DEG[0], max: FOV_DEG[1], oninput: ({ target }) => app.change({ fov: Number(target.value) }) });
    $("center").onclick = () => app.change(HOME);
  }

  /** A camera path: keys at moments of the drive, from the views that the page has there. */
  path() {
    const { app } = this, keys = (made) => app.change({ keys: made, ...(!made.length && app.state.mode === "path" ? { mode: "recorded" } : {}) });
    $("key-add").onclick = () => { if (app.last.view) keys(withKey(app.state.keys, app.state.t, app.last.view)); };
    $("key-play").onclick = () => app.change({ mode: "path", t: app.state.keys[0].t, playing: true });
    $("key-save").onclick = () => this.say(savePath(app));
    $("key-clear").onclick = () => keys([]);
    app.listeners.add(({ keys: now }) => {
      for (const [id, least] of [["play", 2], ["save", 1], ["clear", 1]]) $(`key-${id}`).disabled = now.length < least;
      if (this.keysShown === now) return;
      this.keysShown = now;
      $("key-list").replaceChildren(...now.map((key) => make("li", {}, make("button", { type: "button", onclick: () => app.change({ mode: "path", t: key.t, playing: false }) }, `${key.t.toFixed(2)} s`),
        make("button", { type: "button", "aria-label": `Remove the key at ${key.t.toFixed(2)} s`, onclick: () => keys(app.state.keys.filter((one) => one !== key)) }, "\u00d7"))));
    });
  }

  /** Says what the recording saw of this view. */
  seen() {
    const { app } = this, { state } = app, { view } = app.last;
    if (!view) return;
    const found = app.seenShare(view), away = app.cameras.offPath(view.eye), looked = app.cameras.looked(view);
    const share = found === null ? null : away > FAR_M || looked < LOOKED ? Math.min(found.sure, SEEN - 1e-3) : found.sure;
    const where = state.mode === "recorded" && !state.shift && !state.up ? "Recorded path." : `${away.toFixed(1)} m from the nearest recorded camera.`;
    const held = state.mode === "recorded" && !state.shift && !state.up && app.drive.nearestFrame(state.camera, state.t);
    const split = held && Math.abs(held.t - state.t) < 1e-3 ? (held.split === "test" ? " This frame was held out of the fit." : " The fit learned from this frame.") : "";
    const word = share === null ? "" : share >= SEEN ? "Seen by the recording" : share >= PARTLY ? "Partly seen by the recording" : "Mostly not seen by the recording";
    $("seen-word").textContent = word;
    $("seen-word").className = share >= SEEN ? "good" : share >= PARTLY ? "fair" : "poor";
    const known = found === null ? "" : ` The recording determines ${Math.round(100 * found.sure)} % of this view`
      + `${found.empty >= 0.05 ? `; ${Math.round(100 * found.empty)} % is empty` : ""}.${looked < LOOKED ? " No recorded camera looked this way." : ""}`;
    $("seen").textContent = where + split + known;
    $("seen").classList.remove("old");
    $("seen").dataset.share = share === null ? "" : share.toFixed(4);
  }

  objects() {
    const { app } = this, list = $("objects"), nodes = new Set(app.facts.scenes[0].nodes.map((node) => node.name));
    $("object-count").textContent = String(app.tracks.length);
    for (const track of app.tracks) {
      const own = nodes.has(track.id), dot = make("i", { style: `background:${trackColor(track.id)}`, "aria-hidden": "true" });
      const box = make("input", { type: "checkbox", checked: true, disabled: !own, "aria-label": `Show ${track.id}`, "data-id": track.id,
        onchange: ({ target }) => this.hide(track.id, !target.checked) });
      const name = make("button", { type: "button", class: "name", title: own ? "Select and look at it" : "Part of the background: it cannot be hidden",
        onclick: () => this.select(track.id) }, dot, `${track.id} `, make("small", {}, own ? track.label : `${track.label}, parked`));
      const only = make("button", { type: "button", class: "only", disabled: !own, "aria-label": `Show only ${track.id}`, onclick: () => this.isolate(track.id) }, "only");
      list.append(make("li", { "data-name": `${track.id} ${track.label}`.toLowerCase() }, box, name, only));
    }
    $("filter").oninput = ({ target }) => {
      for (const item of list.children) item.hidden = !item.dataset.name.includes(target.value.toLowerCase());
    };
    $("edits").onclick = async () => this.say(await saveEdits(app));
    $("all").onclick = () => { app.state.hidden.clear(); app.change(); };
  }

  hide(id, hidden) {
    const { state } = this.app;
    if (hidden) state.hidden.add(id); else state.hidden.delete(id);
    this.app.change();
  }

  isolate(id) {
    const { app } = this, others = app.facts.scenes[0].nodes.filter((node) => node.keys && node.name !== id).map((node) => node.name);
    app.state.hidden = new Set(others);
    app.change();
  }

  select(id) {
    const { app } = this, { state } = app, track = app.tracks.find((one) => one.id === id);
    if (state.selected === id) { app.change({ selected: null }); return; }
    let pose = track.pose.at(state.t);
    if (!pose) { state.t = clamp(track.pose.times[0], 0, app.facts.end_s); pose = track.pose.nearest(state.t); }
    state.selected = id;
    const place = app.last.view && project(app.last.view, pose.position);
    const inside = place && place[2] > 1 && place[0] > 0 && place[1] > 0 && place[0] < app.last.view.width && place[1] < app.last.view.height;
    if (!inside) {
      app.cameras.orbit(pose.position);
      Object.assign(state, { distance: 6 + 2 * Math.max(...track.size_m), pitch: -0.35 });
    }
    app.change();
  }

  buttons() {
    const { app } = this;
    $("picture").onclick = () => savePicture(app, Number($("times").value));
    $("video").onclick = () => recordVideo(app, (text) => this.say(text));
    $("frames").onclick = () => saveFrames(app, (text) => this.say(text));
    $("link").onclick = async () => this.say(await saveLink(app));
    $("help").onclick = () => $("keys").showModal();
    $("full").hidden = !document.fullscreenEnabled;
    $("full").onclick = () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen());
    this.hint();
    $("open").onclick = () => { const shown = document.body.classList.toggle("with-panel"); $("open").setAttribute("aria-expanded", String(shown)); app.change(); };
    if (matchMedia("(min-width: 800px)").matches) document.body.classList.add("with-panel");
    $("open").setAttribute("aria-expanded", String(document.body.classList.contains("with-panel")));
  }

  /** A line for those who are here for the first time, until they do something. */
  hint() {
    try {
      if (localStorage.getItem("mudg-hint")) return;
      localStorage.setItem("mudg-hint", "shown");
    } catch { /* this browser keeps nothing for a page from the disk: it is shown again */ }
    const touch = matchMedia("(pointer: coarse)").matches, done = new AbortController();
    $("note").textContent = touch ? "Drag to look around, pinch to move." : "Drag to look around, scroll to move, W A S D to fly, ? for all keys.";
    for (const event of ["pointerdown", "keydown", "wheel"]) {
      addEventListener(event, () => { done.abort(); $("note").textContent = ""; }, { signal: done.signal, capture: true, passive: true });
    }
  }

  /** A short message, also for screen readers. */
  say(text) {
    $("note").textContent = text;
    clearTimeout(this.quiet);
    this.quiet = setTimeout(() => { $("note").textContent = ""; }, 4000);
  }

  /** Brings all controls in line with the state. */
  show() {
    const { app } = this, s = app.state;
    $("edits").disabled = !s.hidden.size && !s.edits.length;
    for (const id of ["seen-word", "seen"]) $(id).classList.add("old"); // until the camera rests: it tells of another view
    $("mode").value = s.mode;
    $("camera").value = s.camera;
    $("compare").value = s.compare;
    $("time").value = String(s.t);
    $("clock").textContent = `${s.t.toFixed(2)} s`;
    $("time").setAttribute("aria-valuetext", `${s.t.toFixed(2)} of ${app.facts.end_s.toFixed(2)} seconds`);
    $("speed").value = String(s.speed);
    $("loop").checked = s.loop;
    $("play").setAttribute("aria-label", s.playing ? "Pause" : "Play");
    $("play").dataset.playing = String(s.playing);
    $("shift").value = String(s.shift);
    $("up").value = String(s.up);
    $("shift-text").textContent = s.shift ? `${Math.abs(s.shift).toFixed(1)} m ${s.shift > 0 ? "left" : "right"}` : "recorded path";
    const degrees = Math.round(s.fov || fovOf(app.cameras.view(...app.size())));
    $("fov").value = String(degrees);
    $("fov-text").textContent = `${degrees}\u00b0${s.fov || s.mode !== "recorded" ? "" : ", as recorded"}`;
    $("up-text").textContent = `${s.up > 0 ? "+" : ""}${s.up.toFixed(1)} m`;
    for (const name of Object.keys(OVERLAYS)) if ($(`overlay-${name}`)) $(`overlay-${name}`).checked = s[name];
    for (const input of document.querySelectorAll("input[name=layer]")) input.checked = input.value === s.layer;
    for (const box of $("objects").querySelectorAll("input")) box.checked = !s.hidden.has(box.dataset.id);
    for (const item of $("objects").children) item.classList.toggle("chosen", item.querySelector("input").dataset.id === s.selected);
    $("divider").hidden = !s.compare.startsWith("divider");
    $("depth-scale").hidden = s.layer !== "depth";
    $("class-legend").hidden = s.layer !== "class";
    $("confidence-legend").hidden = s.layer !== "confidence";
    const { area, ratio } = app.last;
    if (!$("divider").hidden && ratio) {
      Object.assign($("divider").style, { left: `${(area[0] + s.divider * area[2]) / ratio}px`, top: `${area[1] / ratio}px`, height: `${area[3] / ratio}px` });
      $("divider").setAttribute("aria-valuenow", String(Math.round(100 * s.divider)));
    }
    const where = s.mode === "recorded" ? `camera ${s.camera}, ${$("shift-text").textContent}` : MODES[s.mode];
    $("canvas").setAttribute("aria-label", `${LAYER_NAMES[s.layer]} of the scene at ${s.t.toFixed(1)} seconds, ${where}`);
  }
}
