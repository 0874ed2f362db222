"""Edits and exact frames for the viewer page: what a browser asks for, checked, and drawn by the rasterizer."""

from __future__ import annotations

import io
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field

from mudg.base import store
from mudg.base.errors import InputError, UsageError
from mudg.base.plain_yaml import LARGEST_BYTES
from mudg.base.records import Number, StrictRecord, parse_record
from mudg.base.types import Camera, FusedCloud, Scene, View
from mudg.core.pictures import class_colors, depth_colors, to_bytes
from mudg.core.table import Table
from mudg.diffusion.condition import InWeather
from mudg.editing.apply import (
    FACT,
    Drawer,
    EditedDrive,
    carry_out,
    drawer,
    in_weather,
    left_behind,
    street_left,
    weather_of,
)
from mudg.editing.model import motion_of
from mudg.editing.plan import EditPlan
from mudg.editing.render import RenderMixer
from mudg.editing.runs import find_run
from mudg.editing.script import EditScript, conditions_of, parse_edits, read_edits
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import RigidNode, SkyNode
from mudg.viewer.page import begin_of, key_rows
from mudg.viewer.report import FAR_M, NEAR_M

# -- edits -----------------------------------------------------------------------------------------
#
# Made on the viewer's page: checked and carried out by the functions that ``mudg edit`` uses, and saved as a script.
MARK: Final = "# Edits made in mudg view. For mudg edit, mudg render --edits and mudg view --edits.\n"
"""First line of a saved script; a file without it belongs to somebody else."""
NAME: Final = "edits.yaml"
SEALED: Final = (store.MANIFEST, "run.json", "model.json")
"""A folder that holds one of these is the result of a command: nothing is added to it."""
KEPT: Final = 2
"""Scripts whose edited scenes stay in memory: that of the picture, and the one before."""
STREETS: Final = 3
"""Streets that objects have left, kept in memory for each fit."""


@dataclass(frozen=True, slots=True)
class EditFiles:
    """The script that a page begins with, where edits are saved (None: beside the run), and whether a foreign file may
    be replaced."""

    script: Path | None = None
    out: Path | None = None
    overwrite: bool = False


class EditRequest(StrictRecord):
    """A script, as ``assets/viewer/edits.js`` writes it; ``save`` also writes the file."""

    script: Annotated[str, Field(max_length=LARGEST_BYTES)]
    save: bool = False


