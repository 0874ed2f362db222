"""``mudg edit`` on fits and whole runs: what it writes is taken by the other commands, bad scripts leave nothing
behind."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from refusals import refused
from toy_world import CAR_SIZE, car_pose, ego_pose

import mudg
from mudg import app
from mudg.base import geometry, store
from mudg.base.errors import UsageError
from mudg.base.palette import ID
from mudg.base.types import Scene
from mudg.diffusion.settings import SynthesizeConfig
from mudg.diffusion.views import recorded_images
from mudg.editing import edit
from mudg.editing.apply import EditedDrive, carry_out, left_behind
from mudg.editing.script import parse_edits
from mudg.editing.settings import EditConfig, RenderConfig
from mudg.gaussians.storage import load_model
from mudg.scene.check import check_scene
from mudg.scene.clouds import read_fused
from mudg.scene.labels import read_label
from mudg.scene.observations import ObservationSet, read_observations
from mudg.scene.read import read_image, read_points, read_scene
from mudg.scene.settings import FuseConfig
from mudg.steps.edit import Edit
from mudg.steps.ingest import Fuse
from mudg.steps.render import RenderViews

FRAMES = 4


@pytest.fixture
def run(street_run: Path) -> Path:
    return street_run


def script(folder: Path, text: str, name: str = "edits.yaml") -> Path:
    store.write_text(folder / name, text)
    return folder / name


def views_of(scene: Path, model: Path, out: Path, edits: Path | None = None) -> ObservationSet:
    settings = RenderConfig(shifts_m=(0.0,), video=False)
    done = RenderViews(scene=scene, model=model, edits=edits, out=out, settings=settings).run()
    return read_observations(done / "front_recorded")


def rendered(scene: Path, model: Path, out: Path, edits: Path | None = None) -> list[torch.Tensor]:
    seen = views_of(scene, model, out, edits)
    return [seen[i].rgb for i in range(len(seen))]


def edited(source: Path, script: Path, out: Path, **more: Any) -> Path:
    return Edit(source=source, script=script, out=out, settings=EditConfig(), **more).run()


def test_an_edited_fit_renders_as_render_with_edits_does(run: Path, tmp_path: Path) -> None:
    lane_change = "- lane_change: {id: ego, left_m: 0.4, start_s: 0, duration_s: 0.8, ground: false}"
    text = f"- move: {{id: car, left_m: 1.5, along_m: 1}}\n{lane_change}"
    edits, model = script(tmp_path, text), run / "fit" / "street_gaussians"
    made = edited(model, edits, tmp_path / "edited", scene=run / "scene")
    before = rendered(run / "scene", model, tmp_path / "a")
    after = rendered(run / "scene", made, tmp_path / "b")
    on_the_way = rendered(run / "scene", model, tmp_path / "c", edits)
    for two, three in zip(after, on_the_way, strict=True):
        assert torch.equal(two, three)
    assert not torch.equal(before[2], after[2])
    views = read_observations(tmp_path / "b" / "front_recorded").views
    old = read_observations(tmp_path / "a" / "front_recorded").views
    offsets = [(geometry.invert(ego_pose(v.time_s)) @ np.r_[v.center_world, 1])[1] for v in views]
    assert offsets[0] == pytest.approx(0.0, abs=1e-6)  # along the vehicle's left
    assert offsets[-1] == pytest.approx(0.4, abs=0.02)
    assert [v.time_s for v in views] == [v.time_s for v in old]


def test_renders_show_weather_and_light(run: Path, tmp_path: Path) -> None:
    """Fog of 20 m: colours come nearer to those of the fog, more so far away; depth and classes stay. An edited fit and
    a script on the way show the same."""
    edits, model = script(tmp_path, "- weather: {fog: {visibility_m: 20}}"), run / "fit" / "street_gaussians"
    plain = views_of(run / "scene", model, tmp_path / "plain")[1]
    foggy = views_of(run / "scene", model, tmp_path / "foggy", edits)[1]
    made = edited(model, edits, tmp_path / "edited", scene=run / "scene")
    again = views_of(run / "scene", made, tmp_path / "again")[1]
    assert torch.equal(foggy.rgb, again.rgb) and not torch.equal(foggy.rgb, plain.rgb)
    assert torch.equal(foggy.depth.nan_to_num(), plain.depth.nan_to_num())
    assert torch.equal(foggy.semantics, plain.semantics)
    solid = torch.isfinite(plain.depth[0]) & (plain.depth[0] > 0)
    far = solid & (plain.depth[0] > plain.depth[0][solid].median())
    spread = lambda seen, where: float(seen.rgb[:, where].std(1).mean())
    assert spread(foggy, far) < 0.7 * spread(plain, far)
    assert spread(foggy, far) / spread(plain, far) < spread(foggy, solid & ~far) / spread(plain, solid & ~far)


def test_an_edited_run_is_one_like_any_other(run: Path, tmp_path: Path) -> None:
    edits = script(tmp_path, "- move: {id: car, along_m: 1, ground: false}")
    out = edited(run, edits, tmp_path / "edited")
    old, new = read_scene(run / "scene"), read_scene(out / "scene")
    assert not [finding for finding in check_scene(out / "scene") if finding.level == "error"]
    step = geometry.yaw_matrix(0.0, (1.0, 0, 0))
    assert np.allclose(new.track("car").world_from_object, old.track("car").world_from_object @ step)
    assert new.source.recipe is None
    for a, b in zip(old.frames, new.frames, strict=True):
        differ = (read_image(old, a) != read_image(new, b)).any(-1)
        assert 0 < differ.mean() < 0.6  # near the car only
        assert read_label(new, b, "semantics").shape == differ.shape
        sky = read_label(new, b, "sky")
        assert np.array_equal(sky, read_label(new, b, "semantics") == ID["sky"])
    half = CAR_SIZE / 2
    for a, b in zip(old.sweeps, new.sweeps, strict=True):
        counts = []
        for scene, sweep, shift in ((old, a, np.eye(4)), (new, b, step)):
            pose = car_pose(sweep.time_s) @ shift
            place = geometry.invert(pose) @ sweep.world_from_lidar
            local = geometry.transform_points(place, read_points(scene, sweep).xyz)
            counts.append(int(((np.abs(local) < half + 0.02).all(1) & (local[:, 2] > 0.15 - half[2])).sum()))
        assert 0.6 * counts[0] < counts[1] < 1.5 * counts[0]  # beams meet it at its new place
    photos = recorded_images(new, SynthesizeConfig())  # what is rendered is no photograph
    for photo, frame in zip(photos, new.frames_in("train"), strict=True):
        assert np.array_equal(~photo.usable, read_label(new, frame, "rendered"))
    assert len(rendered(out / "scene", out / "fit" / "street_gaussians", tmp_path / "render")) == FRAMES
    fused = read_fused(Fuse(scene=out / "scene", out=tmp_path / "fused", settings=FuseConfig()).run())
    assert "car" in fused.objects
    assert read_fused(out / "fuse").objects.keys() == {"car"}
    again = edited(out, script(tmp_path, "- remove: {ids: [car]}", "more.yaml"), tmp_path / "twice")
    assert read_scene(again / "scene").tracks == ()
    assert read_fused(again / "fuse").objects == {}


def test_bad_scripts_leave_nothing(run: Path, tmp_path: Path) -> None:
    model, out = run / "fit" / "street_gaussians", tmp_path / "out"
    too_sharp = "- lane_change: {id: car, left_m: 9, start_s: 0, duration_s: 0.2}"
    for text in ("- mve: {id: car}", "- move: {id: nobody}", too_sharp):
        edits = script(tmp_path, text)
        refused("line 1", edited, model, edits, out)
        refused("line 1", rendered, run / "scene", model, out, edits)
        assert not out.exists()
    refused("input", edited, run, script(tmp_path, "- remove: {ids: [car]}"), run / "edited", raises=UsageError)
    refused("no fitted scene", edited, run / "scene", tmp_path / "edits.yaml", out)
    assert not out.exists()


def test_results_are_reused_refused_and_resumed(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    edits, out = script(tmp_path, "- remove: {class: car}"), tmp_path / "out"

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(edit, "write_edited_scene", stop)
        with pytest.raises(KeyboardInterrupt):
            edited(run, edits, out)
    assert (out / "fuse" / "fuse.json").is_file()
    edited(run, edits, out)
    whole = edited(run, edits, tmp_path / "whole")
    assert store.digest(out) == store.digest(whole)
    stamp = (out / "edit.json").stat().st_mtime_ns
    edited(run, script(tmp_path, "# the same\n- remove: {class: car}"), out)
    assert (out / "edit.json").stat().st_mtime_ns == stamp
    with pytest.raises(UsageError, match="another configuration"):
        edited(run, script(tmp_path, "- stop: {id: car, at_s: 0.2}"), out)
    edited(run, tmp_path / "edits.yaml", out, overwrite=True)
    assert store.read_json(out / "edit.json")["changed"] == ["car"]


def test_objects_go_from_one_run_to_another(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "shelf" / "red.safetensors"
    assert app.main(["asset", "export", str(run), "car", "--out", str(file)]) == 0
    assert mudg.export_asset(run, "car", out=file) == file  # the same again: verified
    assert mudg.export_asset(run / "fit" / "street_gaussians", "car", out=file) == file  # a fit knows its scene
    refused("no dynamic object", mudg.export_asset, run, "nobody", out=tmp_path / "x.safetensors", raises=UsageError)
    text = """
