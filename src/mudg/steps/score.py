"""``mudg score``."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from mudg.base.errors import UsageError
from mudg.base.layout import OBSERVATION_FILES, below
from mudg.steps.engine import Make
from mudg.steps.outputs import Output
from mudg.steps.step import SCENE, Flag

if TYPE_CHECKING:
    from mudg.base.run_folder import RunDir
    from mudg.editing.settings import ScoreConfig

_FILES = (
    "lpips_weights",
    "lpips_vgg_weights",
    "lpips_squeeze_weights",
    "fid_weights",
    "fvd_weights",
    "dino_weights",
    "clip_weights",
    "video_features",
    "detections",
    "lanes",
)
"""Settings that name files and folders to read."""


class Score(Output):
    """Compare views with ground truth: metrics, tables, error images."""

    section = "single steps, in the order of use"
    examples = ("mudg score scenes/city --views mudg_s=runs/render mudg_r=runs/virtual --out runs/score",)
    smaller = "smaller views (--width-px), fewer --views"
    version, files = (
        6,
        (
            "metrics.json",
            "metrics.md",
            "errors/*.png",
            "features/*.safetensors",
            *below("truth/*", OBSERVATION_FILES),
            *below("nearest_fill/*", OBSERVATION_FILES),
        ),
    )
    short = ("baseline", "lpips_weights", "fid_weights", "fvd_weights", "perceptual_views", "device")
    scene: Annotated[Path, SCENE]
    """Scene directory that the views belong to, or folder of mudg run."""
    fused: Annotated[Path | None, Flag("FOLDER", "", "fused")] = None
    """Point clouds written by fuse. They are needed for the baseline without learning (not given: no baseline)."""
    views: Annotated[Mapping[str, Path], Flag("NAME=FOLDER ...", "second", "views")]
    """Methods to compare: a name and the folder that render or synthesize wrote, e.g. mudg_s=runs/render. They may also
    stand after SCENE without the flag."""
    settings: ScoreConfig
    truth: Annotated[Path | None, Flag(hidden=True)] = None
    """Folder of `DrawTruth` for the scene, read instead of drawing the truth again."""

    def checked(self) -> Self:
        if not self.views:
            raise UsageError("no views were given", where="--views", expected="NAME=FOLDER ...")
        return self

    def reads(self) -> dict[str, Path | str | None]:
        return super().reads() | {name.replace("_", "-"): getattr(self.settings, name) for name in _FILES}

    def inputs(self) -> dict[str, str]:
        files = {name: getattr(self.settings, name) for name in _FILES}
        fused = self.fused if self.settings.baseline else None
        return self.digests({"scene": self.scene, **self.views, "fused": fused, **files, "truth": self.truth})

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.base.devices import choose_device
        from mudg.scoring import score

        choose_device(self.settings.device, "networks of the scores")
        return partial(score.write_scores, self.settings, self.scene, self.views, fused=self.fused, truth=self.truth)

    def answer(self, outcome: Any) -> dict[str, Any]:
        from mudg.scoring import score

        return {"metrics": outcome / "metrics.json", "text": score.summary_table(outcome)}


class DrawTruth(Output):
    """Draw the truth of a generated city on some trajectories once, for many scores."""

    verb_name = "truth"
    version, files = 2, below("*", (*OBSERVATION_FILES, "moving.safetensors"))
    scene: Path
    trajectories: tuple[Any, ...]
    """Each a `Trajectory`."""

    def key_settings(self) -> dict[str, Any]:
        views = [
            [v.time_s, *v.world_from_cam.ravel().tolist(), v.camera.width]
            for path in self.trajectories
            for v in path.views
        ]
        return {"trajectories": [path.name for path in self.trajectories], "views": views}

    def make(self, work: RunDir) -> dict[str, Any]:
        from mudg.scoring import truth as score_truth

        score_truth.write_truth(self.scene, self.trajectories, work.path)
        return {"trajectories": [path.name for path in self.trajectories]}
