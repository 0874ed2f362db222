// Edits made on the page: a list of entries of an edit script, shown at once by other paths of the nodes; undone, redone, saved. Behind
// `mudg view` the server checks every script with the program's own reader and knows the paths of what the page cannot show itself.

import { Ground, Motion, SHOWN, carriedOut, scriptText, summary, verbOf, withMove } from "mudg/edits";
import { ballsOf, boxOf, withErased } from "mudg/erase";
import { PoseKeys } from "mudg/math";
import { COVERS, LIGHTS, RAINS_MM_H, SNOWS_MM_H, VISIBILITIES_M, conditionsOf, withConditions } from "mudg/weather";

const WAIT_MS = 350;
const MOST_STEPS = 200;
const AHEAD_M = 12; // where an inserted object stands
const ROUND_M = [80, 80, 40]; // of the street round the drive
const BOX_FIELDS = { "box-x": ["center", 0], "box-y": ["center", 1], "box-z": ["center", 2], "box-length": ["size_m", 0], "box-width": ["size_m", 1], "box-height": ["size_m", 2] };
const FIELDS = { "edit-along": "along_m", "edit-left": "left_m", "edit-yaw": "yaw_deg" };
const $ = (id) => document.getElementById(id);

export class Editor {
  constructor(app) {
    this.app = app;
    this.past = [];
    this.future = [];
    this.told = null; // what the server said of the entries
    this.ground = app.ground ? new Ground(app.facts.ground, app.ground) : null;
    for (const { scene } of app.loaded) for (const node of scene.nodes) node.recorded = node.pose;
    for (const track of app.tracks) track.recorded = track.pose;
    this.own = new Set(app.loaded[0].scene.nodes.filter((node) => node.pose).map((node) => node.name));
    this.panel();
    this.show(app.facts.live?.edits ?? []);
  }

  /** Whether an object can be moved: it has Gaussians of its own, or a server that cuts them out of the background. */
  can(id) {
    return this.own.has(id) || Boolean(this.app.facts.live);
  }

  // ---- the list ----

  /** Shows other entries, without a step of undo. */
  show(entries) {
    const { app } = this;
    app.state.edits = entries;
    this.told = null;
    this.apply();
    this.list();
    app.change({ edition: (app.state.edition ?? 0) + 1 });
    this.ask();
  }

  /** Notes a step of undo. @param before entries before it. */
  noted(before) {
    if (before === this.app.state.edits) return;
    this.past = [...this.past.slice(1 - MOST_STEPS), before];
    this.future = [];
    this.list();
  }

  /** Other entries as one step. */
  set(entries) {
    const before = this.app.state.edits;
    this.show(entries);
    this.noted(before);
  }

  undo() { this.step(this.past, this.future); }

  redo() { this.step(this.future, this.past); }

  step(from, to) {
    if (!from.length) return;
    to.push(this.app.state.edits);
    this.show(from.pop());
  }

  move(id, by) { if (this.can(id)) this.set(withMove(this.app.state.edits, id, by)); }

  remove(id) {
    if (!this.can(id)) return;
    this.app.state.selected = null;
    this.set([...this.app.state.edits, { remove: { ids: [id] } }]);
  }

  stop(id) {
    const at = this.app.state.t + this.app.facts.begin_s;
    if (this.can(id)) this.set([...this.app.state.edits, { stop: { id, at_s: Math.round(at * 1000) / 1000 } }]);
  }

  /** Puts another object of this run in the place of one. The server does it: exact frames show it. */
  replace(id, by) {
    const { run } = this.app.facts.live ?? {};
    if (run && by) this.set([...this.app.state.edits, { replace: { id, by: { run, id: by } } }]);
  }

  /** Puts another one of an object where the vehicle is now, ahead of it. */
  insert(id) {
    const { run } = this.app.facts.live ?? {}, at = this.app.state.t + this.app.facts.begin_s;
    if (run) this.set([...this.app.state.edits, { insert: { asset: { run, id }, near: { id: "ego", at_s: Math.round(at * 1000) / 1000, ahead_m: AHEAD_M } } }]);
  }

  /** Another visibility or light: an entry of the script, of which the page shows a preview. */
  conditions(values) {
    const { edits } = this.app.state, made = withConditions(edits, { ...conditionsOf(edits), ...values });
    if (scriptText(made) !== scriptText(edits)) this.set(made);
  }

