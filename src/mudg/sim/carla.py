"""A reconstruction as the renderer of CARLA's sensors, through carla-canvas (``pip install 'mudg[carla]'``).

    renderer:
      backend: mudg.sim.carla:MudgRenderer
      options: {run: mudg_demo, actors: {hero-lead: car-001}}

carla-canvas makes CARLA's cameras, LiDAR, semantic LiDAR and ROS 2 topics of what is drawn here. Options: ``run`` and
``edits`` as for ``Session``; ``origin``: pose 4x4 of the map's right-handed frame in the scene's (default: the same);
``begin_s``: time of the scene's clock at which the episode begins (default: the log's first); ``actors``: role name or
pattern of blueprint names -> object of the scene that is drawn in an actor's place, each once. Without ``actors``,
objects move as they were recorded.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from carla_canvas import CameraFrame, CameraView, Renderer, WorldInfo
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.errors import UsageError
from mudg.base.palette import CLASSES, UNLABELLED
from mudg.sim.optics import Pinhole
from mudg.sim.session import CameraRequest, Instant, Layer, Session

OPTIONS: Final = ("run", "edits", "origin", "begin_s", "actors", "device", "lidar_pixels_per_degree")
LABELS: Final = dict(zip(CLASSES, range(1, 20), strict=True))
"""Class -> ``carla.CityObjectLabel``."""
TO_LABEL: Final = np.zeros(256, np.uint8)
TO_LABEL[: len(CLASSES)] = [LABELS[name] for name in CLASSES]
TO_LABEL[UNLABELLED] = 0
LAYER_OF: Final[dict[str, Layer]] = {"rgb": "rgb", "depth": "depth", "semantic": "classes", "instance": "instances"}


class MudgRenderer(Renderer):
    """Draws what CARLA's cameras see in a reconstruction; see the module for its options."""

    name = "mudg"
    version = "1"
    camera_outputs = frozenset(LAYER_OF)
    coordinate_frame = "right_handed"

    def load_world(self, world: WorldInfo) -> None:
        """Load the run that the options name, whatever the map is called. UsageError: an unknown or missing option, or
        an object that the scene does not have. As ``Session``."""
        unknown = sorted(set(self.options) - set(OPTIONS))
        if unknown or "run" not in self.options:
            got = ", ".join(unknown) or "no run"
            raise UsageError("an option is not known", where="renderer.options", expected=", ".join(OPTIONS), got=got)
        run, edits = world.resolve(self.options["run"]), self.options.get("edits")
        self.session = Session(run, world.resolve(edits) if edits else None, device=self.options.get("device", "auto"))
        self.scene_from_map = np.array(self.options.get("origin", np.eye(4)), np.float64)
        problem = geometry.rigid_problem(self.scene_from_map) if self.scene_from_map.shape == (4, 4) else "no 4x4"
        if problem:
            raise UsageError("no pose", where="renderer.options.origin", expected="a rigid 4x4", got=problem)
        self.begin_s = float(self.options.get("begin_s", self.session.time_range_s[0]))
        self.actors: dict[str, str] | None = self.options.get("actors")
        known = self.session.sizes_m()
        missing = sorted(set(self.actors.values()) - set(known)) if self.actors else []
        if missing:
            expected, got = ", ".join(sorted(known)) or "none", ", ".join(missing)
            raise UsageError("no such object", where="renderer.options.actors", expected=expected, got=got)

    def render_camera(self, view: CameraView) -> CameraFrame:
        """The layers that are asked for; where there is no surface depth is infinite."""
        camera = view.camera
        pose = self.scene_from_map @ geometry.invert(view.world_to_camera_cv())
        objects, actor_of = self._objects(view)
        optics = Pinhole(camera.width, camera.height, camera.focal, camera.focal, camera.width / 2, camera.height / 2)
        layers: tuple[Layer, ...] = tuple(LAYER_OF[name] for name in sorted(view.outputs))
        start = Instant(self.begin_s + view.scene.elapsed_seconds, pose, objects)
        (reply,) = self.session.render([CameraRequest(optics=optics, start=start, layers=layers)])
        frame, drawn = CameraFrame(), reply.layers
        if "rgb" in drawn:
            frame.rgb = drawn["rgb"]
        if "depth" in drawn:
            depth = drawn["depth"]
            frame.depth = np.where(np.isfinite(depth) & (depth <= view.max_depth), depth, np.float32(np.inf))
        if "classes" in drawn:
            frame.semantic = TO_LABEL[drawn["classes"]]
        if "instances" in drawn:
            ids = np.array([0, *(actor_of.get(name, 0) for name in reply.objects)], np.uint32)
            frame.actor_id = ids[drawn["instances"]]
        return frame

    def _objects(self, view: CameraView) -> tuple[dict[str, NDArray[np.float64]] | None, dict[str, int]]:
        """Poses of the scene's objects where actors stand for them, and the actors' ids by object."""
        if self.actors is None:
            return None, {}
        poses: dict[str, NDArray[np.float64]] = {}
        actor_of: dict[str, int] = {}
        for info, _ in sorted(view.scene.bodies(exclude=set(view.ignore_actors)), key=lambda body: body[0].id):
            role = info.attributes.get("role_name", "")
            matches = (name for key, name in self.actors.items() if key == role or info.matches(key))
            name = next((name for name in matches if name not in poses), None)
            if name is not None:
                centre = np.eye(4)
                x, y, z = info.bounding_box.location
                centre[:3, 3] = (x, -y, z)
                poses[name] = self.scene_from_map @ view.actor_matrix(info.id) @ centre
                actor_of[name] = info.id
        return poses, actor_of
