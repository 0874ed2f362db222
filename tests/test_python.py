"""What a notebook user does: the page docs/python.md as it stands, verbs as functions, edits of a fitted scene."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused

import mudg
from mudg.base import store
from mudg.base.errors import UsageError
from mudg.base.geometry import yaw_matrix


@pytest.fixture(scope="module")
def notebook(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Names that the page's code leaves behind, run from top to bottom in an empty folder."""
    blocks = re.findall(r"```python\n(.*?)```", (repository / "docs" / "python.md").read_text(), re.DOTALL)
    assert len(blocks) == 6
    names: dict[str, Any] = {}
    folder = tmp_path_factory.mktemp("notebook")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for block in blocks:
            exec(compile(block, "docs/python.md", "exec"), names)
    return {**names, "folder": folder}


def test_the_page_runs_and_renders_what_it_says(notebook: dict[str, Any]) -> None:
    picture, view = notebook["picture"], notebook["view"]
    assert picture.rgb.shape == (80, 120, 3)
    assert picture.rgb.dtype == np.uint8
    assert picture.depth_m.shape == picture.classes.shape == picture.coverage.shape == (80, 120)
    assert 0 < np.nanmedian(picture.depth_m) < 100
    same = notebook["fitted"].render(view.camera, view.world_from_cam, view.time_s)
    assert (same.rgb != picture.rgb).mean() > 0.2  # two metres aside looks different
    assert notebook["depth_m"].shape == (1, 80, 120)


def test_a_render_in_memory_is_the_render_of_the_command(notebook: dict[str, Any]) -> None:
    stored = mudg.read_observations(notebook["folder"] / "views" / "front_shift+2.0")
    view = stored[0].view
    picture = notebook["fitted"].render(view.camera, view.world_from_cam, view.time_s)
    assert np.abs(picture.rgb / 255 - stored[0].rgb.permute(1, 2, 0).numpy()).max() <= 1 / 255
    both = np.isfinite(picture.depth_m) & np.isfinite(stored[0].depth[0].numpy())
    assert both.any()
    assert np.allclose(picture.depth_m[both], stored[0].depth[0].numpy()[both], rtol=1e-3)


def test_objects_can_be_removed_and_moved(notebook: dict[str, Any]) -> None:
    fitted, view = notebook["fitted"], notebook["view"]
    assert fitted.method == "street_gaussians"
    name = fitted.object_ids[0]
    gone = fitted.without(name)
    assert name not in gone.object_ids
    assert len(gone) < len(fitted)
    pose = fitted.object_pose(name, view.time_s)
    moved = fitted.moved(name, yaw_matrix(0.0, (3.0, 0.0, 0.0)))
    assert np.allclose(moved.object_pose(name, view.time_s), pose @ yaw_matrix(0.0, (3.0, 0.0, 0.0)), atol=1e-5)
    assert np.array_equal(fitted.object_pose(name, view.time_s), pose)  # the original stays
    assert fitted.object_pose(name, view.time_s + 1e4) is None
    refused("no dynamic object", fitted.without, "nobody", raises=UsageError)
    refused("not rigid", fitted.moved, name, np.diag([2.0, 1, 1, 1]))
    refused("rigid", fitted.render, view.camera, np.zeros((4, 4)), view.time_s)


def test_verbs_check_settings_as_the_command_does(notebook: dict[str, Any], tmp_path: Path) -> None:
    folder = notebook["folder"]
    with pytest.raises(UsageError, match="unknown configuration key voxel"):
        mudg.fuse(folder / "scene", out=tmp_path / "x", voxel=0.1)
    refused("not valid", mudg.fuse, folder / "scene", out=tmp_path / "x", voxel_m=-1, raises=UsageError)
    with pytest.raises(UsageError, match="unknown configuration key loss"):
        mudg.fit(folder / "scene", folder / "fused", out=tmp_path / "x", loss={"nonsense": 1})
    assert not (tmp_path / "x").exists()
    assert mudg.fuse(folder / "scene", out=folder / "fused") == folder / "fused"  # verified and reused
    assert mudg.doctor()["problems"] is not None
    assert mudg.read_scene(folder / "scene").frames


def test_what_a_notebook_gets_wrong_is_refused_in_words(notebook: dict[str, Any], tmp_path: Path) -> None:
    scene, view, weight = notebook["folder"] / "scene", notebook["view"], {"loss.ssim_weight": 0.1}
    for said, wrong in (
        ("--views", lambda: mudg.score(scene, ["views"], out=tmp_path / "a")),
        ("--shifts-m", lambda: mudg.run("city", out=tmp_path / "a", shifts_m=2.0)),
        ("--cameras", lambda: mudg.run("city", out=tmp_path / "a", cameras="front")),
        ("--seed", lambda: mudg.run("city", out=tmp_path / "a", seed="x")),
        (r"loss: \{ssim_weight: \.\.\.\}", lambda: mudg.fit(scene, scene, out=tmp_path / "a", **weight)),
        (r"not a mudg\.Camera", lambda: notebook["fitted"].render("front", view.world_from_cam, view.time_s)),
    ):
        refused(said, wrong, raises=UsageError)
    given = {"out": tmp_path / "a", "model": tmp_path / "none"}  # settings may be paths
    refused("no diffusion model here", mudg.synthesize, scene, scene.with_name("fused"), **given)
    assert not (tmp_path / "a").exists()


def test_a_fit_knows_its_scene_until_that_changes(notebook: dict[str, Any], tmp_path: Path) -> None:
    for name in ("scene", "fused", "fit"):
        shutil.copytree(notebook["folder"] / name, tmp_path / "a" / name)
    (tmp_path / "a").rename(tmp_path / "b")  # what lies beside each other may move together
    folder = tmp_path / "b"
    by_fit, by_path = (mudg.read_scene(folder / name) for name in ("fit", "scene"))
    assert [frame.id for frame in by_fit.frames] == [frame.id for frame in by_path.frames]
    views = mudg.render(folder / "fit", out=tmp_path / "views", cameras=("front",), shifts_m=(0.0,), video=False)
    assert store.read_json(views / "run.json")["inputs"].keys() == {"scene", "model"}
    assert mudg.page(folder / "fit", out=tmp_path / "fit.html").is_file()
    assert mudg.page(folder / "fit", out=tmp_path / "fit.html").is_file()
    (notebook["folder"] / "scene").rename(notebook["folder"] / "hidden")
    try:
        shutil.rmtree(folder / "scene")
        with pytest.raises(UsageError, match="is not known, is gone or has changed"):
            mudg.page(folder / "fit", out=tmp_path / "other.html")
        shutil.copytree(folder / "fused", folder / "scene")  # something else at its place
        refused("not a scene", mudg.read_scene, folder / "fit")
    finally:
        (notebook["folder"] / "hidden").rename(notebook["folder"] / "scene")