  /** Keeps only a box of the street: one round the drive to begin with, then with other numbers. */
  crop(values = {}) {
    const { edits } = this.app.state, places = this.app.drive.ego.positions;
    const [low, high] = [Math.min, Math.max].map((of) => [0, 1, 2].map((k) => of(...places.map((place) => place[k]))));
    const round = { center: low.map((v, k) => Math.round((v + high[k]) / 2)), size_m: low.map((v, k) => Math.ceil(high[k] - v) + ROUND_M[k]), yaw_deg: 0 };
    this.set(withErased(edits, { keep: { ...(boxOf(edits) ?? round), ...values } }));
  }

  /** The last entry if it moves this object for good. */
  lastMove(id) {
    const { edits } = this.app.state, [verb, given] = edits.length ? verbOf(edits[edits.length - 1]) : [];
    return verb === "move" && given.id === id && (given.from_s ?? null) === null ? given : null;
  }

  // ---- what the page shows ----

  /** Gives every node and box the path that the entries leave it. */
  apply() {
    const { app } = this, { edits } = app.state;
    const path = (one, name) => {
      const found = carriedOut(edits, name, one.recorded, this.ground, app.facts.begin_s), server = found.unknown && this.told;
      one.removed = found.removed || Boolean(server && server.removed.includes(name));
      const said = server && server.paths[name];
      one.pose = said ? told(said, one.recorded) : found.motion.positions === one.recorded.positions ? one.recorded : found.motion;
    };
    for (const { scene } of app.loaded) for (const node of scene.nodes) if (node.recorded) path(node, node.name);
    for (const track of app.tracks) path(track, track.id);
    app.renderer.conditions = conditionsOf(edits);
    app.renderer.erased = { balls: ballsOf(edits), box: boxOf(edits) };
  }

  /** Has the server check the entries, and takes from it what the page cannot compute. */
  ask() {
    clearTimeout(this.timer);
    const { live } = this.app.facts, { edits } = this.app.state;
    this.problem("");
    $("edit-notes").textContent = live || edits.every((entry) => [...SHOWN, "weather", "light"].includes(verbOf(entry)[0])) ? "" : "Some of these edits show only in mudg view.";
    if (!live) return;
    this.timer = setTimeout(async () => {
      try {
        const said = await this.post({ script: scriptText(edits), save: false });
        if (edits !== this.app.state.edits) return;
        this.told = said;
        $("edit-notes").textContent = said.notes.join(". ");
        this.apply();
        this.app.change({ edition: this.app.state.edition + 1 });
      } catch (error) {
        if (edits === this.app.state.edits) this.problem(error.message);
      }
    }, WAIT_MS);
  }

  async post(body) {
    const answer = await fetch("edits", { method: "POST", headers: { "Content-Type": "application/json", "X-Mudg-Token": this.app.facts.live.token }, body: JSON.stringify(body) });
    if (!answer.ok) throw new Error(await answer.text());
    return answer.json();
  }

  problem(text) {
    this.wrong = Boolean(text);
    $("edit-problem").textContent = text;
    $("edit-problem").hidden = !text;
  }

  /** Has the server write the script; the sentence to show. */
  async saveThere() {
    try {
      return `Saved ${(await this.post({ script: scriptText(this.app.state.edits, this.app.state.hidden), save: true })).saved}`;
    } catch (error) {
      this.problem(error.message);
      return "Not saved: see Edits.";
    }
  }

  // ---- the panel ----

  panel() {
    const { app } = this, id = () => app.state.selected;
    $("undo").onclick = () => this.undo();
    $("redo").onclick = () => this.redo();
    $("edit-remove").onclick = () => this.remove(id());
    $("edit-stop").onclick = () => this.stop(id());
    for (const [field, name] of Object.entries(FIELDS)) {
      $(field).onchange = ({ target }) => {
        const value = Number(target.value), last = this.lastMove(id()), { edits } = app.state;
        if (!Number.isFinite(value)) return;
        const settings = { id: id(), ...last, [name]: value };
        this.set([...(last ? edits.slice(0, -1) : edits), { move: settings }]);
      };
    }
    $("brush").onclick = () => { app.brush.set(!app.brush.on); };
    $("brush-radius").onchange = ({ target }) => { if (Number(target.value) > 0) app.brush.radius = Number(target.value); };
    $("crop").onclick = () => (boxOf(app.state.edits) ? this.set(withErased(app.state.edits, { keep: null })) : this.crop());
    for (const [field, [name, k]] of Object.entries(BOX_FIELDS)) {
      $(field).onchange = ({ target }) => {
        const value = Number(target.value), box = boxOf(app.state.edits);
        if (box && Number.isFinite(value) && (name === "center" || value > 0)) this.crop({ [name]: box[name].map((one, i) => (i === k ? value : one)) });
      };
    }
    $("box-yaw").onchange = ({ target }) => { if (Number.isFinite(Number(target.value))) this.crop({ yaw_deg: Number(target.value) }); };
    const by = $("edit-by");
    by.append(...[...this.own].map((name) => new Option(name, name)));
    $("edit-replace").onclick = () => this.replace(id(), by.value);
    $("edit-insert").onclick = () => this.insert(id());
    for (const [name, [key, values, text]] of Object.entries(SLIDERS)) {
      $(name).max = String(values.length - 1);
      $(name).oninput = ({ target }) => { $(`${name}-text`).textContent = text(values[target.value]); };
      $(name).onchange = ({ target }) => this.conditions({ [key]: values[target.value] });
    }
    $("light").append(...Object.entries(LIGHTS).map(([value, [name]]) => new Option(name, value)));
    $("light").onchange = ({ target }) => this.conditions({ time: target.value });
    app.listeners.add(() => this.fields());
  }

