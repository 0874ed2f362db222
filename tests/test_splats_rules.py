"""Rules of KHR_gaussian_splatting and ParticleField3DGaussianSplat, as validators check them; motion."""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import splat_readers as slow
import toy_splats
from PIL import Image
from toy_scene import ToyStreet

from mudg.base import geometry
from mudg.formats.splats import gltf, usd
from mudg.formats.splats.cloud import SplatScene
from mudg.formats.splats.formats import file_from_world

PREFIX = "KHR_gaussian_splatting:"


def moment(scene: SplatScene, time_s: float) -> np.ndarray:
    """Places of all Gaussians at a time, sorted, in the axes of the file."""
    return ordered(scene.at(time_s).means)


def ordered(places: np.ndarray) -> np.ndarray:
    return np.asarray(places)[np.lexsort(np.round(np.asarray(places, np.float64), 3).T)]


def posed(cloud: list[slow.Splat], translation: np.ndarray, wxyz: np.ndarray) -> np.ndarray:
    pose = geometry.from_rotation_translation(geometry.matrix_from_quaternion(wxyz), translation)
    return geometry.transform_points(pose, np.array([s.place for s in cloud]))


def at_time(times: list[float], values: np.ndarray, time_s: float, turns: bool = False) -> np.ndarray:
    """What players make of keys: linear, or slerp for quaternions; the first and last value beyond them."""
    after = int(np.clip(np.searchsorted(times, time_s), 1, len(times) - 1))
    u = float(np.clip((time_s - times[after - 1]) / (times[after] - times[after - 1]), 0, 1))
    a, b = values[after - 1], values[after]
    return geometry.slerp(a, b, u) if turns else (1 - u) * a + u * b


def check_gltf(content: bytes) -> None:
    """What a validator would say of a GLB file."""
    document, data = slow.open_glb(content)
    assert document["asset"]["version"] == "2.0" and "KHR_gaussian_splatting" in document["extensionsUsed"]
    assert document["buffers"] == [{"byteLength": len(data) - (-document["buffers"][0]["byteLength"] % 4)}]
    ends = 0
    for view in document["bufferViews"]:
        assert view["byteOffset"] >= ends
        ends = view["byteOffset"] + view["byteLength"]
    assert ends <= len(data)
    animations, primitives = document.get("animations", []), [p for m in document["meshes"] for p in m["primitives"]]
    used = {index for primitive in primitives for index in primitive["attributes"].values()}
    used |= {s[side] for a in animations for s in a["samplers"] for side in ("input", "output")}
    assert used == set(range(len(document["accessors"])))
    for primitive in primitives:
        check_primitive(document, data, primitive)
    for animation in animations:
        check_animation(document, data, animation)
    for node in document["nodes"]:
        assert abs(np.linalg.norm(node.get("rotation", [0, 0, 0, 1])) - 1) < 1e-6 and min(node.get("scale", [1])) > 0


def check_primitive(document: dict[str, Any], data: bytes, primitive: dict[str, Any]) -> None:
    attributes, kind = primitive["attributes"], primitive["extensions"]["KHR_gaussian_splatting"]
    assert primitive["mode"] == 0 and kind["kernel"] == "ellipse"
    assert kind["colorSpace"] in ("srgb_rec709_display", "lin_rec709_display")
    values = {name: np.array(slow.accessor(document, data, index)) for name, index in attributes.items()}
    assert len({len(rows) for rows in values.values()}) == 1
    place = document["accessors"][attributes["POSITION"]]
    bounds = [values["POSITION"].min(0), values["POSITION"].max(0)]
    assert np.array_equal(np.array([place["min"], place["max"]], np.float32), np.array(bounds, np.float32))
    assert np.abs(np.linalg.norm(values[PREFIX + "ROTATION"], axis=1) - 1).max() < 1e-5
    assert (values[PREFIX + "SCALE"] > 0).all()
    for name in (PREFIX + "OPACITY", "COLOR_0"):
        assert (values[name] >= 0).all() and (values[name] <= 1).all()
    bands = {name for name in attributes if name.startswith(PREFIX + "SH_")}
    degrees = range(int(np.sqrt(len(bands))))
    assert bands == {f"{PREFIX}SH_DEGREE_{d}_COEF_{n}" for d in degrees for n in range(2 * d + 1)}


def check_animation(document: dict[str, Any], data: bytes, animation: dict[str, Any]) -> None:
    targets = [(c["target"]["node"], c["target"]["path"]) for c in animation["channels"]]
    assert len(set(targets)) == len(targets)
    for channel in animation["channels"]:
        sampler, path = animation["samplers"][channel["sampler"]], channel["target"]["path"]
        times = np.array(slow.accessor(document, data, sampler["input"]))[:, 0]
        given = document["accessors"][sampler["input"]]
        values = np.array(slow.accessor(document, data, sampler["output"]))
        assert times[0] >= 0 and (np.diff(times) > 0).all() and len(values) == len(times)
        assert [given["min"][0], given["max"][0]] == [times[0], times[-1]]
        assert path != "rotation" or np.abs(np.linalg.norm(values, axis=1) - 1).max() < 1e-6
        assert path != "scale" or ((values > 0).all() and sampler["interpolation"] == "STEP")


