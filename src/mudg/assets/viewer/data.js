// From the bytes of the page to what is drawn: files, sections of their blobs (viewer/page.py says what they hold), and of the
// Gaussians of a chunk the words of a layer of the data texture. The sorter's worker runs `unpacked`, so that the page does not wait.

import { PoseKeys } from "mudg/math";

const ARRAYS = { f4: Float32Array, u4: Uint32Array, u2: Uint16Array, i2: Int16Array, u1: Uint8Array };
/** Texels of the data texture per row. */
export const TEXTURE_WIDTH = 2048;

/**
 * The bytes of a file of the page: written into it as base64, or beside it on a web server.
 * @param file {name, url, bytes, sha256}: what comes from elsewhere is checked. @param fresh past what the browser has stored.
 */
export async function bytesOf(file, fresh = false) {
  const inside = document.getElementById(file.name);
  if (inside) {
    const text = inside.textContent.trim();
    inside.textContent = ""; // a copy of many megabytes
    return new Uint8Array(await (await fetch("data:application/octet-stream;base64," + text)).arrayBuffer());
  }
  try {
    const answer = await fetch(file.url, { integrity: `sha256-${file.sha256}`, cache: fresh ? "reload" : "default" });
    if (answer.ok) return new Uint8Array(await answer.arrayBuffer());
  } catch (error) {
    if (!(error instanceof TypeError)) throw error;
  }
  throw new Error(`${file.url}: ${await whatIsWrong(file)}`);
}

/** Why a file did not come: a browser does not say which check it failed. */
async function whatIsWrong(file) {
  try {
    const answer = await fetch(file.url, { cache: "reload" });
    if (!answer.ok) return `${answer.status} ${answer.statusText}`;
    const { byteLength } = await answer.arrayBuffer();
    return byteLength === file.bytes ? "its content is not what this page was made with" : `${byteLength} of ${file.bytes} bytes`;
  } catch {
    return "the server does not answer, or stopped in the middle";
  }
}

/** Unpacks gzip with the browser's own code. */
export async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

/** Typed arrays into a blob. directory: name -> [offset, type, number of values]. */
export function sectionsOf(buffer, directory) {
  const found = {};
  for (const [name, [offset, type, count]] of Object.entries(directory)) found[name] = new ARRAYS[type](buffer, offset, count);
  return found;
}

/**
 * What a chunk becomes: words of its layer of the data texture, places and nodes for the sorter. Turned into text for the worker, so it
 * uses nothing from outside. @param texels per Gaussian. @param width of the texture, texels.
 */
export function unpacked({ block, block_of: blockOf, position, scale, rotation, color, class: classes, certainty, harmonics }, n, texels, width) {
  const bits = new Float32Array(1), asInteger = new Uint32Array(bits.buffer);
  const half = (value) => { // as a 16-bit float; beyond 65504 the largest, below 6e-8 zero
    bits[0] = Math.min(65504, Math.max(-65504, value));
    const x = asInteger[0], sign = (x >>> 16) & 0x8000, exponent = ((x >>> 23) & 255) - 112;
    if (exponent <= 0) return exponent < -10 ? sign : sign | (((x & 0x7fffff) | 0x800000) >> (14 - exponent));
    return sign | Math.min(0x7bff, (exponent << 10) + (((x & 0x7fffff) + 0x1000) >> 13));
  };
  const per = 4 * texels, words = new Uint32Array(4 * width * Math.ceil(n * texels / width)), floats = new Float32Array(words.buffer);
  const means = new Float32Array(3 * n), nodeOf = new Uint16Array(n), size = [0, 0, 0];
  for (let b = 0, row = 0; b < blockOf.length / 2; b++) {
    const node = blockOf[2 * b], end = row + blockOf[2 * b + 1], f = 12 * b;
    for (; row < end; row++) {
      const at = row * per;
      for (let axis = 0; axis < 3; axis++) {
        const level = position[axis * n + row] | (position[(axis + 3) * n + row] << 8);
        const place = block[f + axis] + level * block[f + 3 + axis];
        means[3 * row + axis] = place;
        floats[at + axis] = place;
        size[axis] = Math.exp(block[f + 6 + axis] + scale[axis * n + row] * block[f + 9 + axis]);
      }
      nodeOf[row] = node;
      words[at + 3] = node | (classes[row] << 16) | (classes[n + row] << 24);
      words[at + 4] = rotation[row] | (rotation[n + row] << 8) | (rotation[2 * n + row] << 16) | (rotation[3 * n + row] << 24);
      words[at + 5] = half(size[0]) | (half(size[1]) << 16);
      words[at + 6] = half(size[2]) | (color[3 * n + row] << 16);
      const green = color[n + row], red = (color[row] + green) & 255, blue = (color[2 * n + row] + green) & 255;
      words[at + 7] = red | (green << 8) | (blue << 16) | ((certainty ? certainty[row] : 255) << 24);
      for (let k = 0; harmonics && k * n < harmonics.length; k++) words[at + 8 + (k >> 2)] |= harmonics[k * n + row] << (8 * (k & 3));
    }
  }
  return { words, means, nodeOf };
}

