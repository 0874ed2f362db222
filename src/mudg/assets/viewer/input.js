// Mouse, touch and keyboard on the picture.

import { HOME } from "mudg/cameras";
import { clamp } from "mudg/math";
import { objectAt } from "mudg/gizmo";
import { LAYERS } from "mudg/shaders";

const SPEED_M_S = 6;
const FLY = { KeyW: [0, 1, 0], KeyS: [0, -1, 0], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyE: [0, 0, 1], KeyQ: [0, 0, -1] };

export function listen(app, controls) {
  pointers(app);
  keyboard(app, controls);
  divider(app);
}

function pointers(app) {
  const { stage } = app, fingers = new Map();
  let spread = 0, moved = 0, holder = null, tool = null; // the pointer that a tool holds
  stage.addEventListener("pointerdown", (event) => {
    if (event.target.id === "divider") return;
    stage.setPointerCapture(event.pointerId);
    tool = fingers.size ? null : [app.brush, app.gizmo].find((one) => one.take(...placeOf(app, event)));
    if (tool) { holder = event.pointerId; return; }
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    moved = 0;
  });
  stage.addEventListener("pointermove", (event) => {
    if (event.pointerId === holder) { tool.drag(...placeOf(app, event)); return; }
    const before = fingers.get(event.pointerId);
    if (!before) { hover(app, event); return; }
    const dx = event.clientX - before[0], dy = event.clientY - before[1];
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    moved += Math.abs(dx) + Math.abs(dy);
    if (moved < 4) return;
    if (fingers.size === 2) {
      const [a, b] = [...fingers.values()], now = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (spread) app.cameras.zoom(spread / now);
      spread = now;
    } else app.cameras.drag(dx, dy, stage.clientHeight);
    app.change();
  });
  const up = (event) => {
    if (event.pointerId === holder) { holder = null; tool.release(); return; }
    if (fingers.delete(event.pointerId) && moved < 4 && event.type === "pointerup") click(app, event);
    spread = 0;
  };
  stage.addEventListener("pointerup", up);
  stage.addEventListener("pointercancel", up);
  stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    app.cameras.zoom(Math.exp(clamp(event.deltaY, -100, 100) * 0.0015));
    app.change();
  }, { passive: false });
}

/** Place of a pointer on the picture, in its pixels. */
function placeOf(app, event) {
  const box = app.stage.getBoundingClientRect(), [x0, y0] = app.last.area, ratio = app.last.ratio ?? 1;
  return [(event.clientX - box.left) * ratio - x0, (event.clientY - box.top) * ratio - y0];
}

/** The recorded camera under a pointer, if cameras are shown. */
function frameUnder(app, event) {
  return app.state.cameras ? app.overlayDrawer.frameAt(...placeOf(app, event)) : null;
}

/** A pointer over a recorded camera shows its image. */
function hover(app, event) {
  const thumb = document.getElementById("thumb"), frame = frameUnder(app, event), url = frame && app.imageUrl(frame);
  thumb.hidden = !url;
  if (!url) return;
  const box = app.stage.getBoundingClientRect();
  if (thumb.src !== url) thumb.src = url;
  Object.assign(thumb.style, { left: `${clamp(event.clientX - box.left, 92, box.width - 92)}px`, top: `${Math.max(140, event.clientY - box.top)}px` });
}

/** A click on a recorded camera jumps there; on an object, selects it. */
function click(app, event) {
  const frame = frameUnder(app, event), { view } = app.last;
  if (!frame) app.change({ selected: view ? objectAt(view, ...placeOf(app, event), app.tracks, app.state.t) : null });
  else {
    document.getElementById("thumb").hidden = true;
    app.change({ ...HOME, camera: frame.camera, t: frame.t });
  }
}

const NUDGES = { ArrowUp: { along_m: 0.1 }, ArrowDown: { along_m: -0.1 }, ArrowLeft: { left_m: 0.1 }, ArrowRight: { left_m: -0.1 }, "<": { yaw_deg: 1 }, ">": { yaw_deg: -1 } };