@pytest.mark.parametrize(("degree", "time_s"), [(0, None), (2, None), (3, 0.5)])
def test_a_glb_keeps_the_rules(degree: int, time_s: float | None) -> None:
    scene = replace(toy_splats.scene(degree), file_from_world=file_from_world("glb", "viewer"))
    check_gltf(gltf.to_bytes(scene, time_s))


@pytest.mark.parametrize("time_s", [-0.5, -0.1, 0.25, 0.4, 0.9, 1.0])
def test_a_glb_moves_as_the_scene_does(time_s: float) -> None:
    scene = replace(toy_splats.scene(), file_from_world=file_from_world("glb", "viewer"))
    *others, person = scene.nodes
    person = replace(person, cloud=gltf.middle_shape(person), displacement=None)
    stiff = replace(scene, nodes=(*others, person))
    document, data = slow.open_glb(gltf.to_bytes(scene))
    (animation,) = document["animations"]
    played = {tuple(c["target"].values()): animation["samplers"][c["sampler"]] for c in animation["channels"]}
    shown = []
    for index, node in enumerate(document["nodes"]):
        cloud = slow.read_glb_mesh(document, data, node["mesh"])
        now = {"translation": np.zeros(3), "rotation": np.array([0, 0, 0, 1.0]), "scale": np.ones(3)}
        for path in now:
            if (index, path) in played:
                sampler = played[index, path]
                times, values = (np.array(slow.accessor(document, data, sampler[side])) for side in ("input", "output"))
                if path == "scale":
                    now[path] = values[max(0, int(np.searchsorted(times[:, 0], time_s + 0.5 + 1e-9, "right")) - 1)]
                else:
                    now[path] = at_time(times[:, 0].tolist(), values, time_s + 0.5, path == "rotation")
        if now["scale"][0] == 1:
            shown.append(posed(cloud, now["translation"], now["rotation"][[3, 0, 1, 2]]))
    assert np.abs(ordered(np.concatenate(shown)) - moment(stiff, time_s)).max() < 1e-4


def check_usd(prim: dict[str, Any]) -> None:
    """What NVIDIA's and our rules say of a field of particles."""
    count, degree = len(prim["orientations"]), prim["radiance:sphericalHarmonicsDegree"]
    places = list(prim["positions"].values()) if isinstance(prim["positions"], dict) else [prim["positions"]]
    assert {len(prim[name]) for name in ("scales", "opacities")} | {len(place) for place in places} == {count}
    assert len(prim["radiance:sphericalHarmonicsCoefficients"]) == count * (degree + 1) ** 2
    assert prim["_metadata"] == {"elementSize": str((degree + 1) ** 2)}
    assert np.abs(np.linalg.norm(prim["orientations"], axis=1) - 1).max() < 1e-5
    assert np.min(prim["scales"]) > 0 and np.min(prim["opacities"]) >= 0 and np.max(prim["opacities"]) <= 1
    low, high = np.array(prim["extent"])
    reach = 3 * np.max(prim["scales"], 1)[:, None]
    for place in np.array(places):
        assert (place - reach > low - 1e-4).all() and (place + reach < high + 1e-4).all()
    assert (prim["projectionModeHint"], prim["sortingModeHint"]) == ("perspective", "cameraDistance")


@pytest.mark.parametrize(("degree", "time_s"), [(0, None), (3, None), (1, 0.5)])
def test_usd_keeps_the_rules(degree: int, time_s: float | None) -> None:
    stage = slow.parse_usda(usd.to_text(toy_splats.scene(degree), time_s, sky=True).decode())
    assert stage["metadata"]["upAxis"] == '"Z"' and stage["metadata"]["metersPerUnit"] == "1"
    assert stage["metadata"]["defaultPrim"] == '"World"' and stage["World"]["type"] == "Xform"
    nodes = [prim for prim in stage["World"].values() if isinstance(prim, dict) and "splats" in prim]
    assert len(nodes) == (3 if time_s is None else 1)
    for node in nodes:
        assert node["splats"]["type"] == "ParticleField3DGaussianSplat"
        check_usd(node["splats"])