@dataclass(slots=True)
class EditDesk:
    """Carries out scripts on what a page shows.

    Args:
        models: the fits, on the CPU. scene, cloud: the log; the cloud may be unknown. begin: the script that the page
            begins with.
        place: file to save to. overwrite: even if it is not one of ours.
        run: the finished run that is shown, whose objects a page may insert; empty where it is a fit alone.
    """

    models: Sequence[SceneModel]
    scene: Scene
    cloud: FusedCloud | None
    place: Path
    begin: EditScript | None = None
    overwrite: bool = False
    run: str = ""
    _planned: dict[str, EditedDrive] = field(default_factory=dict)
    _made: dict[str, list[SceneModel]] = field(default_factory=dict)
    _streets: dict[tuple[object, ...], SceneModel] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _making: threading.Lock = field(default_factory=threading.Lock)

    def entries(self) -> list[dict[str, Any]]:
        """The edits that the page begins with, as [{verb: settings}] with absolute paths: they may be saved
        elsewhere."""
        if self.begin is None:
            return []
        script = parse_edits(self.begin.text(), "edits", Path()) if self.begin.files() else self.begin
        said = lambda settings: settings.model_dump(mode="json", by_alias=True, exclude_unset=True)
        return [{edit.verb: said(edit.settings)} for edit in script.edits]

    def edited(self, text: str) -> list[SceneModel]:
        """The fits with a script carried out; as they are where it is empty. InputError: it cannot be carried out; the
        message names line, verb and field."""
        if not text.strip():
            return list(self.models)
        drive = self._carried(text)
        with self._making:
            if text not in self._made:
                made = [drive.model(model, street=self._street(model, drive.plan)) for model in self.models]
                self._made = {**_last(self._made, KEPT - 1), text: made}
            return self._made[text]

    def _street(self, model: SceneModel, plan: EditPlan) -> SceneModel:
        """What ``street_left`` makes, remembered: closing a street takes seconds, and an object is moved many times."""
        key = (id(model), *left_behind(model, plan))
        if key not in self._streets:
            self._streets = {**_last(self._streets, STREETS * len(self.models) - 1), key: street_left(model, plan)}
        return self._streets[key]

    def _carried(self, text: str) -> EditedDrive:
        """A script carried out on all but the fits; quick."""
        script = parse_edits(text, NAME)  # others need not wait while a long text is read
        with self._lock:
            if text not in self._planned:
                files = {} if self.begin is None else self.begin.files()
                known = {str(path.resolve()) for path in files.values()}
                if foreign := sorted(set(script.files()) - known - {self.run}):
                    what, remedy = "a page may name no files but those of --edits", "write them into the script by hand"
                    raise InputError(what, where=NAME, got=foreign[0], remedy=remedy)
                drive = carry_out(script, self.models[0], self.scene, self.cloud)
                self._planned = {**_last(self._planned, KEPT - 1), text: drive}
            return self._planned[text]

    def answer(self, asked: object) -> tuple[bytes, str]:
        """To an ``EditRequest``, as JSON: what a script does: paths of changed objects, who is gone, notes, the file
        that was saved."""
        request = parse_record(EditRequest, asked, "request")
        said: dict[str, Any] = {"paths": {}, "removed": [], "inserted": [], "notes": [], "saved": None}
        if request.script.strip():
            drive, notes = self._checked(request.script), list[str]()
            if drive.plan.closed and drive.plan.views:
                later = "the first one after some seconds; the page's own picture shows it as it was fitted"
                notes.append(f"exact frames close the street that objects leave (close_street), {later}")
            if drive.plan.moves_ego:
                moved = "mudg render moves them with the vehicle"
                notes.append(f"the recorded cameras of this page stay on the recorded path; {moved}")
            said |= {"paths": self._paths(drive), "removed": list(drive.plan.removed)}
            said |= {"inserted": list(drive.plan.inserted), "notes": [note["text"] for note in drive.notes] + notes}
        if request.save:
            said["saved"] = str(self.save(request.script))
        return store.json_text(said, indent=None).encode(), "application/json"

    def _checked(self, text: str) -> EditedDrive:
        """A script that can be carried out on the fits, too. Streets and sides are closed later, when a frame is asked
        for."""
        drive = self._carried(text)
        if not (drive.plan.closed or drive.plan.sides):
            self.edited(text)
        else:
            for model in self.models:
                drive.model(model, street=street_left(model, drive.plan, close=False))
        return drive

    def _paths(self, drive: EditedDrive) -> dict[str, Any]:
        """Keys of changed objects: ``rows`` as in ``key_rows``, ``source`` the moments of the recording that they
        show."""
        begin = begin_of(self.scene)
        nodes = {node.name: node for node in self.models[0].nodes if isinstance(node, RigidNode)}
        own = [name for name in drive.plan.changes if name in nodes]
        paths = {name: drive.plan.changed(name, motion_of(nodes[name])) for name in own}
        paths |= {name: drive.plan.after.actors[name].motion for name in drive.plan.touched() if name not in paths}
        rows = lambda path: key_rows(path.times_s - begin, path.poses).tolist()
        return {name: {"rows": rows(path), "source": (path.source_s - begin).tolist()} for name, path in paths.items()}

    def save(self, text: str) -> Path:
        """Write the script. InputError: there is nothing to save, or the file belongs to somebody else."""
        if not text.strip():
            raise InputError("there are no edits to save", remedy="hide, move or remove an object first")
        if self.place.exists() and not self.overwrite and not store.read_bytes(self.place).startswith(MARK.encode()):
            remedy = "start mudg view with another --edits-out, or add --overwrite"
            raise InputError("the file was not written by mudg view", where=str(self.place), remedy=remedy)
        store.atomic_write(self.place, (MARK + text).encode())
        return self.place


def _last(kept: dict[Any, Any], count: int) -> dict[Any, Any]:
    """The last entries of a dictionary."""
    return dict(list(kept.items())[len(kept) - min(count, len(kept)) :])


def desk_for(
    models: Sequence[SceneModel], scene: Scene, cloud: FusedCloud | None, run: Path, files: EditFiles
) -> EditDesk:
    """What carries out the edits of a page. InputError: the script cannot be carried out. UsageError: edits would be
    saved into a finished result."""
    begin = None if files.script is None else read_edits(files.script)
    own = str(Path(run).resolve()) if find_run(run).whole else ""
    desk = EditDesk(models, scene, cloud, place_for(run, files.out), begin, files.overwrite, own)
    if begin is not None:
        carry_out(begin, models[0], scene, cloud)
    return desk


def place_for(run: Path, given: Path | None) -> Path:
    """Where edits of a run are saved: the given file, else beside the run, else in the current folder. UsageError: the
    given file lies in the result of a command."""
    sealed = lambda file: any((folder / name).is_file() for folder in file.resolve().parents for name in SEALED)
    if given is not None:
        if sealed(given) or given.is_dir():
            what, expected = "edits are not saved into the result of a command", "a file outside of runs"
            raise UsageError(what, where="--edits-out", got=str(given), expected=expected)
        return given
    beside = Path(run).resolve().parent / NAME
    return Path(NAME) if sealed(beside) else beside


