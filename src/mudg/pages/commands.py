"""Command lines for the report of a run: what to do with it next, and its steps one by one."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from mudg.base import store
from mudg.base.errors import InputError

PLAIN: Final = "fit/street_gaussians"
GUIDED: Final = "fit/mudg_s"
STEPS: Final = (
    "scene", "annotate", "fuse", PLAIN, "adapt", "synthesize", GUIDED, "render/street_gaussians", "render/mudg_s", "score",
)  # fmt: skip
"""Folders of the chain, in the order in which they are made."""
INPUTS: Final = {
    "fused": ("--fused", "fuse"), "fitted": ("--fitted", PLAIN), "start": ("--start-from", PLAIN),
    "observations": ("--observations", "synthesize"),
}  # fmt: skip
"""Inputs that a step's record names: their flag, and the folder of the chain."""
VIEWS: Final = {"street_gaussians": "render/street_gaussians", "mudg_r": "synthesize", "mudg_s": "render/mudg_s"}


class CommandBlock(NamedTuple):
    """Command lines that belong together, with a sentence on what they do."""

    title: str
    lines: tuple[str, ...]


def next_commands(out: Path, source: str) -> list[CommandBlock]:
    """What a run can be used for. Each block works by itself, in the folder from which the run was started."""
    run = str(out)
    scene, movable = scene_of(out, source), _first_object(out)
    edit = f"- remove: {{ids: [{json.dumps(movable)}]}}" if movable else "- weather: {fog: {visibility_m: 60}}"
    blocks = [
        ("Fly through the scene in a browser; the second line compares both fits", [["view", run], ["view", run, run]]),
        ("One page to send to others", [["page", run, "--out", f"{run}.html"]]),
        ("Change the drive, and look at it", [
            [f"printf '%s\\n' {shlex.quote(edit)} > edits.yaml"], ["edit", run, "edits.yaml", "--out", f"{run}_edited"],
            ["view", run, "--edits", "edits.yaml"],
        ]),
        ("Pictures, depth and classes of another path", [
            ["render", scene, "--model", f"{run}/{GUIDED}", "--shifts-m", "1.5", "--out", f"{run}_views"],
        ]),
        ("Files for other programs (docs: export)", [
            ["export", "ply", run, "--out", f"{run}.ply"], ["export", "usdz", run, "--out", f"{run}.usdz"],
            *([["asset", "export", run, movable, "--out", f"{run}_object.safetensors"]] if movable else []),
        ]),
        ("The same on your own log", [["run", "LOG", "--out", "runs/mine"]]),
    ]  # fmt: skip
    return [CommandBlock(title, tuple(_line(words) for words in lines)) for title, lines in blocks]


def step_commands(out: Path, source: str) -> list[str]:
    """The steps of a run, each as a command with the settings that it had: as it stands it verifies the result and reuses it."""
    found = []
    for folder in STEPS:
        try:
            inputs: Sequence[str] = list(store.read_json(out / folder / store.RUN_STATE)["inputs"])
            verb = str(store.read_json(out / folder / store.RUN_STATE)["verb"])
        except (InputError, KeyError, TypeError):
            continue
        words = [verb, source if folder == "scene" else scene_of(out, source, labelled=folder != "annotate")]
        for name in inputs:
            if name in INPUTS:
                words += [INPUTS[name][0], f"{out}/{INPUTS[name][1]}"]
        if verb == "render":
            words += ["--model", f"{out}/fit/{Path(folder).name}"]
        if verb == "score":
            words += ["--views", *(f"{name}={out}/{place}" for name, place in VIEWS.items() if name in inputs)]
        found.append(_line([*words, "--config", f"{out}/{folder}/run.yaml", "--out", f"{out}/{folder}"]))
    return found


def scene_of(out: Path, source: str, labelled: bool = True) -> str:
    """The scene that the steps of a run read: labelled by it, made by it, or given to it."""
    names = ("annotate", "scene") if labelled else ("scene",)
    return next((f"{out}/{name}" for name in names if (out / name / "scene.json").is_file()), source)


def _line(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"mudg {shlex.join(words)}"


def _first_object(out: Path) -> str:
    """Id of an object that an edit script can name; empty if the fit has none."""
    try:
        nodes = store.read_json(out / GUIDED / "model.json")["nodes"]
        return next((str(node["name"]) for node in nodes if "label" in node), "")
    except (InputError, KeyError, TypeError):
        return ""
