"""Verbs that draw, judge and show: ``mudg render``, ``score``, ``view``, ``page``, ``report``, ``serve``."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, cast

from mudg.base.errors import UsageError
from mudg.base.layout import LAYER_FILES, OBSERVATION_FILES, SWEEP_FILES, below
from mudg.steps.engine import Make, Output, script_of
from mudg.steps.step import FILE_YAML, RUN, SCENE, Flag, Step

if TYPE_CHECKING:
    from mudg.base.run_folder import RunDir
    from mudg.editing.settings import RenderConfig, ScoreConfig
    from mudg.sim.settings import ServeConfig
    from mudg.viewer.settings import PageConfig, ViewConfig


class RenderViews(Output):
    """Render RGB, depth and semantics of a fitted scene on shifted trajectories."""

    verb_name = "render"
    examples = (
        "mudg render scenes/city --model runs/mudg_s --shifts-m 0 3 -3 --out runs/render",
        "mudg render runs/kitti --shifts-m 2 --out x",
    )
    smaller = "smaller views (--width-px), fewer --cameras"
    result = "views"
    from_run = ("model",)
    version, files = (
        3,
        ("*.mp4", *below("*", OBSERVATION_FILES), *below("lidar/*", SWEEP_FILES), *below("layers/*", LAYER_FILES)),
    )
    short = (*("cameras", "shifts_m", "paths", "width_px", "fov_deg", "lidar", "layers", "video", "device", "repair"),)
    scene: Annotated[Path, Flag("SCENE", "first", "scene")]
    """Scene directory that the Gaussian scene was fitted to, or folder of mudg run."""
    model: Annotated[Path | None, Flag("FOLDER", "second", "model")] = None
    """Gaussian scene written by fit, or edit (not given: that of the run at SCENE)."""
    edits: Annotated[Path | None, FILE_YAML] = None
    """Edit script (docs/edit.md) to carry out before rendering."""
    fused: Annotated[Path | None, Flag("FOLDER", "", "fused")] = None
    """Point clouds written by fuse, for --repair (not given: those of the run at SCENE)."""
    path: Annotated[Path | None, Flag("FILE")] = None
    """Camera path to draw in place of the shifts: poses in the format of TUM or KITTI (.txt), or nerfstudio's
    transforms.json, on the scene's clock and in its world. It has the optics of the first camera."""
    settings: RenderConfig

    def checked(self) -> Self:
        if self.settings.repair and (self.edits is not None or self.settings.layers):
            what, remedy = "views of the drive as it was fitted can be repaired", "leave one of them out"
            raise UsageError(what, where="--repair", got="--edits or --layers", remedy=remedy)
        if self.path is not None and self.settings.lidar:
            what, remedy = "a path of your own is drawn without sweeps", "leave one of them out"
            raise UsageError(what, where="--path", got="--lidar", remedy=remedy)
        return self

    def required(self) -> tuple[str, ...]:
        return (*self.from_run, "fused") if self.settings.repair else self.from_run

    def inputs(self) -> dict[str, str]:
        table = Path(self.settings.lidar) if self.settings.lidar.endswith(".json") else None
        files = {"edits": self.edits, "lidar": table, "path": self.path}
        read = self.digests({"scene": self.scene, "model": self.model, **files})
        if not self.settings.repair:
            return read
        from mudg.diffusion.model_files import digest

        return read | self.digests({"fused": self.fused}) | {"diffusion": digest(self.settings.repair_model)}

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.editing import render

        model, script = cast("Path", self.model), script_of(self.edits)
        edited = render.prepare(self.settings, self.scene, model, script, self.path)
        views = partial(render.write_views, self.settings, self.scene, model, edited, path=self.path, fused=self.fused)
        if not self.settings.lidar and not self.settings.layers:
            return views
        from mudg.datasets.write import write_layers
        from mudg.scene.read import read_scene
        from mudg.sim import lidar as sweeps

        if self.settings.lidar:
            sweeps.wanted_sweeps(self.settings.lidar, read_scene(self.scene))

        def make(work: RunDir) -> dict[str, Any]:
            summary, drawn = views(work), (self.settings, self.scene, model, script)
            if self.settings.layers:
                summary["layers"] = write_layers(*drawn, self.path, work.path)
            if self.settings.lidar:
                summary["lidar"] = sweeps.simulate_log(*drawn, work.path)
            return summary

        return make


_FILES = (*("lpips_weights", "lpips_vgg_weights", "fid_weights", "fvd_weights", "detections", "lanes"),)
"""Settings that name files and folders to read."""


