"""What tests of fits share: short settings, a small street, fits of it, interruptions."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from toy_world import camera, fused_cloud, truth, view_at, write_scene

from mudg.base import config as configuration
from mudg.base.types import FusedCloud, Scene
from mudg.core import metrics, trajectory
from mudg.core.raster.rasterize import RasterConfig
from mudg.gaussians import fit
from mudg.gaussians.settings import FitConfig
from mudg.scene.clouds import write_fused
from mudg.scene.observations import ObservationWriter
from mudg.steps.fit import Fit


def fit_config(**changes: Any) -> FitConfig:
    """A configuration with some fields changed; two underscores stand between a group and its field:
    ``densify__kind="none"``."""
    dotted = {name.replace("__", "."): value for name, value in changes.items()}
    return configuration.load(FitConfig, overrides=configuration.nested(dotted))


SMALL_RADIANCE = {"radiance__size": "tiny"}
"""A radiance field of the smallest networks."""


def fit_to(world: Mapping[str, Path], out: Path, settings: FitConfig, **more: Any) -> Fit:
    """A fit to the scene and the clouds of a world."""
    return Fit(scene=world["scene"], fused=world["fuse"], out=out, settings=settings, **more)


def small_fit(method: str, *, iterations: int = 24, **changes: Any) -> FitConfig:
    """A fit of few Gaussians that writes neither checkpoints nor previews on the way."""
    few = {"start__gaussians": 900, "densify__max_gaussians": 1500, "checkpoint_every": 1000, "preview_every": 1000}
    return fit_config(method=method, iterations=iterations, **{**few, **changes})


def written_street(
    root: Path, size: tuple[int, int], frames: int, shifts_m: Sequence[float] = (2.0,)
) -> dict[str, Path]:
    """A scene with a moving car, its fused cloud, and perfect virtual views beside its path."""
    scene = write_scene(root / "scene", frames=frames, width=size[0], height=size[1])
    return written_clouds_and_views(root, scene, fused_cloud(frames), shifts_m)


def written_clouds_and_views(
    root: Path, scene: Scene, cloud: FusedCloud, shifts_m: Sequence[float] = (2.0,)
) -> dict[str, Path]:
    """What fits to a scene in ``root`` read."""
    write_fused(root / "fuse", cloud, {})
    for shift_m in shifts_m:
        path = trajectory.shifted(scene, "front", shift_m)
        with ObservationWriter(root / "virtual" / path.name, path.name, "truth") as writer:
            for view in path.views:
                writer.add(truth(view.resized(30, 20)))
    return {name: root / name for name in ("scene", "fuse", "virtual")}


def mean_psnr(folder: Path, size: tuple[int, int], left_m: float = 0.0) -> float:
    """How near the renders of a fitted street are to the exact pictures, on its path or beside it."""
    model, cam = fit.load_model(folder), camera(width=size[0], height=size[1])
    views = [view_at(time_s, cam, left_m=left_m) for time_s in (0.3, 0.9)]
    drawn = [(fit.render_view(model, view, RasterConfig()).rgb, truth(view).rgb) for view in views]
    return sum(metrics.psnr(*pair) for pair in drawn) / len(views)


def log_lines(folder: Path) -> list[dict[str, Any]]:
    """What a run noted of its steps."""
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def fitted_bytes(folder: Path) -> dict[str, bytes]:
    """The files of a fitted scene."""
    return {path.name: path.read_bytes() for path in (*sorted(folder.glob("*.safetensors")), folder / "model.json")}


@contextlib.contextmanager
def interrupted(after: int, meanwhile: Callable[[], object] = lambda: None) -> Iterator[None]:
    """Within: a fit gets Ctrl-C, or SIGTERM at odd steps, while it does a step, and ends with KeyboardInterrupt."""
    adam_step = fit.adam_step

    def stop(model: Any, step: int, *rest: Any) -> None:
        adam_step(model, step, *rest)
        if step == after:
            meanwhile()
            os.kill(os.getpid(), signal.SIGTERM if step % 2 else signal.SIGINT)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "adam_step", stop)
        with pytest.raises(KeyboardInterrupt):
            yield
