"""``mudg page``: a fitted scene as a page that anyone can open. ``mudg view``: the same page from a server on this
machine, with exact frames where the camera rests. What pages are made of: ``viewer/page``, ``assets/viewer``."""

from __future__ import annotations

import hashlib
import io
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import torch
from PIL import Image
from pydantic import Field

from mudg.base import log, store
from mudg.base.config import result_settings
from mudg.base.errors import InputError, UsageError
from mudg.base.plain_yaml import LARGEST_BYTES
from mudg.base.records import Number, StrictRecord, parse_record
from mudg.base.run_folder import ResultFile, refuse_overlap
from mudg.base.types import Camera, FusedCloud, Scene, View
from mudg.core.edit import HeightMap
from mudg.core.pictures import class_colors, depth_colors, to_bytes
from mudg.core.raster.rasterize import drawing_device
from mudg.core.table import Table
from mudg.diffusion.condition import InWeather
from mudg.diffusion.views import JobInputs
from mudg.editing.apply import (
    FACT,
    Drawer,
    EditedDrive,
    carry_out,
    drawer,
    ground_of,
    in_weather,
    left_behind,
    street_left,
    weather_of,
)
from mudg.editing.model import motion_of
from mudg.editing.render import RenderMixer, check_as_recorded
from mudg.editing.runs import RunParts, find_run
from mudg.editing.script import EditScript, conditions_of, parse_edits, read_edits
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import RigidNode, SkyNode
from mudg.gaussians.storage import load_model, model_of_scene
from mudg.scene.clouds import read_fused
from mudg.scene.read import read_scene
from mudg.viewer import page as pages
from mudg.viewer.page import CHUNK, ONE_FILE_BYTES, Packed, PageFile, ViewerPage, begin_of, key_rows
from mudg.viewer.report import FAR_M, NEAR_M
from mudg.viewer.server import SiteServer, show, token_for
from mudg.viewer.settings import PageConfig, ViewConfig

PAGE_IMAGE_PX, LIVE_IMAGE_PX = 320, 640
"""Width of recorded images on a page of one file, and on one that a server shows."""
NAMES: Final = {"mudg_s": "with diffusion", "street_gaussians": "without diffusion"}


@dataclass(frozen=True, slots=True)
class Shown:
    """What a page shows: the log, one or two fits to it by name, and its fused points, where they are known."""

    scene: Scene
    fits: tuple[tuple[str, SceneModel], ...]
    cloud: FusedCloud | None = None

    def ground(self) -> HeightMap | None:
        """What edited objects stand on; None where it is not known."""
        try:
            return ground_of(self.cloud, self.fits[0][1])
        except InputError:  # it spans too large an area
            return None


