// Unpacks the chunks of a scene and sorts all Gaussians that are there, static and moving together, far to near, in a worker: the page
// never waits for it.

import { TEXTURE_WIDTH, unpacked } from "mudg/data";

/** The worker's program. It is turned into text, so it uses nothing from outside but `unpacked`, which is put before it. */
function program() {
  const chunks = []; // {first, means, nodeOf}
  let keys, rows, keysThen, rowsThen;
  const histogram = new Uint32Array(65536);
  const bits = new Float32Array(1), asInteger = new Uint32Array(bits.buffer);

  /** One pass of a radix sort by 16 bits, largest first. */
  function pass(n, shift, fromKeys, fromRows, toKeys, toRows) {
    histogram.fill(0);
    for (let i = 0; i < n; i++) histogram[(fromKeys[i] >>> shift) & 65535]++;
    for (let k = 65535, sum = 0; k >= 0; k--) { const here = histogram[k]; histogram[k] = sum; sum += here; }
    for (let i = 0; i < n; i++) {
      const to = histogram[(fromKeys[i] >>> shift) & 65535]++;
      toKeys[to] = fromKeys[i];
      toRows[to] = fromRows[i];
    }
  }

  onmessage = ({ data }) => {
    const began = performance.now();
    if (data.capacity !== undefined) {
      [keys, rows, keysThen, rowsThen] = Array.from({ length: 4 }, () => new Uint32Array(data.capacity));
      return;
    }
    if (data.chunk) {
      const { first, count, sections, texels, width, id } = data.chunk, { words, means, nodeOf } = unpacked(sections, count, texels, width);
      chunks.push({ first, means, nodeOf });
      postMessage({ id, words, ms: performance.now() - began }, [words.buffer]);
      return;
    }
    const { poses, eye, ahead, near, id } = data;
    // depth = ahead . (R m + p - eye): one row of four numbers per node
    const nodes = poses.length / 24, plane = new Float64Array(4 * nodes), shown = new Uint8Array(nodes);
    for (let k = 0; k < nodes; k++) {
      const at = 24 * k;
      shown[k] = poses[at + 12];
      for (let c = 0; c < 4; c++) plane[4 * k + c] = ahead[0] * poses[at + c] + ahead[1] * poses[at + 4 + c] + ahead[2] * poses[at + 8 + c];
      plane[4 * k + 3] -= ahead[0] * eye[0] + ahead[1] * eye[1] + ahead[2] * eye[2];
    }
    let n = 0;
    for (const { first, means, nodeOf } of chunks) {
      for (let i = 0, count = nodeOf.length; i < count; i++) {
        const k = nodeOf[i];
        if (!shown[k]) continue;
        const depth = plane[4 * k] * means[3 * i] + plane[4 * k + 1] * means[3 * i + 1] + plane[4 * k + 2] * means[3 * i + 2] + plane[4 * k + 3];
        if (depth < near - 0.5) continue; // what a grid displaces may still come before the camera
        bits[0] = depth > 0 ? depth : 0;
        keys[n] = asInteger[0]; // positive floats are ordered like their bits
        rows[n++] = first + i;
      }
    }
    pass(n, 0, keys, rows, keysThen, rowsThen);
    pass(n, 16, keysThen, rowsThen, keys, rows);
    const order = rows.slice(0, n);
    postMessage({ id, order, ms: performance.now() - began }, [order.buffer]);
  };
}

/** Sorts one scene; a request that comes while another is under way waits, and only the latest one is kept. */
export class Sorter {
  constructor(scene) {
    const text = URL.createObjectURL(new Blob([`const unpacked = ${unpacked};\n(${program})()`], { type: "text/javascript" }));
    this.worker = new Worker(text);
    URL.revokeObjectURL(text);
    this.worker.postMessage({ capacity: scene.rows });
    this.busy = false;
    this.waiting = null;
    this.id = 0;
    this.ms = 0;
    this.unpacking = new Map(); // id -> {resolve, reject}
    this.unpackMs = 0;
    this.worker.onmessage = ({ data }) => {
      if (data.words) {
        this.unpackMs = data.ms;
        this.unpacking.get(data.id).resolve(data.words);
        this.unpacking.delete(data.id);
        return;
      }
      this.ms = data.ms;
      this.busy = false;
      const done = this.done;
      this.begin();
      done(data.order);
    };
    this.worker.onerror = (event) => { // out of memory, say: what was asked for never comes
      for (const { reject } of this.unpacking.values()) reject(new Error(event.message));
      this.unpacking.clear();
    };
  }

  /** Adds a chunk to what is sorted; its words for the data texture, as a promise. @param first row of the chunk. */
  unpack(first, count, buffer, sections, texels) {
    const id = ++this.id;
    return new Promise((resolve, reject) => {
      this.unpacking.set(id, { resolve, reject });
      this.worker.postMessage({ chunk: { first, count, sections, texels, width: TEXTURE_WIDTH, id } }, [buffer]);
    });
  }

  begin() {
    if (!this.waiting) return;
    const { request, done } = this.waiting;
    this.waiting = null;
    this.busy = true;
    this.done = done;
    this.worker.postMessage({ ...request, id: ++this.id });
  }

  /** Asks for an order; `done` gets the rows, far to near. A request that was replaced by a later one is answered with null. */
  ask(request, done) {
    this.waiting?.done(null);
    this.waiting = { request, done };
    if (!this.busy) this.begin();
  }

  /** The order for a request, as a promise. */
  order(request) {
    return new Promise((resolve) => this.ask(request, resolve));
  }
}
