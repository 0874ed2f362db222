// Starts the page: reads its facts, unpacks, shows the controls; says what is wrong where it cannot.

import { App } from "mudg/app";
import { Editor } from "mudg/editor";
import { exactFrames } from "mudg/exact";
import { Gizmo } from "mudg/gizmo";
import { listen } from "mudg/input";
import { Controls } from "mudg/ui";

const $ = (id) => document.getElementById(id);

async function start() {
  const facts = JSON.parse($("facts").textContent);
  const app = new App(facts, { canvas: $("canvas"), overlay: $("overlay"), stage: $("stage") });
  await app.load((share) => { $("progress").value = share; });
  app.editor = new Editor(app);
  app.gizmo = app.overlayDrawer.gizmo = new Gizmo(app, app.editor);
  exactFrames(app);
  listen(app, new Controls(app));
  $("loading").hidden = true;
  window.mudg = app; // for tests, and for the curious
  document.documentElement.dataset.ready = "yes";
}

start().catch((error) => {
  $("loading").hidden = false;
  $("progress").hidden = true;
  $("problem").textContent = `The scene cannot be shown: ${error.message} The videos of the report need no graphics card.`;
  document.documentElement.dataset.problem = error.message;
  throw error;
});