def run_page(
    config: PageConfig,
    run: Path,
    out: Path,
    *,
    scene: Path | None = None,
    compare: Path | None = None,
    report: str = "",
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write the page of a run or a fit. ``run``: a folder of ``mudg run``, or of ``mudg fit`` with ``scene``.
    ``compare``: another run or fit of the same log. ``report``: address of the run's report, relative to the page.
    Returns ``page``, the file (of a folder, its ``index.html``), ``bytes`` of everything, ``gaussians`` on the page,
    and ``text``. UsageError: another page is there, or the output is an input. InputError: no fitted scene, or another
    log."""
    out, run = Path(out), Path(run)
    # beside a run's report it overwrites nothing that was read
    beside = out.resolve().parent == run.resolve() and not (run / "model.json").is_file()
    refuse_overlap(out, {"run": None if beside else run, "scene": scene, "compare": compare})
    if out.suffix != ".html":
        raise UsageError("the page is an HTML file", where="--out", expected="a name that ends in .html", got=str(out))
    folder = out.with_name(f"{out.stem}_page")
    if folder.exists() and not (folder / "index.html").is_file():
        raise UsageError("this folder is not a page", where=str(folder), remedy="choose another --out")
    sources = find_sources(config, run, scene, compare)
    viewer = hashlib.sha256(pages.import_map().encode()).hexdigest()  # a newer viewer makes another page
    settings, inputs = {**result_settings(config), "report": report, "viewer": viewer}, sources.digests()
    with ResultFile.open(out, "page", settings, inputs, forms=(out, folder), overwrite=overwrite) as file:
        if file.complete:
            made, place = file.description(), file.reused()
        else:
            made = write_page(page_of(config, sources.read(), report=report), file.staged(), file.staged(folder))
            form = out if made["page"] == file.staged() else folder
            place = file.finish({"bytes": made["bytes"], "gaussians": made["gaussians"], "inputs": inputs}, form)
    size = f"{made['bytes'] / 1e6:.1f} MB"
    if place == folder:
        place, serve = folder / "index.html", f"python -m http.server --directory {folder.name}"
        size = f"{size}; needs a web server: {serve}"
    text = f"page: {place.resolve()} ({size})"
    return {"page": place, "bytes": made["bytes"], "gaussians": made["gaussians"], "text": text}


def write_page(page: ViewerPage, out: Path, folder: Path) -> dict[str, Any]:
    """Write a page: one file where it is small enough, else a folder, completely or not at all; returns ``page``,
    ``bytes`` and ``gaussians`` of ``run_page``. At most `ONE_FILE_BYTES` of it are held at a time."""
    facts: dict[str, Any] = {}
    made, held, size = page.files(facts), list[PageFile](), 0
    for file in made:
        held.append(file)
        size += len(file.content)
        if size * 4 // 3 > ONE_FILE_BYTES:
            break
    if size * 4 // 3 <= ONE_FILE_BYTES:
        content = page.one_file(held, facts)
        store.atomic_write(out, content)
        return {"page": out, "bytes": len(content), "gaussians": [packed.kept for _, packed in page.scenes]}
    page = replace(page, report=f"../{page.report}") if page.report else page  # the run's report lies beside the folder
    with store.atomic_directory(folder) as place:
        size = 0
        for file in chain(held, made):
            store.write_in_tree(place / file.url, file.content)
            size += len(file.content)
        index = page.html(facts, size)
        store.write_in_tree(place / "index.html", index)
        store.sync_tree(place)
    store.remove(out)
    gaussians = [packed.kept for _, packed in page.scenes]
    return {"page": folder / "index.html", "bytes": size + len(index), "gaussians": gaussians}


@dataclass(frozen=True, slots=True)
class ShownSources:
    """Where the log and the fits of a page lie. fits: (folder, whether it is part of a run). cloud: fused points, where
    they are known."""

    scene: Path
    fits: tuple[tuple[Path, bool], ...]
    cloud: Path | None

    def digests(self) -> dict[str, str]:
        """Digests of everything that is read."""
        named = {"scene": self.scene, "fused": self.cloud}
        named |= {f"fit {number}": folder for number, (folder, _) in enumerate(self.fits)}
        return {name: store.digest(path) for name, path in named.items() if path is not None}

    def read(self) -> Shown:
        """What is there. InputError: it cannot be read, or the fits are of different logs."""
        loaded, fits = read_scene(self.scene), list[tuple[str, SceneModel]]()
        for folder, whole in self.fits:
            model = load_model(folder) if whole else model_of_scene(folder, loaded)
            if (other := model.facts.get("scene", loaded.id)) != loaded.id:
                what = "fits of different logs cannot be compared"
                raise InputError(what, where=str(folder), expected=loaded.id, got=str(other))
            fits.append((str(model.facts.get("method", "fit")), model))
        return Shown(loaded, tuple(fits), None if self.cloud is None else read_fused(self.cloud))


def find_sources(config: PageConfig, run: Path, scene: Path | None, compare: Path | None) -> ShownSources:
    """The log and the fits that a page is to show. InputError: no fitted scene. UsageError: a fit has no scene of its
    own and none was given, or a run no such fit."""
    parts = find_run(run)
    place = scene or parts.scene
    if place is None:
        what, remedy = "the scene of this fit is not known, is gone or has changed", "add --scene FOLDER"
        raise UsageError(what, where=str(run), remedy=f"{remedy}, or give the folder of a run")

    def fit_of(parts: RunParts, method: str) -> tuple[Path, bool]:
        if method and parts.whole and method not in parts.fits:
            raise UsageError("the run has no such fit", where="--method", expected=", ".join(parts.fits), got=method)
        return parts.fits.get(method, parts.model), parts.whole

    name, fits = config.method, [fit_of(parts, config.method)]
    if compare is not None:
        others = find_run(compare)
        if Path(compare).resolve() == Path(run).resolve():
            name = next((n for n, folder in others.fits.items() if folder != fits[0][0]), "")
        fits.append(fit_of(others, name))
    return ShownSources(place, tuple(fits), parts.fused)


def page_of(config: PageConfig, shown: Shown, report: str = "", live: dict[str, Any] | None = None) -> ViewerPage:
    """The page of what is shown."""
    scene, begin = shown.scene, pages.begin_of(shown.scene)
    path = np.stack([frame.view.center_world for frame in scene.frames])
    packed = [(name, pages.pack_scene(model, begin, path, config.budget, CHUNK)) for name, model in shown.fits]
    width = PAGE_IMAGE_PX if live is None else LIVE_IMAGE_PX
    facts = pages.log_facts(scene, shown.fits[0][1].colors, width, config.images).with_ground(shown.ground())
    counted = lambda things, noun: f"{len(things)} {noun}{'' if len(things) == 1 else 's'}"
    about = (
        f"{kept_text(packed[0][1])}, {len(scene.frames)} recorded frames of {counted(scene.cameras, 'camera')},"
        f" {counted(scene.tracks, 'tracked object')}. Places, sizes and colours are rounded for the page. Data:"
        f" {scene.source.dataset}, licence {scene.source.licence}. This page loads nothing from elsewhere and sends"
        " nothing."
    )
    return ViewerPage(
        title=scene.id,
        subtitle=", ".join(f"{name} ({NAMES[name]})" if name in NAMES else name for name, _ in packed),
        about=about,
        report=report,
        scenes=packed,
        log=facts,
        live=live,
    )


def kept_text(packed: Packed) -> str:
    """How many Gaussians a page shows, and what was left out."""
    layout = packed.layout
    faint, cut = layout.given - layout.visible, layout.visible - len(layout.rows)
    lost = f"{100 * layout.lost:.2g} % of what all cover in the recorded views"
    parts = [f"{cut:,} left out for the budget, {lost}"] if cut else []
    parts += [f"{faint:,} too faint to be drawn"] if faint else []
    return f"{len(layout.rows):,} Gaussians" + (f" of {layout.given:,} ({'; '.join(parts)})" if parts else "")


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


class EditRequest(StrictRecord):
    """A script, as ``assets/viewer/edits.js`` writes it; ``save`` also writes the file."""

    script: Annotated[str, Field(max_length=LARGEST_BYTES)]
    save: bool = False


@dataclass(slots=True)
class EditDesk:
    """Carries out scripts on what a page shows. ``models``: the fits, on the CPU. ``place``: file to save to.
    ``begin``: the script that the page begins with. ``run``: the finished run that is shown, whose objects a page may
    insert; empty where it is a fit alone."""

    models: Sequence[SceneModel]
    scene: Scene
    cloud: FusedCloud | None
    place: Path
    begin: EditScript | None = None
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
                made = list[SceneModel]()
                for model in self.models:  # closing a street takes seconds, and an object is moved many times
                    key = (id(model), *left_behind(model, drive.plan))
                    if key not in self._streets:
                        kept = _last(self._streets, STREETS * len(self.models) - 1)
                        self._streets = {**kept, key: street_left(model, drive.plan)}
                    made.append(drive.model(model, street=self._streets[key]))
                self._made = {**_last(self._made, KEPT - 1), text: made}
            return self._made[text]

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
        if self.place.exists() and not store.read_bytes(self.place).startswith(MARK.encode()):
            remedy = "start mudg view with another --edits-out"
            raise InputError("the file was not written by mudg view", where=str(self.place), remedy=remedy)
        store.atomic_write(self.place, (MARK + text).encode())
        return self.place


def _last(kept: dict[Any, Any], count: int) -> dict[Any, Any]:
    """The last entries of a dictionary."""
    return dict(list(kept.items())[len(kept) - min(count, len(kept)) :])


def desk_for(
    models: Sequence[SceneModel],
    scene: Scene,
    cloud: FusedCloud | None,
    run: Path,
    script: Path | None = None,
    out: Path | None = None,
) -> EditDesk:
    """What carries out the edits of a page. ``script``: that it begins with. ``out``: where edits are saved (None:
    beside the run). InputError: the script cannot be carried out. UsageError: edits would be saved into a finished
    result."""
    begin = None if script is None else read_edits(script)
    own = str(Path(run).resolve()) if find_run(run).whole else ""
    desk = EditDesk(models, scene, cloud, place_for(run, out), begin, own)
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


@dataclass(slots=True, eq=False)
class FrameSource:
    """Draws frames of one or two fitted scenes, one at a time. ``edited``: the scenes with a script carried out; "" =
    as they are. ``scene``: the log; its recorded views tell the light of the drive, where a script asks for other
    weather or light. ``widest``: pixels of the widest frame. ``mixers``: by number of the scene, what repairs frames of
    it as it was fitted."""

    edited: Callable[[str], Sequence[SceneModel]]
    scene: Scene
    widest: int
    device: torch.device
    mixers: Sequence[RenderMixer] = ()
    _edits: str | None = None
    _models: list[SceneModel] = field(default_factory=list)
    """The scenes with the script ``_edits`` carried out, on the device."""
    _weather: dict[int, InWeather] = field(default_factory=dict)
    """Of the scenes that were asked for in colour, by their number."""
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def png(self, asked: object) -> tuple[bytes, str]:
        """The frame of a ``FrameRequest`` as PNG. InputError: a camera that is none, or edits that cannot be carried
        out."""
        request, content = parse_record(FrameRequest, asked, "request"), io.BytesIO()
        lens = (request.width, request.height, request.fx, request.fy, request.cx, request.cy)
        camera = Camera(request.camera or "free", *lens)
        if request.width > self.widest:
            camera = camera.resized(self.widest, max(1, round(request.height * self.widest / request.width)))
        pose = np.eye(4)
        left, _, right = np.linalg.svd(np.array(request.axes, np.float64).T)
        pose[:3, :3] = left @ right  # the nearest rotation: axes come with the rounding of a browser's sums
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
            self._models = [model.to(self.device) for model in self.edited(request.edits)]
            self._edits, self._weather = request.edits, {}
        index = min(request.scene, len(self._models) - 1)
        model = self._models[index]
        gone = [name for name in request.hidden if name in model.node_names()]
        seen = model if request.camera else over_ground(model)
        draw = drawer(seen.without_nodes(gone) if gone else seen)
        if self.mixers and request.layer != "class" and not gone and not request.edits.strip():
            return lambda view: self.mixers[index](view, draw(view))
        conditions = conditions_of(model.facts.get(FACT, {}).get("script", ()))
        if conditions is None or request.layer != "color":
            return draw
        if index not in self._weather:
            self._weather[index] = weather_of(drawer(model), conditions, self.scene)
        return in_weather(draw, self._weather[index])


# -- served ---


def run_view(
    config: ViewConfig,
    run: Path,
    compare: Path | None = None,
    *,
    scene: Path | None = None,
    edits: Path | None = None,
    edits_out: Path | None = None,
) -> dict[str, Any]:
    """Serve the page of a run until it is interrupted. ``edits``: the script that it begins with. ``edits_out``: where
    edits are saved. UsageError: an address that other machines reach, without a token. ResourceError: the port is
    taken. As ``run_page``."""
    server = server_of(config, run, compare, scene, edits, edits_out)
    host, port = server.server_address[:2]
    address = f"http://{host!s}:{port}/?token={server.token}"
    log.info(f"viewer: {address}   (Ctrl-C ends it)")
    show(address, port, config.browser)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        log.info("viewer: ended")
    finally:
        server.server_close()
    return {"address": address}


def server_of(
    config: ViewConfig,
    run: Path,
    compare: Path | None,
    scene: Path | None,
    edits: Path | None = None,
    edits_out: Path | None = None,
) -> SiteServer:
    """The server of a run's page, listening."""
    token, sources = token_for(config.host, config.token), find_sources(config, run, scene, compare)
    shown, mixers = sources.read(), list[RenderMixer]()
    if config.repair:
        if sources.cloud is None:
            what, remedy = "exact frames are repaired from the clouds of a run", "give the folder of a run"
            raise UsageError(what, where="--repair", got=str(run), remedy=remedy)
        for (folder, _), (_, fitted) in zip(sources.fits, shown.fits, strict=True):
            check_as_recorded(fitted, "--repair")
            mixers.append(RenderMixer(JobInputs(sources.scene, sources.cloud, folder), device=config.device))
    desk = desk_for([model for _, model in shown.fits], shown.scene, shown.cloud, Path(run), edits, edits_out)
    live = {"layers": list(LAYERS), "token": token, "edits": desk.entries(), "place": desk.place.name, "run": desk.run}
    page, facts = page_of(config, shown, live=live), dict[str, Any]()
    served = {file.url: file.content for file in page.files(facts)}
    size = sum(map(len, served.values()))
    served[""] = page.html(facts, size)
    report = Path(run) / "report.html"
    if report.is_file():
        served["report.html"] = store.read_bytes(report)
    device = drawing_device(config.device, "view")
    source = FrameSource(desk.edited, shown.scene, config.width_px, device, mixers)
    return SiteServer(served, {"edits": desk.answer, "frame": source.png}, token, config.host, config.port)
