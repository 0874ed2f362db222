// What leaves the page: pictures, videos, links.

import { scaled } from "mudg/app";
import { scriptText } from "mudg/edits";
import { fovOf } from "mudg/cameras";
import { FRAMES_PER_S, pathText } from "mudg/path";
import { toHash } from "mudg/state";
import { zipOf } from "mudg/zip";

const MOST_SIDE = 8192;

export function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

const nameOf = (app, end) => `${app.facts.title.replace(/[^\w.-]+/g, "_")}_${app.state.layer}_${app.state.t.toFixed(2)}s.${end}`;

/** What is shown, `times` as large, on a canvas of its own; boxes and points are drawn on it as on the page. */
function sheetOf(app, times) {
  const { canvas, overlay, renderer, state } = app, whole = app.last.view, factor = Math.min(times, MOST_SIDE / Math.max(whole.width, whole.height));
  const before = [canvas.width, canvas.height], view = scaled(whole, factor), { left, right, mode } = app.used();
  Object.assign(canvas, { width: view.width, height: view.height });
  const pictures = [app.pictureOf("left", left, view) ?? app.pictureOf("left", left, view, "color"), right === "recorded" ? app.photo() : right ? app.pictureOf("right", right, view) : null];
  if (view === whole) app.putExact(pictures);
  renderer.present(...pictures, [0, 0, view.width, view.height], mode, state.divider);
  const sheet = Object.assign(document.createElement("canvas"), { width: view.width, height: view.height }), c = sheet.getContext("2d");
  c.drawImage(canvas, 0, 0);
  if (overlay.style.visibility !== "hidden") c.drawImage(overlay, ...app.last.area, 0, 0, view.width, view.height);
  Object.assign(canvas, { width: before[0], height: before[1] });
  return sheet;
}

const pngOf = (sheet) => new Promise((resolve) => sheet.toBlob(resolve, "image/png"));

/** Saves what is shown as PNG, `times` as large. */
export async function savePicture(app, times) {
  const blob = await pngOf(sheetOf(app, times));
  app.change();
  save(blob, nameOf(app, "png"));
  return blob.size;
}

/** How many pictures a drive has. */
const framesOf = (app) => Math.floor(app.facts.end_s * FRAMES_PER_S + 1e-6) + 1;

/** Saves the whole drive as pictures in an archive: each is drawn in full, however long that takes. Asked for once more, it ends early. */
export async function saveFrames(app, say) {
  if (app.saving) { app.saving = false; return; }
  app.saving = true;
  const { t, playing } = app.state, count = framesOf(app), files = [];
  try {
    for (let k = 0; k < count && app.saving; k++) {
      say(`Frame ${k + 1} of ${count}. Frames ends it.`);
      await app.settled({ t: k / FRAMES_PER_S, playing: false });
      files.push({ name: `${String(k).padStart(5, "0")}.png`, blob: await pngOf(sheetOf(app, 1)) });
    }
    const archive = await zipOf(files);
    save(archive, nameOf(app, "zip"));
    say(`Saved ${files.length} frames. For a video: ffmpeg -framerate ${FRAMES_PER_S} -i %05d.png drive.mp4`);
    return archive;
  } finally {
    app.saving = false;
    app.change({ t, playing });
  }
}

/** Plays the drive once and records the picture; the browser encodes it. One that cannot saves frames. */
export function recordVideo(app, say) {
  if (!("MediaRecorder" in window) || !app.canvas.captureStream) return saveFrames(app, say);
  const kind = ["video/mp4;codecs=avc1.42E01E", "video/webm;codecs=vp9", "video/webm"].find((one) => MediaRecorder.isTypeSupported(one));
  if (!kind) return saveFrames(app, say);
  const recorder = new MediaRecorder(app.canvas.captureStream(30), { mimeType: kind, videoBitsPerSecond: 8e6 }), parts = [];
  const { loop } = app.state;
  recorder.ondataavailable = ({ data }) => parts.push(data);
  recorder.onstop = () => { app.change({ loop }); save(new Blob(parts, { type: kind }), nameOf(app, kind.includes("mp4") ? "mp4" : "webm")); say("Video saved."); };
  const watch = () => { if (!app.state.playing) { app.listeners.delete(watch); setTimeout(() => recorder.stop(), 200); } };
  app.change({ t: 0, playing: true, loop: false });
  recorder.start();
  app.listeners.add(watch);
  say("Recording. Pause to end it.");
}

/** What was edited and what is hidden as an edit script for `mudg edit` and `mudg render --edits`; empty where nothing is. */
export function editScript(state) {
  return scriptText(state.edits ?? [], state.hidden);
}

/** Saves the edit script: where `mudg view` was told to, or as a download. */
export async function saveEdits(app) {
  const text = editScript(app.state);
  if (!text) return "There are no edits to save.";
  if (app.facts.live) return app.editor.saveThere();
  save(new Blob([text], { type: "application/yaml" }), "edits.yaml");
  return "Saved edits.yaml for mudg edit.";
}

/** Saves the camera path for `mudg render`. */
export function savePath({ state, facts, last }) {
  save(new Blob([pathText(state.keys, facts.begin_s)], { type: "application/json" }), "path.json");
  return `Saved path.json: mudg render --path path.json --fov-deg ${Math.round(fovOf(last.view))}`;
}

/** Puts a link to what is shown into the clipboard. */
export async function saveLink(app) {
  history.replaceState(null, "", toHash(app.state));
  try {
    await navigator.clipboard.writeText(location.href);
    return "Link copied.";
  } catch {
    return "The link is in the address bar.";
  }
}
