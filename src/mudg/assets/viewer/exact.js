// Behind `mudg view` stands a server that draws with the program's own rasterizer. When the camera rests, its frame replaces the page's.

import { scriptText } from "mudg/edits";

/** Asks the server for a frame. */
function ask(app, body, signal) {
  return fetch("frame", { method: "POST", headers: { "Content-Type": "application/json", "X-Mudg-Token": app.facts.live.token }, body: JSON.stringify(body), signal });
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
        const answer = await ask(app, { ...body, scene }, current.signal);
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