# -- frames ----------------------------------------------------------------------------------------
GROUND: Final = (0.43, 0.43, 0.42)
"""What free views show of uncovered ground; as in `assets/viewer/shaders.js`."""
LAYERS: Final = ("color", "depth", "class")
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]


class FrameRequest(StrictRecord):
    """One frame, as ``assets/viewer/exact.js`` asks for it. ``edits``: a script. ``axes``: the camera's right, down and
    ahead in the world."""

    scene: Annotated[int, Field(ge=0)]
    layer: Literal["color", "depth", "class"]
    hidden: Annotated[list[str], Field(max_length=100_000)]
    edits: Annotated[str, Field(max_length=1_000_000)] = ""
    camera: str
    width: Annotated[int, Field(ge=1, le=8192)]
    height: Annotated[int, Field(ge=1, le=8192)]
    fx: Annotated[Number, Field(gt=0)]
    fy: Annotated[Number, Field(gt=0)]
    cx: Number
    cy: Number
    time_s: Number
    eye: Vector
    axes: Annotated[list[Vector], Field(min_length=3, max_length=3)]


def over_ground(model: SceneModel) -> SceneModel:
    """The scene with grey ground where nothing covers it below the horizon. Its sky reaches there, too, but is right
    from the recorded path only."""
    if model.sky is None:
        return model
    panorama = model.sky.table["panorama"].detach().clone()
    panorama[..., model.sky.rows // 2 :, :] = panorama.new_tensor(GROUND)[:, None, None]
    return replace(model, sky=SkyNode(Table({"panorama": panorama})))


class FrameSource:
    """Draws frames of one or two fitted scenes, one at a time. ``edited``: the scenes with a script carried out; "" =
    as they are. ``scene``: the log; its recorded views tell the light of the drive, where a script asks for other
    weather or light. ``widest``: pixels of the widest frame. ``mixers``: by number of the scene, what repairs frames of
    it as it was fitted."""

    def __init__(
        self,
        edited: Callable[[str], Sequence[SceneModel]],
        scene: Scene,
        widest: int,
        device: torch.device,
        mixers: Sequence[RenderMixer] = (),
    ) -> None:
        self._mixers = mixers
        self._edited, self._scene, self._widest, self._device = edited, scene, widest, device
        self._edits: str | None = None
        self._models: list[SceneModel] = []
        """The scenes with the script ``_edits`` carried out, on the device."""
        self._weather: dict[int, InWeather] = {}
        """Of the scenes that were asked for in colour, by their number."""
        self._lock = threading.Lock()

    def png(self, asked: object) -> tuple[bytes, str]:
        """The frame of a ``FrameRequest`` as PNG. InputError: a camera that is none, or edits that cannot be carried
        out."""
        request, content = parse_record(FrameRequest, asked, "request"), io.BytesIO()
        lens = (request.width, request.height, request.fx, request.fy, request.cx, request.cy)
        camera = Camera(request.camera or "free", *lens)
        if request.width > self._widest:
            camera = camera.resized(self._widest, max(1, round(request.height * self._widest / request.width)))
        pose = np.eye(4)
        pose[:3, :3] = orthonormal(np.array(request.axes, np.float64).T)
        pose[:3, 3] = request.eye
        with self._lock:
            seen = self._drawer(request)(View(camera, pose, float(request.time_s)))
        picture = to_bytes(seen.rgb)
        if request.layer == "depth" and seen.depth is not None:
            picture = depth_colors(seen.depth[0].numpy(), NEAR_M, FAR_M)
        if request.layer == "class" and seen.semantics is not None:
            picture = class_colors(seen.semantics.numpy())
        Image.fromarray(picture).save(content, "PNG", compress_level=1)
        return content.getvalue(), "image/png"

    def _drawer(self, request: FrameRequest) -> Drawer:
        """What draws the scene that is asked for, without what is hidden, in the weather and light of the script."""
        if self._edits != request.edits:
            self._models = [model.to(self._device) for model in self._edited(request.edits)]
            self._edits, self._weather = request.edits, {}
        index = min(request.scene, len(self._models) - 1)
        model = self._models[index]
        gone = [name for name in request.hidden if name in model.node_names()]
        seen = model if request.camera else over_ground(model)
        draw = drawer(seen.without_nodes(gone) if gone else seen)
        if self._mixers and request.layer != "class" and not gone and not request.edits.strip():
            return lambda view: self._mixers[index](view, draw(view))
        conditions = conditions_of(model.facts.get(FACT, {}).get("script", ()))
        if conditions is None or request.layer != "color":
            return draw
        if index not in self._weather:
            self._weather[index] = weather_of(drawer(model), conditions, self._scene)
        return in_weather(draw, self._weather[index])


def orthonormal(axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest rotation: axes come with the rounding of a browser's sums."""
    left, _, right = np.linalg.svd(axes)
    return left @ right
