"""Labels from geometry: exact on made-up streets up to stated shares, honest about what cannot be told."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toy_scene import CAR_SIZE_M, ToyStreet

from mudg.base import geometry
from mudg.base.errors import ResourceError, UsageError
from mudg.base.geometry import yaw_matrix
from mudg.base.palette import ID, UNLABELLED
from mudg.base.run_folder import RunDir
from mudg.base.types import EgoPath, Ref, Source, Sweep
from mudg.core.depth import ray_elevation
from mudg.labels import annotate
from mudg.labels.annotate import LABELLERS, nearest_sweeps, steady_bottom
from mudg.labels.inputs import LabelInput, Labels, Prediction, box_outline, find_sky, label_by_network
from mudg.labels.settings import AnnotateConfig
from mudg.networks.folders import CPU
from mudg.scene.check import check_scene
from mudg.scene.labels import read_label
from mudg.scene.read import read_image, read_points, read_scene
from mudg.scene.write import SceneWriter
from mudg.steps.ingest import Annotate

STREET = ToyStreet(car_start=(11, 1.0), car_velocity=(2, 0))


def given_at(
    street: ToyStreet, time_s: float = 0.0, *, lidar: bool = True, boxes: bool = True
) -> tuple[LabelInput, np.ndarray]:
    """What the labeller sees, and the true classes."""
    view = street.view(time_s)
    rgb, ids, _ = street.image(view)
    pose, points, _ = street.sweep(time_s)
    world = geometry.transform_points(pose, points.xyz) if lidar else np.zeros((0, 3), np.float32)
    path = np.stack([street.world_from_ego(t)[:3, 3] for t in street.times])
    tracks = [street.track()] if boxes and street.car_start is not None else []
    return LabelInput(view, rgb, world, tracks, path), ids


def overlap(found: np.ndarray, truth: np.ndarray, *names: str) -> float:
    """Intersection over union of a group of classes where something was said."""
    ids = [ID[name] for name in names]
    a, b = np.isin(found, ids), np.isin(truth, ids)
    said = found != UNLABELLED
    return float((a & b & said).sum() / ((a | b) & said).sum())


def labelled(given: LabelInput, truth: np.ndarray) -> Labels:
    """What rules add to the true classes."""
    return label_by_network(given, truth.astype(np.uint8), np.ones(truth.shape, np.float32))


def test_depth_and_sky_around_given_classes_agree_with_the_truth() -> None:
    given, classes = given_at(STREET)
    labels = labelled(given, classes)
    assert set(labels.arrays(depth=False, dynamic=False)) == {"semantics", "semantics_confidence", "sky"}
    assert overlap(np.where(labels.sky, ID["sky"], 0), classes, "sky") > 0.95
    _, _, truth = STREET.image(given.view)
    sure = (labels.depth_confidence > 0.6) & ~labels.sky
    assert sure.mean() > 0.3 and np.isfinite(truth[sure]).mean() > 0.99
    sure &= np.isfinite(truth)
    error = np.abs(labels.depth[sure] - truth[sure]) / truth[sure]
    assert np.median(error) < 0.01 and (labels.depth[labels.sky] == 100).all()
    assert (labels.depth_confidence[np.isnan(labels.depth)] == 0).all()
    blind = labelled(*given_at(STREET, lidar=False))
    assert np.isnan(blind.depth[~blind.sky]).all()


# --- parts ----------------------------------------------------------------------------------------


def test_box_outline_covers_the_projected_box_exactly() -> None:
    view = STREET.view(0.0)
    for x, y, yaw in ((12, 1, 0.4), (3.5, -1.5, 0.0), (30, 6, 2.0)):  # the second begins behind the near plane
        pose = yaw_matrix(yaw, (x, y, 0.8))
        outline = box_outline(view, pose, CAR_SIZE_M)
        street = ToyStreet(car_start=(x, y), wall_x=1e6)
        object.__setattr__(street, "world_from_car", lambda _t, p=pose: p)
        _, ids, _ = street.image(view)
        assert (outline == (ids == ID["car"])).mean() > 0.999
    assert box_outline(view, yaw_matrix(0, (-9, 0, 0.8)), CAR_SIZE_M) is None
    assert box_outline(view, yaw_matrix(0, (5, 80, 0.8)), CAR_SIZE_M) is None


def test_elevation_of_rays_and_sky_above_the_horizon() -> None:
    view, pitch = STREET.view(0.0), np.eye(4)
    pitch[1:3, 1:3] = [[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]]
    elevation, pitched = ray_elevation(view), ray_elevation(replace(view, world_from_cam=view.world_from_cam @ pitch))
    row, column = view.camera.height // 2, view.camera.width // 2
    assert elevation[row - 1].min() > 0 > elevation[row].max()
    assert pitched[row, column] == pytest.approx(elevation[row, column] + 0.1, abs=1e-3)
    rgb = np.full((60, 80, 3), 220, np.uint8)
    elevation = np.repeat(np.linspace(0.5, -0.5, 60)[:, None], 80, 1).astype(np.float32)
    # returns from column 50 on
    away_px = np.repeat(np.maximum(50.0 - np.arange(80), 0)[None], 60, 0).astype(np.float32)
    sky = find_sky(rgb, elevation, away_px, 6.0)
    assert sky[:28, :48].all()  # grown up to the returns, not into them
    assert not sky[:, 49:].any() and not sky[31:].any()


# --- the stage ------------------------------------------------------------------------------------


def test_stage_makes_a_labelled_scene_and_leaves_the_given_one_alone(tmp_path: Path) -> None:
    street = replace(STREET, times=(0.0, 0.3))
    plain = street.write(tmp_path / "plain", labels=False, width=160, height=80)
    contents = lambda: {p: p.read_bytes() for p in (tmp_path / "plain").rglob("*") if p.is_file()}
    files, config = contents(), AnnotateConfig(ego=True)
    out = Annotate(scene=tmp_path / "plain", out=tmp_path / "labelled", settings=config).run()
    scene, made = read_scene(out), annotate.wanted_labels(config) | {"semantics_confidence", "depth_confidence"}
    assert files == contents() and made > {"semantics", "sky", "depth", "dynamic", "ego"}
    for frame, before in zip(scene.frames, plain.frames, strict=True):
        assert frame.id == before.id and (read_image(scene, frame) == read_image(plain, before)).all()
        assert set(frame.labels) == made
        _, truth, depth = street.image(frame.view)
        assert overlap(read_label(scene, frame, "semantics"), truth, "road") > 0.9
        found, car = read_label(scene, frame, "dynamic").astype(bool), truth == ID["car"]
        assert (found & car).sum() / (found | car).sum() > 0.75  # movers are carried and marked
        assert np.median(np.abs(read_label(scene, frame, "depth")[car] / depth[car] - 1)) < 0.02
    assert (read_points(scene, scene.sweeps[1]).xyz == read_points(plain, plain.sweeps[1]).xyz).all()
    assert dict(scene.split) == dict(plain.split) and any("not truth" in note for note in scene.source.notes)
    assert not [f for f in check_scene(out) if f.level == "error"] and list((out / "pictures").glob("*.jpg"))
    assert "not truth" in (out / "labels.html").read_text() and not (out / "labelled").exists()


def test_a_scene_with_labels_passes_through_and_one_with_images_only_is_labelled(tmp_path: Path) -> None:
    given = STREET.write(tmp_path / "given")
    settings = AnnotateConfig(dynamic=False)
    scene = read_scene(Annotate(scene=tmp_path / "given", out=tmp_path / "out", settings=settings).run())
    for frame, before in zip(scene.frames, given.frames, strict=True):
        assert set(frame.labels) == set(before.labels)
        assert (read_label(scene, frame, "semantics") == read_label(given, before, "semantics")).all()
        assert np.array_equal(read_label(scene, frame, "depth"), read_label(given, before, "depth"), equal_nan=True)
    assert not any("not truth" in note for note in scene.source.notes)
    street = ToyStreet(times=(0.0,))
    with SceneWriter(tmp_path / "s", "one image", Source("toy", "none")) as writer:
        view = street.view(0.0)
        writer.add_camera(view.camera)
        writer.add_frame("front/000000", view, street.image(view)[0])
        writer.set_ego(EgoPath(np.zeros(1), np.eye(4)[None]))
        writer.finish()
    scene = read_scene(Annotate(scene=tmp_path / "s", out=tmp_path / "new", settings=AnnotateConfig()).run())
    assert overlap(read_label(scene, scene.frames[0], "semantics"), street.image(view)[1], "sky") > 0.9


def test_an_interrupted_run_goes_on_and_ends_the_same(tmp_path: Path) -> None:
    replace(STREET, times=(0.0, 0.1, 0.2)).write(tmp_path / "plain", labels=False, width=96, height=48)
    config = AnnotateConfig(device="cpu")
    whole = Annotate(scene=tmp_path / "plain", out=tmp_path / "whole", settings=config).run()
    plain = read_scene(tmp_path / "plain")
    step = Annotate(scene=tmp_path / "plain", out=tmp_path / "begun", settings=config)
    begun = RunDir.open(step.out, step.output(), step.key_settings(), step.inputs())
    first, aside, made = [frame.id for frame in plain.frames[:2]], tmp_path / "begun" / "labelled", []
    assert list(annotate.label_into_staging(config, plain, first, aside)) == first
    stamps = lambda: [annotate.staged_labels(aside, name).stat().st_mtime_ns for name in first]
    before, real = stamps(), annotate.label_into_staging
    begun.pause()

    def watched(*args: object) -> Iterator[str]:
        assert stamps() == before
        for name in real(*args):
            made.append(name)
            yield name

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(annotate, "label_into_staging", watched)
        again = step.run()
    assert made == [frame.id for frame in plain.frames[2:]]
    for path in sorted((whole / "labels").rglob("*.*")):
        assert path.read_bytes() == (again / path.relative_to(whole)).read_bytes()


def test_depth_without_lidar_is_not_asked_of_a_network(tmp_path: Path) -> None:
    given, classes = given_at(STREET, lidar=False)
    labels = labelled(given, classes)
    network = lambda _: pytest.fail("asked")
    assert annotate.with_network(network, given, labels, "front/000000", tmp_path) is labels
    assert (tmp_path / "front" / "000000.filled.json").is_file()


def test_sweeps_nearest_in_time_are_chosen() -> None:
    sweeps = [Sweep(f"lidar/{n:06d}", "lidar", 0.1 * n, np.eye(4), Ref("x")) for n in range(20)]
    assert [s.time_s for s in nearest_sweeps(sweeps, 0.96, 4)] == pytest.approx([0.8, 0.9, 1.0, 1.1])
    assert [s.time_s for s in nearest_sweeps(sweeps, 3.85, 6)] == pytest.approx([1.9])
    assert nearest_sweeps(sweeps, 9.0, 6) == []


def test_depth_comes_from_the_network_where_it_fits_the_lidar(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One frame's network answers an affine map of the true depth, the other's nonsense: the one is used, the other
    counted."""
    street = replace(STREET, times=(0.0, 0.1))
    plain = street.write(tmp_path / "plain", labels=False, width=96, height=48)
    depth = street.image(plain.frames[0].view)[2]
    truth = np.minimum(depth, 100).astype(np.float32)
    answers = iter([0.02 * truth + 3, np.full((48, 96), 7, np.float32)])
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "config.json").write_text('{"model_type": "depth_anything"}')
    network = lambda given: Prediction(next(answers), "depth")
    monkeypatch.setattr(annotate, "load_depth_network", lambda *_: network)
    config = AnnotateConfig(depth_network=str(tmp_path / "weights"), processes=1)
    scene = read_scene(Annotate(scene=tmp_path / "plain", out=tmp_path / "out", settings=config).run())
    plain_config = AnnotateConfig(processes=1)
    by_points = read_scene(Annotate(scene=tmp_path / "plain", out=tmp_path / "filled", settings=plain_config).run())
    first, second = (read_label(scene, frame, "depth") for frame in scene.frames)
    sky = read_label(scene, scene.frames[0], "sky").astype(bool)
    assert np.median(np.abs(first / truth - 1)[~sky & np.isfinite(depth)]) < 1e-2 and (first[sky] == 100).all()
    assert np.array_equal(second, read_label(by_points, by_points.frames[1], "depth"))
    (note,) = [note for note in scene.source.notes if note.startswith("depth of 2 frames")]
    assert "network 'depth_anything' in folder 'weights' (sha256 " in note and "1 of them, where it did not fit" in note
    assert not list((tmp_path / "out").rglob("*.filled.json"))
    (tmp_path / "weights" / "model.safetensors").write_bytes(b"other weights")
    with pytest.raises(UsageError, match="depth_network"):
        Annotate(scene=tmp_path / "plain", out=tmp_path / "out", settings=config).run()


def test_what_labellers_and_depth_networks_need_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="contradicts"):
        annotate.digests(AnnotateConfig(depth=False, depth_network="x"))
    with pytest.raises(ResourceError, match="weights"):
        annotate.digests(AnnotateConfig(depth_network=str(tmp_path)))
    assert set(annotate.digests(AnnotateConfig())) == {"weights"}
    with pytest.raises(ResourceError, match="weights"):
        LABELLERS["network"](str(tmp_path / "nothing"), CPU)


def test_bonnet_is_what_stays_the_same() -> None:
    rng = np.random.default_rng(3)
    grey = rng.uniform(60, 200, (12, 60, 90))
    bonnet = np.zeros((60, 90), bool)
    bonnet[48:, 20:70] = True
    grey[:, bonnet] = rng.uniform(60, 200, bonnet.sum()) + rng.normal(0, 1, (12, bonnet.sum()))
    found = steady_bottom(grey)
    assert (found & bonnet).sum() / (found | bonnet).sum() > 0.85
    assert not steady_bottom(rng.uniform(60, 200, (12, 60, 90))).any()
