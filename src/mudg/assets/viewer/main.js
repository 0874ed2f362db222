// Starts the page: reads its facts, unpacks, shows the controls; says what is wrong where it cannot.

import { App } from "mudg/app";
import { Brush } from "mudg/brush";
import { Editor } from "mudg/editor";
import { exactFrames } from "mudg/exact";
import { Gizmo } from "mudg/gizmo";
import { listen } from "mudg/input";
import { Controls } from "mudg/ui";

const $ = (id) => document.getElementById(id);

async function start() {
  const facts = JSON.parse($("facts").textContent);
  if (location.protocol === "file:" && !$(facts.log.file.name)) {
    throw new Error("this page is a folder of files, and a browser reads no files beside a page that it opened from the disk. "
      + "Serve the folder: python -m http.server --directory FOLDER, then open http://localhost:8000. Or show the run itself: mudg view RUN.");
  }
  const app = new App(facts, { canvas: $("canvas"), overlay: $("overlay"), stage: $("stage") });
  await app.load((share) => { $("progress").value = share; });
  app.editor = new Editor(app);
  app.gizmo = app.overlayDrawer.gizmo = new Gizmo(app, app.editor);
  app.brush = app.overlayDrawer.brush = new Brush(app, app.editor);
  exactFrames(app);
  listen(app, new Controls(app));
  $("loading").hidden = true;
  window.mudg = app; // for tests, and for the curious
  document.documentElement.dataset.ready = "yes";
}

start().catch((error) => {
  $("loading").hidden = false;
  $("progress").hidden = true;
  $("problem").textContent = `The scene cannot be shown: ${error.message.replace(/\.$/, "")}. The videos of the report need no graphics card.`;
  $("reload").hidden = false;
  $("reload").onclick = () => location.reload();
  document.documentElement.dataset.problem = error.message;
  throw error;
});
