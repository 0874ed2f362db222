"""How a scene is drawn while it is fitted: noted in the model, kept by renders, refused where it cannot be."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from bench_logs import city_scene, fused

from mudg import native
from mudg.base.errors import UsageError
from mudg.core.raster.rasterize import RasterConfig
from mudg.gaussians import fit
from mudg.gaussians.model import compose
from mudg.gaussians.rendering import NEAR_M, raster_of, rasterize
from mudg.gaussians.settings import DrawingConfig, FitConfig, StartConfig
from mudg.scene.read import read_scene
from mudg.steps.fit import Fit

pytestmark = pytest.mark.skipif(native.library() is None, reason="the city needs the native library")
USUAL = FitConfig(
    method="street_gaussians", iterations=4, semantics=False, start=StartConfig(gaussians=800), checkpoint_every=100
)
SMOOTH = replace(USUAL, drawing=DrawingConfig(antialias=True))


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A scene of three frames and its clouds."""
    root = tmp_path_factory.mktemp("drawing")
    scene = city_scene(root / "scene", seed=0, n_frames=3, width=72)
    return scene, fused(scene, root / "fuse")


def fitted(config: FitConfig, prepared: tuple[Path, Path], out: Path, start: Path | None = None) -> Path:
    return Fit(scene=prepared[0], fused=prepared[1], start_from=start, out=out, settings=config).run()


@pytest.fixture(scope="module")
def fits(prepared: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same few steps, drawn as usual and without added light."""
    root = tmp_path_factory.mktemp("fits")
    return {name: fitted(config, prepared, root / name) for name, config in (("usual", USUAL), ("smooth", SMOOTH))}


def test_a_model_notes_how_it_was_drawn_and_renders_draw_so(fits: dict[str, Path], prepared: tuple[Path, Path]) -> None:
    facts = {name: json.loads((folder / "model.json").read_text())["facts"] for name, folder in fits.items()}
    assert "drawing" not in facts["usual"]
    assert facts["smooth"]["drawing"] == {"antialias": True}
    model, view = fit.load_model(fits["smooth"]), read_scene(prepared[0]).frames[1].view
    assert raster_of(model) == RasterConfig(near_m=NEAR_M, antialias=True)
    gaussians = compose(model, view.time_s)
    configs = {smooth: RasterConfig(near_m=NEAR_M, antialias=smooth) for smooth in (False, True)}
    drawn = {smooth: rasterize(gaussians, view, config).alpha for smooth, config in configs.items()}
    as_noted = rasterize(gaussians, view, raster_of(model)).alpha
    assert torch.equal(as_noted, drawn[True])
    assert not torch.equal(drawn[True], drawn[False])  # else this test shows nothing
    assert raster_of(fit.load_model(fits["usual"])) == RasterConfig(near_m=NEAR_M)


def test_a_finished_fit_goes_on_only_as_it_was_drawn(
    fits: dict[str, Path], prepared: tuple[Path, Path], tmp_path: Path
) -> None:
    out = fitted(SMOOTH, prepared, tmp_path / "on", fits["smooth"])
    assert json.loads((out / "model.json").read_text())["facts"]["drawing"] == {"antialias": True}
    with pytest.raises(UsageError, match="drawn with other settings"):
        fitted(USUAL, prepared, tmp_path / "other", fits["smooth"])