/** A scene as the page keeps it, without its Gaussians: sky, nodes with their poses, how large its texture is. */
export class SplatScene {
  /**
   * @param facts the scene's entry in the page's facts. @param sections see `sectionsOf`. @param grounds ids of the classes of ground.
   */
  constructor(facts, sections, grounds) {
    this.facts = facts;
    this.rows = facts.rows;
    this.chunkRows = Math.max(1, Math.min(facts.chunk_rows, facts.rows));
    this.sky = sections.sky ? { values: sections.sky, rows: facts.sky_rows } : null;
    this.hasCertainty = facts.certainty;
    this.texels = 2 + Math.ceil([0, 3, 6, 12][facts.degree] / 4); // 9, 24 and 45 bytes of harmonics
    this.layerHeight = Math.ceil(this.chunkRows * this.texels / TEXTURE_WIDTH);
    this.ground = facts.classes.reduce((bits, id, k) => (k < 32 && grounds.includes(id) ? bits | (1 << k) : bits), 0) >>> 0;
    this.nodes = facts.nodes.map((node) => ({ ...node, pose: node.keys
      ? new PoseKeys(sections.keys.subarray(8 * node.keys[0], 8 * (node.keys[0] + node.keys[1]))) : null }));
    this.deform = sections.deform;
  }

  /** Where every node is at a time: rows for the node texture (6 texels of 4 numbers per node), and the displacements of grids. */
  placed(t, hidden) {
    const rows = new Float32Array(24 * this.nodes.length);
    const grids = [];
    let base = 0;
    this.nodes.forEach((node, i) => {
      const at = 24 * i;
      const pose = node.pose ? node.pose.at(t) : { position: [0, 0, 0], rotation: [1, 0, 0, 0, 1, 0, 0, 0, 1] };
      const shown = pose !== null && !node.removed && !hidden.has(node.name);
      rows[at + 13] = -1;
      if (!shown) return;
      const r = pose.rotation;
      for (let k = 0; k < 3; k++) rows.set([r[3 * k], r[3 * k + 1], r[3 * k + 2], pose.position[k]], at + 4 * k);
      rows[at + 12] = 1;
      if (!node.grid) return;
      const [, [, , nz, ny, nx]] = node.grid, cells = nz * ny * nx, [before, after, u] = pose.around;
      const grid = new Float32Array(4 * cells);
      for (let axis = 0; axis < 3; axis++) {
        const p = node.grid[0] + (3 * before + axis) * cells, q = node.grid[0] + (3 * after + axis) * cells;
        for (let c = 0; c < cells; c++) grid[4 * c + axis] = this.facts.deform_step * (this.deform[p + c] + u * (this.deform[q + c] - this.deform[p + c]));
      }
      rows[at + 13] = base;
      rows.set([...node.size_m, 0], at + 16);
      rows.set([nx, ny, nz, 0], at + 20);
      base += cells;
      grids.push(grid);
    });
    const deform = new Float32Array(4 * Math.max(1, base));
    let at = 0;
    for (const grid of grids) { deform.set(grid, at); at += grid.length; }
    return { rows, deform };
  }
}
