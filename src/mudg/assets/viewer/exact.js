// Behind `mudg view` stands a server that draws with the program's own rasterizer. When the camera rests, its frame replaces the page's;
// it makes videos of the drive, too.

import { Cameras } from "mudg/cameras";
import { scriptText } from "mudg/edits";
import { FRAMES_PER_S } from "mudg/path";
import { framesOf, nameOf, save } from "mudg/share";

/** Asks the server something. */
function ask(app, name, body, signal) {
  return fetch(name, { method: "POST", headers: { "Content-Type": "application/json", "X-Mudg-Token": app.facts.live.token }, body: JSON.stringify(body), signal });
}

/** What a question says besides time and place. @param view see cameras.js. */
function wanted({ state: s }, view) {
  return { scene: s.scene, layer: s.layer, hidden: [...s.hidden], edits: scriptText(s.edits), camera: s.mode === "recorded" ? s.camera : "",
    width: view.width, height: view.height, fx: view.fx, fy: view.fy, cx: view.cx, cy: view.cy };
}

/** Asks for exact frames whenever the camera rests. */
export function exactFrames(app) {
  const { live } = app.facts, badge = document.getElementById("exact");
  if (!live) return;
  let current = null, answered = null; // what is asked for; for which change of the view
  app.onRest = async () => {
    const s = app.state;
    if (!live.layers.includes(s.layer) || app.editor.wrong || answered === app.changed) return;
    current?.abort();
    answered = app.changed;
    current = new AbortController();
    const view = app.last.view, asked = app.changed;
    const body = { ...wanted(app, view), time_s: s.t + app.facts.begin_s, eye: view.eye, axes: view.axes }, images = [];
    try {
      for (const scene of app.used().right?.scene ? [s.scene, 1 - s.scene] : [s.scene]) { // of two scenes both, so that they are compared alike
        const answer = await ask(app, "frame", { ...body, scene }, current.signal);
        if (!answer.ok) throw new Error(await answer.text());
        images.push(await createImageBitmap(await answer.blob(), { colorSpaceConversion: "none" }));
      }
      if (app.changed !== asked) return; // the camera has moved on
      app.exact = { key: asked, images };
      app.draw(1, false);
      app.sharp = true;
      badge.hidden = false;
    } catch (error) {
      if (error.name === "AbortError") return;
      answered = null;
      document.getElementById("note").textContent = `No exact frame: ${error.message}`;
    }
  };
  app.listeners.add(() => { badge.hidden = true; });
}

/** The question for a video of the drive, from where the page looks: a recorded camera has the size it was recorded at. */
export function videoOf(app) {
  const { state: s, facts, canvas } = app, moments = [];
  let view = null;
  for (let k = 0; k < framesOf(app); k++) {
    const t = k / FRAMES_PER_S, cameras = new Cameras(app.drive, { ...s, t });
    view = s.mode === "recorded" ? cameras.exact(s.camera, t, s.shift, s.up, 0, s.fov) : cameras.view(canvas.width, canvas.height);
    moments.push({ time_s: t + facts.begin_s, eye: view.eye, axes: view.axes });
  }
  return { ...wanted(app, view), fps: FRAMES_PER_S, moments };
}

/**
 * Has the server make a video of the drive.
 * @param signal ends it. @param tell gets the number of frames that are made, and that of all.
 * @returns the MP4 file as a Blob.
 */
export async function exactVideo(app, signal, tell) {
  const answer = await ask(app, "video", videoOf(app), signal);
  if (!answer.ok) throw new Error(await answer.text());
  const reader = answer.body.getReader(), text = new TextDecoder();
  let rest = new Uint8Array(0), expected = null;
  const parts = [];
  for (let piece = await reader.read(); !piece.done; piece = await reader.read()) {
    if (expected !== null) { parts.push(piece.value); continue; }
    const both = new Uint8Array(rest.length + piece.value.length); // lines of JSON, then the file
    both.set(rest);
    both.set(piece.value, rest.length);
    rest = both;
    for (let end = rest.indexOf(10); end >= 0 && expected === null; end = rest.indexOf(10)) {
      const said = JSON.parse(text.decode(rest.subarray(0, end)));
      rest = rest.slice(end + 1);
      if (said.problem) throw new Error(said.problem);
      if (said.bytes !== undefined) { expected = said.bytes; parts.push(rest); } else tell(said.frame, said.frames);
    }
  }
  const video = new Blob(parts, { type: "video/mp4" });
  if (expected === null || video.size !== expected) throw new Error("the server stopped in the middle");
  return video;
}

/** The button that makes a video; while one is made, it says how far it is, and ends it. */
export function exactVideos(app, say) {
  const { live } = app.facts, button = document.getElementById("mp4"), title = button.textContent;
  let current = null;
  if (!live?.layers.length) return;
  button.hidden = false;
  const show = () => { button.disabled = !current && !live.layers.includes(app.state.layer); };
  button.onclick = async () => {
    if (current) { current.abort(); return; }
    current = new AbortController();
    const name = nameOf(app, "mp4");
    try {
      button.textContent = "Cancel the video";
      const video = await exactVideo(app, current.signal, (made, all) => { button.textContent = `Cancel (${made} of ${all} frames)`; });
      save(video, name);
      say(`Saved ${name}, ${(video.size / 1e6).toFixed(1)} MB.`);
    } catch (error) {
      say(error.name === "AbortError" ? "The video was cancelled." : `No video: ${error.message}`);
    } finally {
      current = null;
      button.textContent = title;
      show();
    }
  };
  app.listeners.add(show);
  show();
}