class Score(Output):
    """Compare views with ground truth: metrics, tables, error images."""

    examples = ("mudg score scenes/city --views mudg_s=runs/render mudg_r=runs/virtual --out runs/score",)
    smaller = "smaller views (--width-px), fewer --views"
    version = 7
    files = (
        *("metrics.json", "metrics.md", "errors/*.png", "features/*.safetensors"),
        *below("truth/*", OBSERVATION_FILES),
        *below("nearest_fill/*", OBSERVATION_FILES),
    )
    short = ("baseline", "lpips_weights", "fid_weights", "fvd_weights", "perceptual_views", "device")
    scene: Annotated[Path, SCENE]
    """Scene directory that the views belong to, or folder of mudg run."""
    fused: Annotated[Path | None, Flag("FOLDER", "", "fused")] = None
    """Point clouds written by fuse. They are needed for the baseline without learning (not given: no baseline)."""
    views: Annotated[Mapping[str, Path], Flag("NAME=FOLDER ...", "second", "views")]
    """Methods to compare: a name and the folder that render or synthesize wrote, e.g. mudg_s=runs/render."""
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
    version, files = 3, below("*", (*OBSERVATION_FILES, "moving.safetensors"))
    scene: Path
    trajectories: tuple[Any, ...]
    """Each a `Trajectory`."""

    def key_settings(self) -> dict[str, Any]:
        seen = [view for path in self.trajectories for view in path.views]
        views = [[view.time_s, *view.world_from_cam.ravel().tolist(), view.camera.width] for view in seen]
        return {"trajectories": [path.name for path in self.trajectories], "views": views}

    def make(self, work: RunDir) -> dict[str, Any]:
        from mudg.scoring import truth as score_truth

        score_truth.write_truth(self.scene, self.trajectories, work.path)
        return {"trajectories": [path.name for path in self.trajectories]}


class ViewScene(Step):
    """Show a fitted scene in a browser, with exact frames from the rasterizer."""

    verb_name = "view"
    examples = (
        "mudg view runs/kitti",
        "mudg view runs/a runs/b",
        "mudg view runs/mudg_s --scene scenes/city --port 8080",
    )
    source: Annotated[Path, RUN]
    """Folder of a finished mudg run, or Gaussian scene written by fit."""
    compare: Annotated[Path | None, Flag("[RUN2]", "first")] = None
    """A second run or fit of the same log, to compare with. The same run: its two fits."""
    scene: Annotated[Path | None, Flag("FOLDER", "", "scene")] = None
    """Scene directory that a Gaussian scene was fitted to. A run has its own."""
    edits: Annotated[Path | None, FILE_YAML] = None
    """Edit script (docs/edit.md) that the page begins with."""
    edits_out: Annotated[Path | None, FILE_YAML] = None
    """Where edits made on the page are saved (without it: edits.yaml beside RUN, or in the current folder)."""
    settings: ViewConfig

    def act(self) -> dict[str, Any]:
        from mudg.viewer import view

        places = {"scene": self.scene, "edits": self.edits, "edits_out": self.edits_out}
        return view.run_view(self.settings, self.source, self.compare, **places)


class Page(Step):
    """Write a fitted scene as one HTML page: fly through it, any layer, any time, without a network."""

    result = "page"
    examples = (
        "mudg page runs/kitti --out kitti.html",
        "mudg page runs/kitti --compare runs/kitti --out both.html",
        "mudg page runs/mudg_s --scene scenes/city --out city.html",
    )
    source: Annotated[Path, RUN]
    """Folder of a finished mudg run, or Gaussian scene written by fit."""
    out: Annotated[Path, Flag("FILE.html")]
    """Page to write: one file. Above 32 MB, a folder FILE_page beside it, for a web server."""
    scene: Annotated[Path | None, Flag("FOLDER", "", "scene")] = None
    """Scene directory that a Gaussian scene was fitted to. A run has its own."""
    compare: Annotated[Path | None, Flag("RUN2")] = None
    """A second run or fit of the same log, to compare with. The same run: its two fits."""
    overwrite: bool = False
    """Replace the page if it exists."""
    settings: PageConfig

    def act(self) -> dict[str, Any]:
        from mudg.viewer import view

        return view.run_page(
            self.settings, self.source, self.out, scene=self.scene, compare=self.compare, overwrite=self.overwrite
        )


class Report(Step):
    """Write one page over many finished runs: pictures, links, and a table of all scores to sort and filter."""

    result = "page"
    examples = ("mudg report runs/kitti runs/city --out runs.html", "mudg report runs --out runs.html")
    runs: Annotated[tuple[Path, ...], Flag("RUN ...", "rest")]
    """Folders of mudg run, score, bench or batch; of any other folder, the folders in it."""
    out: Annotated[Path, Flag("FILE.html")]
    """Page to write."""
    overwrite: bool = False
    """Replace the page if it exists."""

    def act(self) -> dict[str, Any]:
        from mudg.viewer import gallery

        return gallery.run(self.runs, self.out, overwrite=self.overwrite)


class Serve(Step):
    """Serve a fitted scene to driving simulators over gRPC, as a renderer of cameras and LiDAR."""

    examples = ("mudg serve runs/kitti --port 50051", "mudg serve runs/kitti --edits cut_in.yaml")
    source: Annotated[Path, RUN]
    """Folder of a finished mudg run, or Gaussian scene written by fit."""
    scene: Annotated[Path | None, Flag("FOLDER", "", "scene")] = None
    """Scene directory that a Gaussian scene was fitted to. A run has its own."""
    edits: Annotated[Path | None, FILE_YAML] = None
    """Edit script (docs/edit.md) to carry out before."""
    settings: ServeConfig

    def act(self) -> dict[str, Any]:
        from mudg.sim import server

        return server.serve(self.settings, self.source, self.edits, self.scene)
