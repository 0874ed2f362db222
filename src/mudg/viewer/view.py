"""``mudg page``: a fitted scene as a page that anyone can open. ``mudg view``: the same page from a server on this
machine, with exact frames where the camera rests. The page is ``assets/viewer``; what it is made of, ``viewer/page``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from mudg.base import log, store
from mudg.base.config import result_settings
from mudg.base.errors import InputError, UsageError
from mudg.base.run_folder import ResultFile, refuse_overlap
from mudg.base.types import FusedCloud, Scene
from mudg.core.edit import HeightMap
from mudg.core.raster.rasterize import drawing_device
from mudg.diffusion.views import JobInputs
from mudg.editing.apply import SEED, ground_of
from mudg.editing.render import RenderMixer, check_as_recorded
from mudg.editing.runs import RunParts, find_run
from mudg.gaussians.model import SceneModel
from mudg.gaussians.storage import load_model, model_of_scene
from mudg.scene.clouds import read_fused
from mudg.scene.read import read_scene
from mudg.viewer import page as pages
from mudg.viewer.live import LAYERS, EditFiles, FrameSource, desk_for
from mudg.viewer.page import CHUNK, ONE_FILE_BYTES, Packed, PageFile, ViewerPage
from mudg.viewer.server import Site, SiteServer, open_server, show, token_for
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
    """Write the page of a run or a fit.

    Args:
        run: a folder of ``mudg run``, or of ``mudg fit`` with ``scene``. out: the file to write. compare: another run
            or fit of the same log. report: address of the run's report, relative to the page.

    Returns:
        ``page``: the file (of a folder, its ``index.html``); ``bytes``: of everything; ``gaussians``: on the page;
        ``text``.

    Raises:
        UsageError: another page is there, or the output is an input. InputError: no fitted scene, or another log.
    """
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
    """Write a page: one file where it is small enough, else a folder. At most `ONE_FILE_BYTES` of it are held at a
    time.

    Returns:
        ``page``, ``bytes`` and ``gaussians``, as ``run_page``.
    """
    facts: dict[str, Any] = {}
    made, held = page.files(facts), list[PageFile]()
    for file in made:
        held.append(file)
        if sum(len(one.content) for one in held) * 4 // 3 > ONE_FILE_BYTES:
            path, size = _write_folder(page, folder, held, made, facts)
            store.remove(out)
            break
    else:
        content = page.one_file(held, facts)
        log.info(needs_text(page, "to be written", f"{len(content) / 1e6:.1f} MB"))
        store.atomic_write(out, content)
        path, size = out, len(content)
    return {"page": path, "bytes": size, "gaussians": [packed.kept for _, packed in page.scenes]}


def _write_folder(
    page: ViewerPage, folder: Path, begun: list[PageFile], more: Iterable[PageFile], facts: dict[str, Any]
) -> tuple[Path, int]:
    """Write a page as a folder, file by file, completely or not at all; its ``index.html`` and the bytes of
    everything."""
    page = replace(page, report=f"../{page.report}") if page.report else page  # the run's report lies beside the folder
    # only chunks are many and large, and the first ones tell about all
    chunks = [len(file.content) for file in begun if file.name.count("-") == 2]
    size = sum(len(file.content) for file in begun)
    size += (page.chunks() - len(chunks)) * (sum(chunks) // max(1, len(chunks)))
    log.info(needs_text(page, "to be written", f"about {size / 1e6:.0f} MB in {page.chunks()} chunks"))
    size = 0
    with store.atomic_directory(folder) as place:
        for file in chain(begun, more):
            store.write_in_tree(place / file.url, file.content)
            size += len(file.content)
        index = page.html(facts, size)
        store.write_in_tree(place / "index.html", index)
        store.sync_tree(place)
    return folder / "index.html", size + len(index)


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
    facts = pages.log_facts(scene, shown.fits[0][1].colors, width, config.images)
    facts = pages.with_particles(pages.with_ground(facts, shown.ground()), SEED)
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


def needs_text(page: ViewerPage, out: Path | str, size: str) -> str:
    """What a page takes, before it is written or served."""
    kept = "; ".join(kept_text(packed) for _, packed in page.scenes)
    return (
        f"page {out}: {kept}; {size}; in the browser {page.graphics_bytes() / 1e6:.1f} MB of graphics memory and "
        f"{page.heap_bytes() / 1e6:.1f} MB of memory for sorting"
    )


def run_view(
    config: ViewConfig,
    run: Path,
    compare: Path | None = None,
    *,
    scene: Path | None = None,
    files: EditFiles | None = None,
) -> dict[str, Any]:
    """Serve the page of a run until it is interrupted. ``files``: the script that it begins with, and where edits are
    saved. UsageError: an address that other machines reach, without a token. ResourceError: the port is taken. As
    ``run_page``."""
    server, site = server_of(config, run, compare, scene, files)
    host, port = server.server_address[:2]
    address = f"http://{host!s}:{port}/?token={site.token}"
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
    config: ViewConfig, run: Path, compare: Path | None, scene: Path | None, files: EditFiles | None = None
) -> tuple[SiteServer, Site]:
    """The server of a run's page, listening, and what it serves."""
    token, sources = token_for(config.host, config.token), find_sources(config, run, scene, compare)
    shown, mixers = sources.read(), list[RenderMixer]()
    if config.repair:
        if sources.cloud is None:
            what, remedy = "exact frames are repaired from the clouds of a run", "give the folder of a run"
            raise UsageError(what, where="--repair", got=str(run), remedy=remedy)
        for (folder, _), (_, fitted) in zip(sources.fits, shown.fits, strict=True):
            check_as_recorded(fitted, "--repair")
            mixers.append(RenderMixer(JobInputs(sources.scene, sources.cloud, folder), device=config.device))
    desk = desk_for([model for _, model in shown.fits], shown.scene, shown.cloud, Path(run), files or EditFiles())
    live = {"layers": list(LAYERS), "token": token, "edits": desk.entries(), "place": desk.place.name, "run": desk.run}
    page, facts = replace(page_of(config, shown, live=live), effort=1), dict[str, Any]()  # nothing leaves this machine
    served = {file.url: file.content for file in page.files(facts)}
    size = sum(map(len, served.values()))
    served[""] = page.html(facts, size)
    log.info(needs_text(page, "served", f"{size / 1e6:.1f} MB in {page.chunks()} chunks"))
    report = Path(run) / "report.html"
    if report.is_file():
        served["report.html"] = store.read_bytes(report)
    device = drawing_device(config.device, "view")
    source = FrameSource(desk.edited, shown.scene, config.width_px, device, mixers)
    site = Site(served, {"edits": desk.answer, "frame": source.png}, token)
    return open_server(site, config.host, config.port), site
