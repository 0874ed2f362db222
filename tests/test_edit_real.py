"""Edits of a recorded drive: the lead car of KITTI's 2011_09_26 taken away and moved. Pictures stay in the test's
folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fit_settings import fit_config

from mudg.base import geometry, store
from mudg.editing.settings import EditConfig
from mudg.formats.settings import IngestConfig
from mudg.labels.settings import AnnotateConfig
from mudg.scene.check import check_scene
from mudg.scene.read import read_image, read_points, read_scene
from mudg.scene.settings import FuseConfig
from mudg.steps.edit import Edit
from mudg.steps.fit import Fit
from mudg.steps.ingest import Annotate, Fuse, Ingest

pytestmark = pytest.mark.slow
LEAD = "0"


@pytest.fixture(scope="module")
def drive(shared_data: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kitti")
    settings = IngestConfig(resolution="320", contact_sheet=False)
    Ingest(log=shared_data("kitti_2011_09_26"), out=root / "raw", settings=settings).run()
    Annotate(scene=root / "raw", out=root / "scene", settings=AnnotateConfig()).run()  # classes tell what is ground
    Fuse(scene=root / "scene", out=root / "fuse", settings=FuseConfig()).run()
    config = fit_config(method="street_gaussians", iterations=100, start__gaussians=6000, densify__max_gaussians=8000)
    Fit(scene=root / "scene", fused=root / "fuse", out=root / "fit" / "street_gaussians", settings=config).run()
    return root


@pytest.mark.parametrize("text", [f'- remove: {{ids: ["{LEAD}"]}}', f'- move: {{id: "{LEAD}", along_m: 5, left_m: 1}}'])
def test_the_lead_car_of_a_recorded_drive(drive: Path, tmp_path: Path, text: str) -> None:
    store.write_text(tmp_path / "e.yaml", text)
    out = Edit(source=drive, script=tmp_path / "e.yaml", out=tmp_path / "out", settings=EditConfig()).run()
    assert not [finding for finding in check_scene(out / "scene") if finding.level == "error"]
    old, new = read_scene(drive / "scene"), read_scene(out / "scene")
    for a, b in zip(old.frames, new.frames, strict=True):
        assert (read_image(old, a) != read_image(new, b)).any(-1).mean() < 0.5
    lead = old.track(LEAD)
    for a, b in zip(old.sweeps, new.sweeps, strict=True):
        before, after = read_points(old, a), read_points(new, b)
        local = geometry.transform_points(geometry.invert(lead.pose_at(a.time_s)) @ a.world_from_lidar, before.xyz)
        here = np.linalg.norm(local[:, :2], axis=1)
        azimuth = np.arctan2(before.xyz[:, 1], before.xyz[:, 0])
        beside = (here > 12) & (np.abs(azimuth) > 0.5)
        kept = {tuple(p) for p in after.xyz}
        assert all(tuple(p) in kept for p in before.xyz[beside][::50])  # outside of the edit beams stay bit for bit
