"""Classes that people gave to LiDAR points: kept by scenes, copies and fusion, and where they fall in an image."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import roundtrip
from toy_scene import TRAIN_IDS, ToyStreet

from mudg.base import palette
from mudg.base.errors import InputError
from mudg.base.types import EgoPath, Photo, Scene, Source, SweepPoints
from mudg.core.fusion import FusionRules, SweepShots, fuse_sweeps
from mudg.labels.settings import AnnotateConfig
from mudg.scene.read import read_points, read_scene
from mudg.scene.write import SceneWriter
from mudg.steps.ingest import Annotate

pytestmark = roundtrip.needs_native
PARKED = ToyStreet(panel_x=9.0, car_start=(12.0, 4.0))


def classed(street: ToyStreet, time_s: float) -> tuple[np.ndarray, SweepPoints]:
    """Pose and points of a sweep with the true classes."""
    pose, points, kind = street.sweep(time_s)
    return pose, replace(points, classes=TRAIN_IDS[kind])


def write(street: ToyStreet, root: Path) -> Scene:
    """The street without labels of images, its points with classes."""
    with SceneWriter(root, "toy", Source("toy", "none")) as writer:
        writer.add_camera(street.view(0.0).camera)
        for index, time_s in enumerate(street.times):
            view = street.view(time_s + 0.02)
            writer.add_frame(f"front/{index:06d}", view, street.image(view)[0])
            writer.add_sweep(f"lidar/{index:06d}", "lidar", time_s, *classed(street, time_s))
        writer.add_track(street.track([0.0, 1.0]))
        times = np.array(street.times)
        writer.set_ego(EgoPath(times, np.stack([street.world_from_ego(t) for t in times])))
        return writer.finish()


def test_scenes_and_copies_keep_classes_and_scenes_without_have_none(tmp_path: Path) -> None:
    scene = write(PARKED, tmp_path / "scene")
    expected = classed(PARKED, 0.1)[1].classes
    assert expected is not None and (read_points(scene, scene.sweeps[1]).classes == expected).all()
    Annotate(scene=tmp_path / "scene", out=tmp_path / "labelled", settings=AnnotateConfig()).run()
    labelled = read_scene(tmp_path / "labelled")
    assert "semantics" in labelled.frames[0].labels
    assert (read_points(labelled, labelled.sweeps[1]).classes == expected).all()
    (tmp_path / "scene" / "manifest.json").unlink()  # the copy is then made from arrays, not from bytes
    with SceneWriter(tmp_path / "copy", "copy", scene.source) as writer:
        writer.copy_all_but_frames(scene)
        for frame in scene.frames:
            writer.copy_frame(scene, frame)
        copy = writer.finish()
    assert (read_points(copy, copy.sweeps[1]).classes == expected).all()
    plain = PARKED.write(tmp_path / "plain")
    assert read_points(plain, plain.sweeps[0]).classes is None


@pytest.mark.parametrize(
    ("classes", "words"),
    [
        (np.array([3, 19], np.uint8), "no train id"),
        (np.array([3], np.uint8), "shape"),
        (np.array([3, 4], np.int64), "uint8"),
    ],
)
def test_wrong_classes_are_refused(tmp_path: Path, classes: np.ndarray, words: str) -> None:
    none = np.zeros(2, np.float32)

    def add(writer: SceneWriter) -> None:
        points = SweepPoints(np.ones((2, 3), np.float32), none, none, classes)
        writer.add_sweep("top/000000", "top", 0.0, np.eye(4), points)

    with SceneWriter(tmp_path / "s", "s", Source("t", "n")) as made, pytest.raises(InputError) as caught:
        add(made)
    assert words in f"{caught.value.what} {caught.value.expected} {caught.value.got}"


def fused_classes(classes_for: str, labels: bool) -> tuple[np.ndarray | None, np.ndarray]:
    """Classes in the fused cloud, and the true ones by place: the car's points are those in its box."""
    street = PARKED

    def sweeps():
        for time_s in street.times:
            pose, points = classed(street, time_s)
            assert points.classes is not None
            given = {"all": points.classes, "none": None}.get(
                classes_for, np.full_like(points.classes, palette.UNLABELLED)
            )
            view = street.view(time_s)
            rgb, ids, _ = street.image(view)
            wrong = np.full_like(ids, palette.ID["bicycle"])
            yield SweepShots(
                time_s, pose, replace(points, classes=given), [Photo(view, rgb, wrong if labels else None)]
            )

    cloud, _ = fuse_sweeps(sweeps(), [street.track([0.0, 1.0])], FusionRules())
    local = cloud.static.xyz - np.array([12.0, 4.0, 0.8], np.float32)
    return cloud.static.semantics, (np.abs(local) < [2.01, 1.01, 0.75]).all(1)


def test_fused_clouds_carry_the_classes_of_points_before_those_of_images() -> None:
    for labels in (False, True):
        semantics, car = fused_classes("all", labels)
        assert car.sum() > 100 and (semantics[car] == palette.ID["car"]).all()
        assert palette.ID["bicycle"] not in semantics
    semantics, _ = fused_classes("unlabelled", labels=True)
    assert semantics is not None and (semantics == palette.ID["bicycle"]).all()
    assert fused_classes("none", labels=False)[0] is None