  /** Fields of the selected object. */
  fields() {
    const now = conditionsOf(this.app.state.edits);
    for (const [name, [key, values, text]] of Object.entries(SLIDERS)) {
      const value = now[key], thicker = name === "fog" ? (one) => one >= value : (one) => one <= value;
      $(name).value = String(value ? values.findLastIndex((one) => one === 0 || thicker(one)) : 0);
      $(`${name}-text`).textContent = text(value);
    }
    $("light").value = now.time;
    const box = boxOf(this.app.state.edits), brush = this.app.brush?.on ?? false;
    $("brush").setAttribute("aria-pressed", String(brush));
    $("crop").setAttribute("aria-pressed", String(Boolean(box)));
    $("box").hidden = !box;
    const numbers = box ? { ...Object.fromEntries(Object.entries(BOX_FIELDS).map(([field, [name, k]]) => [field, box[name][k]])), "box-yaw": box.yaw_deg ?? 0 } : {};
    for (const [field, value] of Object.entries(numbers)) if (document.activeElement !== $(field)) $(field).value = String(value);
    const { selected } = this.app.state, shown = selected !== null && this.can(selected);
    $("edit-object").hidden = !shown;
    $("edit-hint").hidden = shown;
    $("edit-hint").textContent = selected !== null && !shown ? "This object is part of the background of the fit: mudg edit can move it." : "Select an object, in the picture or in the list.";
    if (!shown) return;
    $("edit-name").textContent = selected;
    for (const one of $("edit-by").options) one.disabled = one.value === selected;
    if ($("edit-by").selectedOptions[0]?.disabled) $("edit-by").selectedIndex = [...$("edit-by").options].findIndex((one) => !one.disabled);
    $("edit-replace").disabled = this.own.size < 2;
    $("edit-others").hidden = !this.app.facts.live?.run || !this.own.has(selected);
    const last = this.lastMove(selected);
    for (const [field, name] of Object.entries(FIELDS)) if (document.activeElement !== $(field)) $(field).value = String(last?.[name] ?? 0);
  }

  list() {
    const { edits } = this.app.state;
    $("edit-count").textContent = edits.length ? String(edits.length) : "";
    $("undo").disabled = !this.past.length;
    $("redo").disabled = !this.future.length;
    $("edit-list").replaceChildren(...edits.map((entry, k) => {
      const item = document.createElement("li"), text = document.createElement("span"), drop = document.createElement("button");
      text.textContent = summary(entry);
      Object.assign(drop, { type: "button", textContent: "\u00d7", onclick: () => this.set(edits.filter((_, i) => i !== k)) });
      drop.setAttribute("aria-label", `Drop the edit: ${summary(entry)}`);
      item.append(text, drop);
      return item;
    }));
  }
}

/** Sliders of the weather: condition, its values, how one is said. */
const SLIDERS = {
  fog: ["visibility_m", VISIBILITIES_M, (metres) => (metres ? `visibility ${metres} m` : "none")],
  rain: ["rain_mm_h", RAINS_MM_H, (rate) => (rate ? `${rate} mm/h` : "none")],
  snow: ["snow_mm_h", SNOWS_MM_H, (rate) => (rate ? `${rate} mm/h of water` : "none")],
  cover: ["cover", COVERS, (share) => (share ? `${Math.round(100 * share)} % white` : "none")],
};

/** A path as the server says it. */
function told({ rows, source }, recorded) {
  const keys = new PoseKeys(rows.flat());
  return new Motion(keys.times, keys.positions, keys.turns, source, recorded.times);
}
