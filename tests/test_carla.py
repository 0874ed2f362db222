"""CARLA's sensors drawn by us, asked as CARLA's client asks: carla-canvas's service, encodings and LiDAR model."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_edit import toy
from test_sim import wall

from mudg.base.errors import UsageError
from mudg.gaussians.storage import save_model

canvas = pytest.importorskip("carla_canvas", reason="carla-canvas is not installed (extra carla)")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("runs")
    for name, model in {"wall": wall(), "toy": toy()}.items():
        save_model(model, root / name)
    return {name: root / name for name in ("wall", "toy")}


class Client:
    """Sends what carla-canvas's plug-in sends, to its service, in process."""

    def __init__(self, **options: Any) -> None:
        from carla_canvas.server import load_backend, make_service
        from carla_canvas.v1 import renderer_pb2

        self.pb, self.actors, self.frame = renderer_pb2, [], 0
        self.service = make_service(load_backend("mudg.sim.carla:MudgRenderer", options))

    def ask(self, method: str, request: Any) -> Any:
        def abort(code: Any, details: str) -> None:
            raise RuntimeError(f"{code}: {details}")

        return getattr(self.service, method)(request, SimpleNamespace(abort=abort))

    def load(self) -> Client:
        self.ask("LoadWorld", self.pb.LoadWorldRequest(map_name="Town", episode_id=1))
        return self

    def spawn(self, number: int, kind: str, **attributes: Any) -> None:
        actor = self.pb.Actor(id=number, type_id=kind)
        for name, value in attributes.items():
            actor.attributes.add(id=name, value=str(value))
        self.ask("SpawnSensor", self.pb.SpawnSensorRequest(sensor=actor))

    def measure(self, sensor: int, x: float = 0.0, y: float = 0.0, yaw: float = 0.0, others: Any = ()) -> Any:
        self.frame += 1
        request = self.pb.RenderRequest()
        stamp = request.snapshot.timestamp
        stamp.frame, stamp.elapsed_seconds, stamp.delta_seconds = self.frame, 0.5, 0.1
        me = request.snapshot.actors.add(id=sensor)
        me.transform.location.x, me.transform.location.y, me.transform.location.z = x, y, 1.5
        me.transform.rotation.yaw = yaw
        for number, kind, place, turn in others:
            actor = request.new_actors.add(id=number, type_id=kind)
            box = actor.bounding_box
            box.extent.x, box.extent.y, box.extent.z, box.location.z = 2.0, 0.9, 0.75, 0.75
            state = request.snapshot.actors.add(id=number)
            state.transform.location.x, state.transform.location.y, state.transform.location.z = place
            state.transform.rotation.yaw = turn
        request.sensors.add(sensor_id=sensor, deliver=True)
        return self.ask("Render", request).measurements[0]


def pixels(measurement: Any) -> np.ndarray:
    image = measurement.image
    return np.frombuffer(image.raw_data, np.uint8).reshape(image.height, image.width, 4)


CAMERA = {"image_size_x": 64, "image_size_y": 48, "fov": 70}


def test_the_depth_of_a_wall_in_carlas_encoding(runs: dict[str, Path]) -> None:
    from carla_canvas.encodings import decode_depth

    client = Client(run=str(runs["wall"])).load()
    client.spawn(7, "sensor.camera.depth", **CAMERA)
    depth = decode_depth(pixels(client.measure(7, x=2.0)))
    assert np.median(depth) == pytest.approx(8.0, abs=0.05)
    turned = decode_depth(pixels(client.measure(7, x=2.0, yaw=30.0)))
    middle = turned[22:26, 31:33].mean()
    assert middle == pytest.approx(8.0 / math.cos(math.radians(30)), abs=0.15)
    # turned to the right: the wall recedes to the right
    assert turned[24, 4] < turned[24, 60]


def test_colours_grow_the_way_carla_counts(runs: dict[str, Path]) -> None:
    """The wall's red grows with y to the left, which is CARLA's y to the right mirrored."""
    client = Client(run=str(runs["wall"])).load()
    client.spawn(7, "sensor.camera.rgb", **CAMERA)
    red = pixels(client.measure(7))[..., 2].astype(int)
    assert red[24, 5] > red[24, 32] > red[24, 58]
    # CARLA's y = 5 lies to the right, where the wall is darker
    assert pixels(client.measure(7, y=5.0))[24, 32, 2] < red[24, 32] < pixels(client.measure(7, y=-5.0))[24, 32, 2]


def test_an_object_stands_where_carlas_actor_stands_and_carries_its_id(runs: dict[str, Path]) -> None:
    client = Client(run=str(runs["toy"]), actors={"vehicle.*": "car-1"}, begin_s=0.0).load()
    client.spawn(7, "sensor.camera.instance_segmentation", **CAMERA)
    at = lambda y: pixels(client.measure(7, others=[(300, "vehicle.audi", (12.0, y, 0.0), 0.0)]))
    columns = {}
    for y in (-3.0, 3.0):
        picture = at(y)
        actor = picture[..., 1] + 256 * picture[..., 0].astype(int)
        assert set(np.unique(actor[picture[..., 2] == 14])) <= {0, 300}
        own = actor == 300
        assert own.sum() > 10
        columns[y] = np.nonzero(own)[1].mean()
    focal = 32 / math.tan(math.radians(35))
    for y, column in columns.items():
        assert column == pytest.approx(32 + focal * y / 12.0, abs=3.0)


@pytest.mark.parametrize("kind", ["sensor.lidar.ray_cast", "sensor.lidar.ray_cast_semantic"])
def test_lidars_measure_the_wall(runs: dict[str, Path], kind: str) -> None:
    client = Client(run=str(runs["wall"])).load()
    more = {} if kind.endswith("semantic") else {"dropoff_general_rate": 0, "dropoff_intensity_limit": 0}
    beams = {"channels": 8, "range": 50, "points_per_second": 8000, "rotation_frequency": 10}
    client.spawn(9, kind, **beams, upper_fov=5, lower_fov=-5, **more)
    measured = client.measure(9, x=1.0)
    sweep, width = (measured.semantic_lidar, 6) if kind.endswith("semantic") else (measured.lidar, 4)
    points = np.frombuffer(sweep.raw_data, np.float32).reshape(-1, width)
    ahead = points[np.abs(np.arctan2(points[:, 1], points[:, 0])) < 0.6]
    assert len(ahead) > 40
    assert np.abs(ahead[:, 0] - 9.0).max() < 0.2
    if width == 6:
        assert set(np.frombuffer(ahead[:, 5].tobytes(), np.uint32)) == {14}


@pytest.mark.parametrize(
    "options, told",
    [
        ({}, "no run"),
        ({"run": "x", "rum": 1}, "rum"),
        ({"origin": [[1, 0], [0, 1]]}, "origin"),
        ({"actors": {"vehicle.*": "tank"}}, "tank"),
    ],
)
def test_wrong_options_are_named(runs: dict[str, Path], options: dict[str, Any], told: str) -> None:
    from carla_canvas import WorldInfo

    from mudg.sim.carla import MudgRenderer

    if options and "rum" not in options:
        options = {"run": str(runs["toy"]), **options}
    with pytest.raises(UsageError, match=told):
        MudgRenderer(options).load_world(WorldInfo("Town", 1, {}))