/** Keys of the editor; whether the key was one. */
function edited(app, event) {
  if (/^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) && event.target.type !== "range" || document.querySelector("dialog[open]")) return false;
  const { editor, state } = app, id = state.selected, letter = event.key.toLowerCase();
  if ((event.ctrlKey || event.metaKey) && !event.altKey && (letter === "z" || letter === "y")) {
    if (letter === "y" || event.shiftKey) editor.redo(); else editor.undo();
    return true;
  }
  if (event.ctrlKey || event.metaKey || event.altKey) return false;
  if (letter === "x" || (event.key === "Escape" && app.brush.on)) { app.brush.set(letter === "x" && !app.brush.on); return true; }
  if (id === null) return false;
  if (event.shiftKey && NUDGES[event.key]) editor.move(id, NUDGES[event.key]);
  else if (event.key === "Delete" || event.key === "Backspace") editor.remove(id);
  else if (event.key === "Escape") app.change({ selected: null });
  else return false;
  return true;
}

function keyboard(app, controls) {
  const held = new Set();
  addEventListener("keydown", (event) => {
    if (edited(app, event)) { event.preventDefault(); return; }
    if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) && event.target.type !== "range") return;
    if (document.querySelector("dialog[open]")) return;
    const s = app.state, number = Number(event.key);
    if (FLY[event.code]) held.add(event.code);
    else if (event.code === "ShiftLeft" || event.code === "ShiftRight") held.add("fast");
    else if (event.key === " " && event.target.tagName !== "BUTTON") controls.play();
    else if (event.key === ",") controls.step(-1);
    else if (event.key === ".") controls.step(1);
    else if (event.key === "ArrowLeft" && event.target.type !== "range") controls.step(-1);
    else if (event.key === "ArrowRight" && event.target.type !== "range") controls.step(1);
    else if (number >= 1 && number <= LAYERS.length && controls.has(LAYERS[number - 1])) app.change({ layer: LAYERS[number - 1] });
    else if (event.key === "r") app.change(HOME);
    else if (event.key === "c") app.change({ mode: "chase" });
    else if (event.key === "t") app.change({ mode: "top" });
    else if (event.key === "f") controls.mode("fly");
    else if (event.key === "o") controls.mode("orbit");
    else if (event.key === "k") document.getElementById("key-add").click();
    else if (event.key === "b") app.change({ boxes: !s.boxes });
    else if (event.key === "l") app.change({ lidar: !s.lidar });
    else if (event.key === "[") app.change({ mode: "recorded", shift: clamp(s.shift + 0.5, -4, 4) });
    else if (event.key === "]") app.change({ mode: "recorded", shift: clamp(s.shift - 0.5, -4, 4) });
    else if (event.key === "?") document.getElementById("help").click();
    else return;
    event.preventDefault();
  });
  addEventListener("keyup", (event) => { held.delete(event.code); if (event.key === "Shift") held.delete("fast"); });
  addEventListener("blur", () => held.clear());
  app.move = (seconds) => {
    let way = null;
    for (const key of held) if (FLY[key]) way = (way ?? [0, 0, 0]).map((v, k) => v + FLY[key][k]);
    if (!way) return;
    const metres = seconds * SPEED_M_S * (held.has("fast") ? 5 : 1);
    app.cameras.move(...way.map((v) => v * metres));
    app.change();
  };
}

function divider(app) {
  const handle = document.getElementById("divider");
  const to = (x) => { const { area, ratio } = app.last, box = app.stage.getBoundingClientRect();
    app.change({ divider: clamp(((x - box.left) * ratio - area[0]) / area[2], 0, 1) }); };
  handle.addEventListener("pointerdown", (event) => handle.setPointerCapture(event.pointerId));
  handle.addEventListener("pointermove", (event) => { if (handle.hasPointerCapture(event.pointerId)) to(event.clientX); });
  handle.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
    if (!by) return;
    event.stopPropagation();
    event.preventDefault();
    app.change({ divider: clamp(app.state.divider + by, 0, 1) });
  });
}
