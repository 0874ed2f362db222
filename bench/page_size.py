"""A page of millions of Gaussians: time and memory of making it, its size, and what a browser needs to show it.

    python bench/page_size.py --run runs/demo                     # 3,000,000 Gaussians, made and opened
    python bench/page_size.py --run runs/demo --gaussians 500000 --no-browser

The scene is the fit of a finished run (``mudg demo``), its street laid out again and again along the drive, every copy
perturbed, and driven along in one go. Chromium draws without a graphics card, where it is installed: pictures take
seconds then, and the sorting, the memory and the order of arrival are what is measured.
"""

from __future__ import annotations

import argparse
import functools
import http.server
import json
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from mudg.base.types import Scene
from mudg.core.table import Table
from mudg.gaussians.model import SceneModel
from mudg.viewer import view
from mudg.viewer.settings import PageConfig

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
JITTER_M = 0.05
SORTS = 5


def say(line: str) -> None:
    """One line of the result, at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def memory_mb(name: str, process: int | str = "self") -> float:
    """A line of /proc/PID/status: VmRSS, VmHWM."""
    text = Path(f"/proc/{process}/status").read_text()
    return int(text.split(f"{name}:")[1].split()[0]) / 1024


def long_street(model: SceneModel, scene: Scene, count: int) -> tuple[SceneModel, Scene]:
    """The fit with its static Gaussians repeated along the drive until there are `count`, and the drive through all of
    it."""
    ego = scene.ego.world_from_ego[:, :3, 3]
    step = ego[-1] - ego[0]
    node = model.table.labels["node"]
    still = torch.nonzero(node == 0)[:, 0]
    copies = -(-(count - len(node)) // len(still))
    rng = torch.Generator().manual_seed(0)
    chosen = [still] * (copies - 1) + [
        still[torch.randperm(len(still), generator=rng)[: count - len(node) - (copies - 1) * len(still)]]
    ]
    rows = torch.cat([*chosen, torch.arange(len(node))])
    shift = torch.repeat_interleave(
        torch.arange(1, copies + 2) % (copies + 1), torch.tensor([*map(len, chosen), len(node)])
    )
    order = torch.argsort(node[rows], stable=True)
    rows, shift = rows[order], shift[order]
    columns = {name: value.detach()[rows] for name, value in model.table.columns.items()}
    columns["means"] += shift[:, None] * torch.from_numpy(step).float()
    columns["means"] += JITTER_M * (shift > 0)[:, None] * torch.randn(len(rows), 3, generator=rng)
    table = Table(columns, {name: value[rows] for name, value in model.table.labels.items()})
    span = max(frame.view.time_s for frame in scene.frames) + 0.1
    frames = []
    for copy in range(copies + 1):
        for frame in scene.frames:
            pose = frame.view.world_from_cam.copy()
            pose[:3, 3] += copy * step
            there = replace(frame.view, world_from_cam=pose, time_s=frame.view.time_s + copy * span)
            frames.append(replace(frame, id=f"{frame.id}-{copy}", view=there))
    return replace(model, table=table), replace(scene, frames=tuple(frames), sweeps=())


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of an ordinary web server of a folder."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


SORT = """(async () => {
  const app = window.mudg, loaded = app.loaded[0], view = app.last.view, times = [];
  let before = performance.now(), gap = 0;
  const ticking = setInterval(() => {
    const now = performance.now(); gap = Math.max(gap, now - before); before = now;
  }, 4);
  for (let k = 0; k < SORTS; k++) {
    const poses = loaded.scene.placed(app.state.t, new Set()).rows;
    await loaded.sorter.order({ poses, eye: view.eye, ahead: view.axes[2], near: 0.2 });
    times.push(loaded.sorter.ms);
  }
  clearInterval(ticking);
  const unpack_ms = Math.round(loaded.sorter.unpackMs);
  return JSON.stringify({ sort_ms: times.map(Math.round), blocked_ms: Math.round(gap), unpack_ms });
})()""".replace("SORTS", str(SORTS))


def processes(root: int) -> dict[str, float]:
    """Largest resident memory of a browser's processes by kind, MB."""
    parents, kinds = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int((folder / "stat").read_text().rsplit(")", 1)[1].split()[1])
            words = (folder / "cmdline").read_text().replace("\0", " ").split()
            kinds[int(folder.name)] = next((word[7:] for word in words if word.startswith("--type=")), "")
        except OSError:  # it has ended meanwhile
            continue
    family = {root}
    while more := {pid for pid, parent in parents.items() if parent in family} - family:
        family |= more
    found: dict[str, float] = {}
    for pid in family:
        if kinds.get(pid) in ("renderer", "gpu-process"):
            found[kinds[pid]] = max(found.get(kinds[pid], 0), memory_mb("VmHWM", pid))
    return found


