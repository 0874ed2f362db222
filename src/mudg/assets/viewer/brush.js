// Takes parts of the street away: a brush that erases balls of the surface under the pointer, and a box outside which nothing is kept.

import { add, project, sub } from "mudg/math";
import { rayOf } from "mudg/gizmo";
import { boxOf, cornersOf, withErased } from "mudg/erase";
import { scaled } from "mudg/app";

const DEPTH_WIDTH_PX = 320; // of the picture that says how far surfaces are
const COVERED = 0.5; // opacity from which on a pixel shows a surface
const APART = 0.5; // of the radius, between the balls of a stroke
const EDGES = [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]];
const NEAREST_M = 0.25;

export class Brush {
  /** @param editor see editor.js. */
  constructor(app, editor) {
    Object.assign(this, { app, editor, on: false, radius: 0.5, stroke: null });
  }

  set(on) {
    this.on = on;
    this.app.stage.style.cursor = on ? "crosshair" : "";
    this.app.change({ playing: false, selected: null });
  }

  /** Begins a stroke; whether the brush is in hand. The surfaces of this moment count until it ends: it does not dig. */
  take(x, y) {
    if (!this.on) return false;
    const { app } = this, loaded = app.used().left, { view } = app.last;
    if (!view || loaded.drawn === null) return false;
    const small = scaled(view, Math.min(1, DEPTH_WIDTH_PX / view.width));
    const sums = app.renderer.read(loaded, small, app.state.t, "depth", app.state.hidden);
    this.stroke = { view, small, sums, balls: [], entries: app.state.edits };
    this.drag(x, y);
    return true;
  }

  drag(x, y) {
    const { balls, entries } = this.stroke, place = this.surfaceAt(x, y), last = balls[balls.length - 1];
    if (!place || last && Math.hypot(...sub(place, last)) < APART * this.radius) return;
    balls.push([...place, this.radius].map((value) => Math.round(value * 1000) / 1000));
    this.editor.show(withErased(entries, { balls: [...balls] }));
  }

  release() {
    const { entries } = this.stroke;
    this.stroke = null;
    this.editor.noted(entries);
  }

  /** The place of the surface that a pixel shows; null where it shows none. */
  surfaceAt(x, y) {
    const { view, small, sums } = this.stroke;
    const column = Math.floor(x / view.width * small.width), row = Math.floor(y / view.height * small.height);
    if (!(column >= 0 && row >= 0 && column < small.width && row < small.height)) return null;
    const at = 4 * (row * small.width + column), opacity = sums[at + 3];
    return opacity < COVERED ? null : add(view.eye, rayOf(view, x, y), sums[at] / opacity);
  }

  /** Draws the box that is kept. */
  draw(c, view, ratio) {
    const box = boxOf(this.app.state.edits);
    if (!box) return;
    const corners = cornersOf(box).map((place) => project(view, place));
    c.strokeStyle = "#ffd54a";
    c.lineWidth = 1.5 * ratio;
    c.beginPath();
    for (const [a, b] of EDGES) {
      if (corners[a][2] < NEAREST_M || corners[b][2] < NEAREST_M) continue;
      c.moveTo(corners[a][0], corners[a][1]);
      c.lineTo(corners[b][0], corners[b][1]);
    }
    c.stroke();
  }
}
