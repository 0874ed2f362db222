// Draws scenes of Gaussians with WebGL2. Every scene is blended far to near into a float target, resolved to a picture of 8 bits, and
// one or two pictures go to the screen. `Renderer.read` gives the sums themselves, for measurements.

import { TEXTURE_WIDTH } from "mudg/data";
import * as shaders from "mudg/shaders";
import { headingOf } from "mudg/erase";
import { Sorter } from "mudg/sorter";
import { streaks } from "mudg/particles";
import { conditionsOf, fallingOf, preview } from "mudg/weather";

/** Camera z below which nothing is drawn, metres; as everywhere in the program. */
export const NEAR_M = 0.2;
const SKY_LOGIT = 10;
const layerNumber = (layer) => shaders.LAYERS.indexOf(layer);

/** A scene on the graphics card, with its sorter. */
class Loaded {
  constructor(gl, scene, programs) {
    this.scene = scene;
    this.programs = programs;
    this.sorter = new Sorter(scene);
    this.present = 0; // Gaussians that have come
    this.drawn = null; // Gaussians of the last order; before the first one unknown
    this.buffer = gl.createBuffer();
  }
}

export class Renderer {
  /** @param facts of the page: palette, depth colours and limits. */
  constructor(canvas, facts) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL2.");
    this.gl = gl;
    this.canvas = canvas;
    this.facts = facts;
    const floats = gl.getExtension("EXT_color_buffer_float");
    if (!floats && !gl.getExtension("EXT_color_buffer_half_float")) throw new Error("This graphics card cannot draw into float targets.");
    // 32 bits keep depth exact; where they cannot be blended, 16 are enough to look at
    this.precise = Boolean(floats && gl.getExtension("EXT_float_blend"));
    this.sumFormat = this.precise ? gl.RGBA32F : gl.RGBA16F;
    this.targets = new Map();
    this.resolve = this.program(shaders.screenVertex, shaders.resolveFragment);
    this.show = this.program(shaders.screenVertex, shaders.showFragment);
    this.scales = this.texture(gl.RGBA8, 256, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(facts.depth_colors.flatMap((c) => [...c, 255])), gl.LINEAR);
    this.blank = this.texture(gl.RGBA8, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    this.nodes = gl.createTexture();
    this.grids = gl.createTexture();
    this.balls = gl.createTexture();
    this.empty = gl.createVertexArray();
    this.photos = new Map(); // place -> {key, texture}
    this.conditions = conditionsOf([]);
    this.erased = { balls: [], box: null };
    this.velocity = () => [0, 0, 0]; // of the vehicle at a time, m/s; it tilts the streaks of drops
    this.drops = this.program(shaders.dropVertex, shaders.dropFragment);
    this.dropRows = gl.createBuffer();
    this.dropArray = gl.createVertexArray();
    gl.bindVertexArray(this.dropArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.dropRows);
    for (const [name, count, offset] of [["ends", 4, 0], ["about", 3, 16]]) {
      const at = gl.getAttribLocation(this.drops.program, name);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, count, gl.FLOAT, false, 28, offset);
      gl.vertexAttribDivisor(at, 1);
    }
    gl.bindVertexArray(null);
  }

  // ---- resources ----

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "row");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const places = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const name = gl.getActiveUniform(program, i).name.replace("[0]", "");
      places[name] = gl.getUniformLocation(program, name);
    }
    return { program, places };
  }

  texture(format, width, height, order, type, values, filter = this.gl.NEAREST) {
    const gl = this.gl, made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, order, type, values);
    this.filtered(filter);
    return made;
  }

  filtered(filter, wrap = this.gl.CLAMP_TO_EDGE) {
    const gl = this.gl;
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, wrap);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  }

  /** A named target with textures of one size; made again when size or format change. */
  target(name, width, height, format, count = 1) {
    const gl = this.gl, known = this.targets.get(name);
    if (known && known.width === width && known.height === height && known.format === format) return known;
    known?.textures.forEach((one) => gl.deleteTexture(one));
    if (known) gl.deleteFramebuffer(known.frame);
    const eight = format === gl.RGBA8, frame = gl.createFramebuffer();
    const textures = Array.from({ length: count }, () => this.texture(format, width, height, gl.RGBA,
      eight ? gl.UNSIGNED_BYTE : format === gl.RGBA32F ? gl.FLOAT : gl.HALF_FLOAT, null, eight ? gl.LINEAR : gl.NEAREST));
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    textures.forEach((one, i) => gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, one, 0));
    gl.drawBuffers(textures.map((_, i) => gl.COLOR_ATTACHMENT0 + i));
    const made = { width, height, format, frame, textures };
    this.targets.set(name, made);
    return made;
  }

  bind(unit, texture, kind = this.gl.TEXTURE_2D) {
    this.gl.activeTexture(this.gl.TEXTURE0 + unit);
    this.gl.bindTexture(kind, texture);
  }

  /** Puts numbers, four per texel in rows of `TEXTURE_WIDTH`, into a texture of a unit. */
  table(unit, texture, values) {
    const gl = this.gl, rows = Math.max(1, Math.ceil(values.length / 4 / TEXTURE_WIDTH)), all = new Float32Array(4 * rows * TEXTURE_WIDTH);
    all.set(values);
    this.bind(unit, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, TEXTURE_WIDTH, rows, 0, gl.RGBA, gl.FLOAT, all);
    this.filtered(gl.NEAREST);
  }

  /** Makes room for a scene on the card; its Gaussians come with `add`. */
  load(scene) {
    const gl = this.gl, { degree, classes } = scene.facts;
    const vertex = shaders.splatVertex(degree, scene.texels, TEXTURE_WIDTH, scene.chunkRows);
    const loaded = new Loaded(gl, scene, {
      sums: this.program(vertex, shaders.splatFragment),
      votes: classes.length > 1 ? this.program(vertex, shaders.voteFragment) : null,
      classes: classes.length > 1 ? this.program(shaders.screenVertex, shaders.classFragment(classes.length)) : null,
    });
    const layers = Math.max(1, scene.facts.chunks.length);
    loaded.data = gl.createTexture(); // a layer per chunk: no graphics card has a texture of three million Gaussians in one piece
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, loaded.data);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA32UI, TEXTURE_WIDTH, Math.max(1, scene.layerHeight), layers);
    if (gl.getError() !== gl.NO_ERROR) throw new Error(`The graphics card has no memory for ${scene.rows.toLocaleString("en")} Gaussians (${Math.round(layers * scene.layerHeight * TEXTURE_WIDTH * 16 / 1e6)} MB). mudg page --budget makes a smaller page.`);
    gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    if (scene.sky) {
      const rows = scene.sky.rows;
      gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
      loaded.sky = this.texture(gl.RGB8, 2 * rows, rows, gl.RGB, gl.UNSIGNED_BYTE, scene.sky.values);
      this.filtered(gl.LINEAR, gl.REPEAT);
    }
    loaded.array = gl.createVertexArray();
    gl.bindVertexArray(loaded.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, loaded.buffer);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    gl.bindVertexArray(null);
    return loaded;
  }

  /** Puts a chunk on the card. @param words see `unpacked`. @param rows Gaussians in it. */
  add(loaded, layer, words, rows) {
    const gl = this.gl;
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, loaded.data);
    gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, layer, TEXTURE_WIDTH, words.length / 4 / TEXTURE_WIDTH, 1, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
    loaded.present += rows;
  }

  // ---- order ----

  /** What the sorter needs to know of a moment. */
  request(loaded, view, t, hidden) {
    return { poses: loaded.scene.placed(t, hidden).rows, eye: view.eye, ahead: view.axes[2], near: NEAR_M };
  }

  /** Asks the scene's sorter for the order of a moment; `done` is called when it is there. A late one is better than none. */
  sort(loaded, view, t, hidden, done) {
    loaded.sorter.ask(this.request(loaded, view, t, hidden), (order) => {
      if (order) this.use(loaded, order);
      done(order !== null);
    });
  }

  use(loaded, order) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, loaded.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    loaded.drawn = order.length;
  }

  // ---- pictures ----

  /** The uniforms of a camera. */
  camera(places, view, forward = true) {
    const gl = this.gl, [right, down, ahead] = view.axes;
    const columns = forward ? [0, 1, 2].flatMap((k) => [right[k], down[k], ahead[k]]) : [...right, ...down, ...ahead];
    gl.uniformMatrix3fv(forward ? places.cameraFromWorld : places.worldFromCamera, false, columns);
    gl.uniform4f(places.intrinsics, view.fx, view.fy, view.cx, view.cy);
    gl.uniform2f(places.size, view.width, view.height);
  }

  /** Blends all Gaussians with a program into a target. */
  blend(loaded, { program, places }, target, view, placed, layer, set = () => {}) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.viewport(0, 0, target.width, target.height);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(program);
    this.bind(0, loaded.data, gl.TEXTURE_2D_ARRAY);
    this.bind(1, this.nodes);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 6, placed.rows.length / 24, 0, gl.RGBA, gl.FLOAT, placed.rows);
    this.filtered(gl.NEAREST);
    const { balls, box } = this.erased;
    this.table(2, this.grids, placed.deform);
    this.table(3, this.balls, balls.flat());
    gl.uniform1i(places.data, 0);
    gl.uniform1i(places.nodes, 1);
    gl.uniform1i(places.grids, 2);
    gl.uniform1i(places.balls, 3);
    this.camera(places, view);
    gl.uniform3fv(places.eye, view.eye);
    gl.uniform2f(places.colorRange, loaded.scene.facts.color_low, loaded.scene.facts.color_high);
    gl.uniform1f(places.harmonicStep, loaded.scene.facts.harmonic_step ?? 0);
    const { fog, veil, snow } = preview(this.conditions, loaded.scene.sky);
    gl.uniform4fv(places.fog, fog);
    gl.uniform4fv(places.veil, veil);
    gl.uniform4fv(places.snow, snow);
    gl.uniform1i(places.ballCount, balls.length);
    gl.uniform4f(places.boxPlace, ...(box?.center ?? [0, 0, 0]), box ? 1 : 0);
    gl.uniform3f(places.boxHalf, ...(box?.size_m ?? [0, 0, 0]).map((size) => size / 2));
    gl.uniform2f(places.boxHeading, ...headingOf(box ?? {}));
    gl.uniform1ui(places.ground, loaded.scene.ground);
    gl.uniform1f(places.nearest, NEAR_M);
    gl.uniform1i(places.layer, layer);
    gl.uniform1i(places.antialias, loaded.scene.facts.antialias ? 1 : 0);
    set(places);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(loaded.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, loaded.drawn);
    gl.disable(gl.BLEND);
  }

  /** Fills a target with a program of one triangle. */
  fill(target, { program, places }, set) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target ? target.frame : null);
    if (target) gl.viewport(0, 0, target.width, target.height);
    gl.useProgram(program);
    gl.bindVertexArray(this.empty);
    set(places);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /**
   * Draws one layer of a scene at a view as a picture of the view's size.
   * @param name of the picture's target. @param view see cameras.js. @param plain class numbers instead of class colours.
   */
  picture(name, loaded, view, t, layer, hidden, plain = false) {
    const gl = this.gl, placed = loaded.scene.placed(t, hidden);
    const picture = this.target(name, view.width, view.height, gl.RGBA8);
    if (layer === "class" && loaded.programs.votes) return this.classes(loaded, view, placed, picture, plain);
    const number = layerNumber(layer), sums = this.target("sums", view.width, view.height, this.sumFormat);
    this.blend(loaded, loaded.programs.sums, sums, view, placed, number);
    this.fill(picture, this.resolve, (places) => {
      this.bind(0, sums.textures[0]);
      this.bind(1, loaded.sky ?? this.blank);
      this.bind(2, this.scales);
      gl.uniform1i(places.sums, 0);
      gl.uniform1i(places.sky, 1);
      gl.uniform1i(places.scales, 2);
      gl.uniform1i(places.layer, number);
      gl.uniform1i(places.hasSky, loaded.sky ? 1 : 0);
      gl.uniform1i(places.ground, view.ground ? 1 : 0);
      this.camera(places, view, false);
      gl.uniform2f(places.depthRange, ...this.facts.depth_range_m);
      gl.uniform3fv(places.gain, view.gain);
      gl.uniform3fv(places.offset, view.offset);
      const { fog, light, veil } = preview(this.conditions, loaded.scene.sky);
      gl.uniform4fv(places.fog, fog);
      gl.uniform4fv(places.veil, veil);
      gl.uniform4fv(places.light, light);
    });
    if (layer === "color") this.rain(loaded, view, t, placed, picture);
    return picture;
  }

  /** Draws the drops and flakes that are nearer than the surfaces, one by one. */
  rain(loaded, view, t, placed, picture) {
    const gl = this.gl, kinds = fallingOf(this.conditions, this.facts.particle_keys), air = preview(this.conditions, loaded.scene.sky);
    if (!kinds.length) return;
    const rows = new Float32Array(kinds.flatMap((kind) => streaks(kind, view, t + this.facts.begin_s, this.velocity(t))));
    const depths = this.target("depths", view.width, view.height, this.sumFormat), { program, places } = this.drops;
    this.blend(loaded, loaded.programs.sums, depths, view, placed, layerNumber("depth"));
    gl.bindFramebuffer(gl.FRAMEBUFFER, picture.frame);
    gl.viewport(0, 0, view.width, view.height);
    gl.useProgram(program);
    this.bind(0, depths.textures[0]);
    gl.uniform1i(places.depths, 0);
    gl.uniform2f(places.size, view.width, view.height);
    gl.uniform3fv(places.color, air.fog.slice(0, 3).map((v, k) => v * air.light[k]));
    gl.bindVertexArray(this.dropArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.dropRows);
    gl.bufferData(gl.ARRAY_BUFFER, rows, gl.DYNAMIC_DRAW);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, rows.length / 7);
    gl.disable(gl.BLEND);
  }

  classes(loaded, view, placed, picture, plain) {
    const gl = this.gl, channels = loaded.scene.facts.classes, passes = Math.ceil(channels.length / shaders.CLASSES_PER_PASS), votes = [];
    for (let k = 0; k < passes; k++) {
      const target = this.target(`votes${k}`, view.width, view.height, gl.RGBA16F, 4);
      this.blend(loaded, loaded.programs.votes, target, view, placed, 2, (places) => gl.uniform1i(places.firstClass, k * shaders.CLASSES_PER_PASS));
      votes.push(...target.textures);
    }
    const sky = channels.indexOf(this.facts.class_names.indexOf("sky"));
    this.fill(picture, loaded.programs.classes, (places) => {
      for (let k = 0; k < Math.ceil(channels.length / 3); k++) {
        this.bind(k, votes[k]);
        gl.uniform1i(places[`votes${k}`], k);
      }
      gl.uniform3fv(places.palette, channels.flatMap((id) => this.facts.class_colors[id].map((v) => v / 255)));
      gl.uniform1fv(places.ids, channels);
      gl.uniform1i(places.skyChannel, sky);
      gl.uniform1f(places.skyVotes, SKY_LOGIT / loaded.scene.facts.lead_step);
      gl.uniform1i(places.colors, plain ? 0 : 1);
      gl.uniform1i(places.hasSky, loaded.sky ? 1 : 0);
    });
    return picture;
  }

  /** A photograph, or an exact frame, as a picture; kept until another one comes to its place. */
  photograph(place, key, image) {
    if (this.photos.get(place)?.key !== key) {
      const gl = this.gl;
      if (this.photos.has(place)) gl.deleteTexture(this.photos.get(place).texture);
      const made = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, made);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
      this.filtered(gl.LINEAR);
      this.photos.set(place, { key, texture: made });
    }
    return { textures: [this.photos.get(place).texture], image: true };
  }

  /**
   * Shows one picture, or two.
   * @param area where, in pixels of the canvas from its lower left corner: [x, y, width, height].
   * @param mode "one", "divider" or "difference". @param divider share of the width that the left picture gets.
   */
  present(left, right, area, mode = "one", divider = 0.5) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0.05, 0.06, 0.075, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.viewport(...area);
    this.fill(null, this.show, (places) => {
      this.bind(0, left.textures[0]);
      this.bind(1, (right ?? left).textures[0]);
      gl.uniform1i(places.left, 0);
      gl.uniform1i(places.right, 1);
      gl.uniform1i(places.mode, right ? ["one", "divider", "difference"].indexOf(mode) : 0);
      gl.uniform1f(places.divider, divider);
      gl.uniform4f(places.area, ...area);
      gl.uniform2i(places.upright, left.image ? 1 : 0, right?.image ? 1 : 0);
    });
  }

  // ---- measurements ----

  /** The sums of a layer at a view, rows from the top: Float32Array [height, width, 4], the last number is the opacity. */
  read(loaded, view, t, layer, hidden) {
    const gl = this.gl, { width, height } = view, sums = this.target("sums", width, height, this.sumFormat);
    this.blend(loaded, loaded.programs.sums, sums, view, loaded.scene.placed(t, hidden), layerNumber(layer));
    const found = new Float32Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, found);
    return upsideDown(found, width, height);
  }

  /** A picture's bytes, rows from the top: Uint8Array [height, width, 4]. */
  bytes(picture) {
    const gl = this.gl, { width, height } = picture, found = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, picture.frame);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, found);
    return upsideDown(found, width, height);
  }
}

function upsideDown(values, width, height) {
  const turned = new values.constructor(values.length);
  for (let y = 0; y < height; y++) turned.set(values.subarray(4 * width * y, 4 * width * (y + 1)), 4 * width * (height - 1 - y));
  return turned;
}