def browse(address: str, size: tuple[int, int], picture: Path | None) -> None:
    """Open a page and say how long what took."""
    from browser import CHROMIUM, Browser

    if CHROMIUM is None:
        say("no Chromium is installed: the page was not opened")
        return
    with tempfile.TemporaryDirectory() as profile:
        browser = Browser(Path(profile), size=size)
        try:
            began = time.monotonic()
            browser.open(address, "document.documentElement?.dataset.firstPictureMs !== undefined", 300)
            first = browser.run(
                "JSON.stringify({ms: Number(document.documentElement.dataset.firstPictureMs), have: mudg.arrival.have})"
            )
            say(f"first picture       {json.loads(first)['ms'] / 1000:.1f} s")
            if picture:
                browser.picture(picture.with_name(picture.stem + "_first.png"))
            browser.wait("document.documentElement.dataset.arrival === 'whole'", 600)
            say(f"all chunks          {time.monotonic() - began:.1f} s")
            browser.wait("mudg.sharp && !mudg.fresh && !mudg.loaded[0].sorter.busy", 300)
            say(
                f"drawn at rest       {browser.run('document.documentElement.dataset.frameMs')} ms per picture, "
                f"{browser.run('mudg.used().left.drawn'):,} Gaussians before the camera"
            )
            told = json.loads(browser.run(SORT))
            say(
                f"sorting             {told['sort_ms']} ms in the worker, a chunk is unpacked in {told['unpack_ms']}"
                f" ms; meanwhile the page was never blocked for more than {told['blocked_ms']} ms"
            )
            heap = browser.call("Runtime.getHeapUsage")
            arrays, most = heap.get("backingStorageSize", 0) / 1e6, processes(browser.process.pid)
            say(
                f"memory of scripts   {heap['usedSize'] / 1e6:.0f} MB and {arrays:.0f} MB of arrays in the page,"
                " without the worker; processes at most:"
                f" {', '.join(f'{kind} {mb:.0f} MB' for kind, mb in most.items())}"
            )
            if picture:
                browser.picture(picture)
            say(f"problems            {browser.errors or 'none'}")
        finally:
            browser.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, help="folder of a finished run")
    parser.add_argument("--gaussians", type=int, default=3_000_000)
    parser.add_argument("--budget", type=int, default=0)
    parser.add_argument("--work", type=Path, help="where the page is written and kept (default: a temporary folder)")
    parser.add_argument("--browser", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--size", type=int, nargs=2, default=(960, 640), help="of the window, pixels")
    parser.add_argument("--picture", type=Path, help="PNG of the page when all has come")
    given = parser.parse_args()
    config = PageConfig(budget=given.budget, images=60)
    shown = view.find_sources(config, given.run, None, None).read()
    name, model = shown.fits[0]
    model, scene = long_street(model, shown.scene, given.gaussians)
    say(
        f"scene               {len(model.table):,} Gaussians, degree {model.sh_degree}, {len(scene.frames)} recorded"
        " frames"
    )
    Path("/proc/self/clear_refs").write_text("5")
    before, began = memory_mb("VmRSS"), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        work = given.work or Path(folder)
        page = view.page_of(config, view.Shown(scene, ((name, model),)))
        laid_out = time.monotonic() - began
        made = view.write_page(page, work / "page.html", work / "page_page")
        say(f"made                in {time.monotonic() - began:.1f} s ({laid_out:.1f} s of it choosing and ordering)")
        say(f"memory              {memory_mb('VmHWM') - before:.0f} MB at most beside the scene's {before:.0f} MB")
        each = made["bytes"] / page.scenes[0][1].kept
        chunks = len(page.scenes[0][1].layout)
        say(f"size                {made['bytes'] / 1e6:.1f} MB in {chunks} chunks, {each:.1f} bytes per Gaussian")
        if given.browser:
            with served(work) as address:
                browse(f"{address}/{Path(made['page']).relative_to(work)}", tuple(given.size), given.picture)


if __name__ == "__main__":
    main()