@pytest.mark.parametrize("time_s", [-0.5, -0.1, 0.25, 0.4, 0.9, 1.0])
def test_usd_moves_and_bends_as_the_scene_does(time_s: float) -> None:
    scene = toy_splats.scene()
    stage, shown, code = slow.parse_usda(usd.to_text(scene).decode()), [], time_s * 1000
    for node in (prim for prim in stage["World"].values() if isinstance(prim, dict) and "splats" in prim):
        places = node["splats"]["positions"]
        if isinstance(places, dict):
            places = at_time(list(places), np.array(list(places.values())), code)
        translation, turn = np.zeros(3), np.array([1.0, 0, 0, 0])
        if "xformOp:translate" in node:
            keys = list(node["xformOp:translate"])
            assert node["xformOpOrder"] == ["xformOp:translate", "xformOp:orient"]
            translation = at_time(keys, np.array(list(node["xformOp:translate"].values())), code)
            turn = at_time(keys, np.array(list(node["xformOp:orient"].values())), code, True)
            held = [word for key, word in node["visibility"].items() if key <= code + 1e-6]
            if (held or list(node["visibility"].values()))[-1 if held else 0] == "invisible":
                continue
        shown.append(posed(slow.read_usd_splats(node["splats"], places), translation, turn))
    assert np.abs(ordered(np.concatenate(shown)) - moment(scene, time_s)).max() < 1e-4


def test_a_package_begins_with_its_stage_and_shows_the_sky_where_it_is() -> None:
    scene = toy_splats.scene()
    archive = zipfile.ZipFile(io.BytesIO(usd.to_package(scene)))
    assert archive.namelist() == ["scene.usda", "sky.png"]
    assert {info.compress_type for info in archive.infolist()} == {zipfile.ZIP_STORED}
    dome = slow.parse_usda(archive.read("scene.usda").decode())["World"]["Sky"]
    picture = np.asarray(Image.open(io.BytesIO(archive.read("sky.png"))))
    turn = geometry.matrix_from_quaternion(dome["xformOp:orient"])
    rows, columns = scene.sky.shape[:2]
    for row in range(rows):
        for column in range(columns):  # OpenEXR: longitude from pi to -pi, 0 along z, pi/2 along x
            latitude, longitude = np.pi / 2 - (row + 0.5) / rows * np.pi, np.pi - (column + 0.5) / columns * 2 * np.pi
            d = np.array([np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)])
            x, y, z = turn @ d
            across = int((np.arctan2(y, x) / (2 * np.pi) + 0.5) * columns) % columns
            assert (picture[row, column] == scene.sky[int((0.5 - np.arcsin(z) / np.pi) * rows), across]).all()


def test_cameras_of_a_stage_see_what_ours_see(tmp_path: Path) -> None:
    scene = ToyStreet(times=[0.0, 0.1]).write(tmp_path / "scene", width=24, height=12)
    camera = replace(scene.cameras["front"], cx=10.0, cy=7.5)
    frames = tuple(replace(f, view=replace(f.view, camera=camera)) for f in scene.frames)
    log = replace(scene, cameras={"front": camera}, frames=frames)
    prim = slow.parse_usda(usd.to_text(toy_splats.scene(), log=log).decode())["World"]["camera_front"]
    assert list(prim["xformOp:translate"]) == [0, 100]
    for frame in log.frames:
        code = round(frame.view.time_s * 1000)
        turn = geometry.matrix_from_quaternion(prim["xformOp:orient"][code])
        pose = geometry.from_rotation_translation(turn, prim["xformOp:translate"][code])
        point = (frame.view.world_from_cam @ [0.7, -0.4, 6.0, 1.0])[:3]
        x, y, z = geometry.transform_points(geometry.invert(pose), point[None])[0]
        wide, high = prim["horizontalAperture"], prim["verticalAperture"]
        across = (x / -z * prim["focalLength"] - prim["horizontalApertureOffset"]) / wide + 0.5
        upwards = (y / -z * prim["focalLength"] - prim["verticalApertureOffset"]) / high + 0.5
        found = [across * 24, (1 - upwards) * 12]
        assert np.allclose(found, geometry.project(frame.view, point[None])[0][0], atol=1e-4)


def test_names_and_texts_cannot_break_out_of_a_stage() -> None:
    scene = toy_splats.scene()
    evil = replace(scene.nodes[1], name='x"\n}\ndef "y', label='a\\"b')
    written = usd.to_text(replace(scene, nodes=(scene.nodes[0], evil), facts={"method": '"\n)'}))
    stage = slow.parse_usda(written.decode())
    assert list(stage["World"]) == ["type", "background", "x____def__y"]
    assert stage["World"]["x____def__y"]["mudg:label"] == 'a\\"b'


def test_empty_nodes_do_no_harm() -> None:
    scene = toy_splats.scene()
    nothing = scene.nodes[0].cloud.take(np.zeros(0, int))
    bare = replace(scene, nodes=(replace(scene.nodes[0], cloud=nothing), *scene.nodes[1:]))
    check_gltf(gltf.to_bytes(bare))
    assert slow.parse_usda(usd.to_text(bare).decode())["World"]["background"]["splats"]["positions"] == []