- insert:
    asset: {file: shelf/red.safetensors}
    id: second
    near: {id: ego, at_s: 0, ahead_m: 14, left_m: 2, yaw_deg: 180}
- replace: {id: car, by: {run: RUN, id: car}}
""".replace("RUN", str(run))
    out = tmp_path / "out"
    assert app.main(["edit", str(run), str(script(tmp_path, text)), "--out", str(out), "--quiet"]) == 0
    assert "edited" in capsys.readouterr().out
    scene, fused = read_scene(out / "scene"), read_fused(out / "fuse")
    assert {track.id for track in scene.tracks} == {"car", "second"}
    assert fused.objects.keys() == {"car", "second"}
    pose = scene.track("second").pose_at(0.5)
    assert pose[2, 3] == pytest.approx(CAR_SIZE[2] / 2, abs=0.05)  # on the ground, which is flat
    assert abs(geometry.yaw_of(pose)) == pytest.approx(np.pi, abs=1e-6)
    kinds = {note["kind"] for note in store.read_json(out / "edit.json")["notes"]}
    assert "seldom-seen side" in kinds  # the recording saw its back only


def test_streets_of_recordings_are_closed_and_those_of_generated_cities_stay(run: Path) -> None:
    model, scene = load_model(run / "fit" / "street_gaussians"), read_scene(run / "scene")
    city = replace(scene, source=replace(scene.source, recipe={"seed": 1}))

    def carried(where: Scene | None, text: str = "") -> EditedDrive:
        return carry_out(parse_edits(f"- remove: {{ids: [car]{text}}}", "e"), model, where)

    def closed(where: Scene | None, text: str = "") -> tuple[str, ...]:
        return left_behind(model, carried(where, text).plan)[2]

    assert closed(scene) == ("car",) and closed(city) == closed(None) == ()
    assert closed(scene, ", close_street: false") == () and closed(city, ", close_street: true") == ("car",)
    kinds = lambda drive: [note["kind"] for note in drive.notes]
    assert kinds(carried(None, ", close_street: true")) == ["street not closed"]
    for drive in (carried(None), carried(scene), carried(city, ", close_street: true")):
        assert "street not closed" not in kinds(drive)
    drives = (carried(scene), carried(city), carried(scene, ", close_street: false"))
    rows = [len(drive.model(model).table) for drive in drives]
    assert rows[1] == rows[2] != rows[0]


def test_from_python(run: Path, tmp_path: Path) -> None:
    fitted = mudg.FittedScene.read(run / "fit" / "street_gaussians")
    scene = mudg.read_scene(run / "scene")
    edits = script(tmp_path, "- stop: {id: car, at_s: 0.3}")
    stopped = fitted.edited(edits, scene)
    assert stopped.object_pose("car", 0.9)[0, 3] < fitted.object_pose("car", 0.9)[0, 3] - 0.5
    made = mudg.edit(run / "fit" / "street_gaussians", edits, out=tmp_path / "out", scene=run / "scene")
    view = scene.frames[2].view
    pictures = [
        s.render(view.camera, view.world_from_cam, view.time_s).rgb for s in (stopped, mudg.FittedScene.read(made))
    ]
    assert np.array_equal(*pictures)
    assert fitted.export_asset("car", tmp_path / "car.safetensors", scene).is_file()
