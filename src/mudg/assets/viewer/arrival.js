// Brings the chunks of the scenes: the coarse ones first, then those near the camera. A chunk is shown when all of it is there and is what
// the page was made with; one that fails is tried again, then named, and can be asked for once more.

import { bytesOf, inflate, sectionsOf } from "mudg/data";

const AT_ONCE = 4; // files under way
const TRIES = 3;
const WAIT_MS = 700; // before the second try; twice as long before the third

/** How far a place is from a chunk's box, metres; 0 for what moves. */
function distance(eye, { box, moves }) {
  if (!box || moves) return 0;
  return Math.hypot(...eye.map((v, k) => Math.max(box[0][k] - v, v - box[1][k], 0)));
}

export class Arrival {
  /** @param loaded [{scene, sorter}] of the renderer. @param eye says where the camera is. @param used says which scenes are shown. */
  constructor(renderer, loaded, eye, used) {
    Object.assign(this, { renderer, loaded, eye, used });
    this.all = loaded.flatMap((one) => one.scene.facts.chunks.map((chunk, number) => ({ one, chunk, number, bytes: chunk.file.bytes })));
    this.waiting = [...this.all];
    this.failed = []; // {part, message}
    this.have = 0;
    this.haveBytes = 0;
    this.bytes = this.all.reduce((sum, part) => sum + part.bytes, 0);
    this.listeners = new Set();
    this.whole = new Promise((resolve) => { this.complete = resolve; });
  }

  /** Brings everything; returns when nothing is under way any more. */
  async begin() {
    await Promise.all(Array.from({ length: AT_ONCE }, () => this.work(() => this.next())));
    if (this.have === this.all.length) this.complete();
    this.tell();
  }

  /** Brings the first chunk of every scene. Throws if one does not come: without it there is no picture. */
  async first() {
    const parts = this.waiting.filter((part) => part.number === 0);
    this.waiting = this.waiting.filter((part) => part.number !== 0);
    await Promise.all(parts.map((part) => this.bring(part)));
  }

  /** Asks once more for what failed. */
  again() {
    this.waiting.push(...this.failed.map(({ part }) => part));
    this.failed = [];
    this.tell();
    return this.begin();
  }

  async work(next) {
    for (let part = next(); part; part = next()) {
      try {
        await this.bring(part);
      } catch (error) {
        this.failed.push({ part, message: error.message });
      }
      this.tell();
    }
  }

  /** Takes the chunk that is wanted most from those that wait. */
  next() {
    const eye = this.eye(), used = this.used();
    const rank = ({ one, chunk }) => (used.includes(one) ? 0 : 1e6) + 1e4 * chunk.level + distance(eye, chunk);
    let best = 0;
    const ranks = this.waiting.map(rank);
    ranks.forEach((value, k) => { if (value < ranks[best]) best = k; });
    return this.waiting.splice(best, 1)[0];
  }

  async bring(part) {
    const { one, chunk, number } = part, { scene, sorter } = one;
    for (let tried = 1; ; tried++) {
      try {
        const buffer = await inflate(await bytesOf(chunk.file, tried > 1));
        const words = await sorter.unpack(number * scene.chunkRows, chunk.rows, buffer, sectionsOf(buffer, chunk.directory), scene.texels);
        this.renderer.add(one, number, words, chunk.rows);
        break;
      } catch (error) {
        if (tried === TRIES || document.getElementById(chunk.file.name)) throw error;
        await new Promise((resolve) => setTimeout(resolve, tried * WAIT_MS));
      }
    }
    this.have++;
    this.haveBytes += part.bytes;
  }

  tell() {
    for (const listener of this.listeners) listener(this);
  }

  /** "loading", "failed" (something did not come, and nothing is under way) or "whole". */
  state() {
    if (this.have === this.all.length) return "whole";
    return this.have + this.failed.length === this.all.length ? "failed" : "loading";
  }

  /** What there is to say about it, in words. */
  text() {
    const mb = (bytes) => (bytes / 1e6).toFixed(1), { have, all, failed } = this;
    if (this.state() === "failed") return `The picture is not complete: ${failed.length} of ${all.length} parts of the scene did not come (${failed[0].message}).`;
    return `Loading: ${have} of ${all.length} parts, ${mb(this.haveBytes)} of ${mb(this.bytes)} MB${failed.length ? `, ${failed.length} failed` : ""}`;
  }
}
