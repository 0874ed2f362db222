"""``mudg doctor``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from mudg.steps.step import Flag, Step


class Doctor(Step):
    """Report what this machine offers, or check a scene or log for errors."""

    section = "start here"
    examples = ("mudg doctor", "mudg doctor runs/kitti/scene", "mudg doctor --json")
    scene: Annotated[Path | None, Flag("[SCENE]", "first")] = None
    """Scene directory, folder of mudg run, or log in the custom format, to check (not given: report on this
    machine)."""

    def act(self) -> dict[str, Any]:
        from mudg.steps import diagnosis

        return diagnosis.report_scene(self.scene) if self.scene is not None else diagnosis.report_machine()
