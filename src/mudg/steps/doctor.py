"""``mudg doctor``: what this machine offers, and with a scene, what is wrong with it. Never reaches the network."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from collections import Counter
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.base.errors import plain_lines
from mudg.base.memory import free_bytes, in_words
from mudg.base.versions import installed, origin, plugins, version
from mudg.steps.step import Flag, Step

if TYPE_CHECKING:
    from mudg.scene.check import Finding


class Doctor(Step):
    """Report what this machine offers, or check a scene or log for errors."""

    examples = ("mudg doctor", "mudg doctor runs/kitti/scene", "mudg doctor --json")
    scene: Annotated[Path | None, Flag("[SCENE]", "first")] = None
    """Scene directory, folder of mudg run, or log in the custom format, to check (not given: report on this
    machine)."""

    def act(self) -> dict[str, Any]:
        return report_scene(self.scene) if self.scene is not None else report_machine()


_CORE = ("numpy", "scipy", "pillow", "safetensors", "pydantic", "pyyaml", "rich", "av", "jinja2")
_OPTIONAL: Mapping[str, tuple[str, str]] = {
    # module: (what it is for, how to get it)
    "pyarrow": ("logs of Argoverse 2 and format 2 of Waymo", "pip install 'mudg[data]'"),
    "transformers": ("networks of annotate from folders", "pip install 'mudg[models]'"),
    "diffusers": ("DepthLab in annotate", "pip install 'mudg[models]'"),
    "gsplat": ("faster rasteriser on CUDA devices", "pip install 'mudg[gsplat]'"),
    "grpcio": ("simulators of mudg serve", "pip install 'mudg[sim]'"),
    "zstandard": ("SPZ files of version 4", "pip install zstandard"),
    "nvidia-ncore": ("recordings of NCore, both ways", "pip install 'mudg[ncore]'"),
    "tensorboard": ("curves of fit and learn --tensorboard", "pip install 'mudg[track]'"),
}


def report_machine() -> dict[str, Any]:
    """Machine, Python, torch, native library, packages, video encoders and weights as plain values; ``text`` is the
    same for people; ``ready``: everything needed is here."""
    from mudg import native

    packages = {name: installed(name) or "missing" for name in _CORE}
    missing = [name for name, found in packages.items() if found == "missing"]
    rows_of_torch, encoders, weights = _torch(), _encoders(), _weights()
    problems = [
        *([f"packages are missing: {', '.join(missing)}; reinstall mudg with pip"] if missing else []),
        *(
            []
            if len(rows_of_torch) > 1
            else ["torch cannot be imported; reinstall with pip install 'torch>=2.10,<2.14'"]
        ),
        *([] if native.library() is not None else [f"the native library is not in use: {native.REMEDY}"]),
        *([] if encoders else ["PyAV has no H.264 encoder: reports will show pictures instead of videos"]),
        *([] if weights else ["no diffusion model is shipped with this build: train one with mudg learn"]),
    ]
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    sections: dict[str, dict[str, str]] = {
        "machine": {
            "system": f"{platform.system()} {platform.release()} {platform.machine()}",
            "processors": f"{usable} usable of {os.cpu_count()}",
            "memory": f"{in_words(free_bytes())} free",
            "free disk here": in_words(shutil.disk_usage(Path.cwd()).free),
        },
        "python": {"version": platform.python_version(), "executable": sys.executable, "mudg": version()},
        "torch": rows_of_torch,
        "native library": {"status": native.status().removeprefix("native library: ")},
        "packages": packages,
        "optional packages": {
            name: installed(name) or f"not installed ({use}; {how})" for name, (use, how) in _OPTIONAL.items()
        },
        "plugins": {f"importer {name}": origin(point) for name, point in plugins().items()},
        "video": {"encoders": ", ".join(encoders) or "none"},
        "weights": weights,
    }
    if installed("gsplat") and len(rows_of_torch) > 1:
        from mudg.core.raster import gsplat_cuda

        sections["optional packages"]["gsplat"] += f"; {gsplat_cuda.status()}"
    lines = []
    for title, rows in sections.items():
        lines += [title] if rows else []
        lines += [f"  {name:<18} {value}" for name, value in rows.items()]
    lines += [
        "",
        *([f"problem: {problem}" for problem in problems] or ["everything that the default run needs is here"]),
    ]
    return {**sections, "problems": problems, "ready": not problems, "text": plain_lines(lines)}


def _torch() -> dict[str, str]:
    """Version, threads, and a row for every device that `--device` takes, or why it is not here."""
    try:
        import torch
    except ImportError:
        return {"version": "missing"}
    from mudg.base import devices

    rows = {"version": torch.__version__, "threads": str(torch.get_num_threads())}
    rows["--device auto"] = devices.usual_device()
    for kind, problem_of in devices.PROBLEMS.items():
        for number in range(max(torch.cuda.device_count(), 1) if kind == "cuda" else 1):
            problem = problem_of(number)
            here = torch.device(kind) if kind == "cpu" else torch.device(kind, number)
            name = kind if problem or kind != "cuda" else f"{kind}:{number}"
            rows[f"--device {name}"] = f"no: {problem}" if problem else devices.described(here)
    return rows


def _encoders() -> list[str]:
    """Encoders of H.264 that PyAV has."""
    if find_spec("av") is None:
        return []
    from mudg.formats.exporters.video import video_encoders

    return video_encoders()


def _weights() -> dict[str, str]:
    """Models that are shipped, and their size."""
    files = (Path(__file__).resolve().parents[1] / "assets").rglob("*.safetensors")
    sizes: Counter[str] = Counter()
    for file in files:
        sizes[file.parent.name] += file.stat().st_size
    return {name: f"shipped with mudg, {in_words(size)}" for name, size in sorted(sizes.items())}


def report_scene(scene: Path) -> dict[str, Any]:
    """What is wrong or odd about a scene directory, that of a run, or a log in the neutral layout, as plain values;
    ``text`` is the same for people; ``exit_code`` is 3 if it cannot be used. Of a sound scene, ``alignment`` tells for
    each camera whether LiDAR and image edges agree."""
    from mudg.editing.runs import scene_of_run
    from mudg.formats.importers import RECOGNISERS
    from mudg.formats.importers.custom import check_log
    from mudg.scene.check import Finding, check_scene, worst_first

    scene = scene if (scene / "scene.json").is_file() else scene_of_run(scene) or scene
    kind = next((name for name, looks_like in RECOGNISERS.items() if looks_like(scene)), "")
    is_log = kind == "custom" and not (scene / "scene.json").is_file()
    found = check_log(scene) if is_log else check_scene(scene)
    if kind and not is_log and not (scene / "scene.json").is_file():
        words = f"this is a log ({kind}), not a scene; make one with `mudg ingest {scene} OUT`"
        found = [Finding("error", str(scene), words)]
    alignment: dict[str, Any] = {}
    agreements: list[str] = []
    if not is_log and not any(f.level == "error" for f in found):
        alignment, agreements, doubts = _alignment(scene)
        found = worst_first([*found, *doubts])
    count = {level: sum(f.level == level for f in found) for level in ("error", "warning", "note")}
    lines = [f"{f.level}: {f.where}: {f.message}" for f in found] + agreements
    if count["error"]:
        lines.append(f"{scene} cannot be used: {count['error']} errors, {count['warning']} warnings")
    else:
        lines.append(f"{scene} can be used: {count['warning']} warnings, {count['note']} notes")
    return {
        "scene": scene,
        "findings": [{"level": f.level, "where": f.where, "words": f.message} for f in found],
        "alignment": alignment,
        "usable": not count["error"],
        "text": plain_lines(lines),
        "exit_code": 3 if count["error"] else 0,
    }


def _alignment(path: Path) -> tuple[dict[str, Any], list[str], list[Finding]]:
    """Records for JSON, sentences about cameras that fit or cannot be judged, and findings about those that do not."""
    from mudg.scene import check as alignment
    from mudg.scene.check import Finding
    from mudg.scene.read import read_scene

    found = alignment.camera_alignment(read_scene(path))
    records = {name: alignment.to_json(one) for name, one in found.items()}
    words = {name: alignment.describe(name, one) for name, one in found.items()}
    doubtful = [name for name, one in found.items() if one.verdict == "doubtful"]
    doubts = [Finding("warning", f"camera {name}", words[name].partition(": ")[2]) for name in doubtful]
    return records, [text for name, text in words.items() if name not in doubtful], doubts
