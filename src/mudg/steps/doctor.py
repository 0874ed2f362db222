"""``mudg doctor``: what this machine offers, and with a scene, what is wrong with it. Never reaches the network."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.base.errors import plain_lines
from mudg.base.plugins import origin, plugins
from mudg.base.versions import installed, version
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
    problems: list[str] = []
    sections: dict[str, dict[str, str]] = {
        "machine": _machine(),
        "python": {"version": platform.python_version(), "executable": sys.executable, "mudg": version()},
        "torch": _torch(problems),
        "native library": _native(problems),
        "packages": _packages(problems),
        "optional packages": _optional(),
        "plugins": {f"importer {name}": origin(point) for name, point in plugins().items()},
        "video": _video(problems),
        "weights": _weights(problems),
    }
    lines = []
    for title, rows in sections.items():
        lines += [title] if rows else []
        lines += [f"  {name:<18} {value}" for name, value in rows.items()]
    lines.append("")
    lines += [f"problem: {problem}" for problem in problems] or ["everything that the default run needs is here"]
    return {**sections, "problems": problems, "ready": not problems, "text": plain_lines(lines)}


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


def _machine() -> dict[str, str]:
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    rows = {"system": f"{platform.system()} {platform.release()} {platform.machine()}"}
    rows["processors"] = f"{usable} usable of {os.cpu_count()}"
    if {"SC_PHYS_PAGES", "SC_PAGE_SIZE"} <= {*getattr(os, "sysconf_names", {})}:
        rows["memory"] = f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.1f} GiB"
    rows["free disk here"] = f"{shutil.disk_usage(Path.cwd()).free / 2**30:.1f} GiB"
    return rows


def _torch(problems: list[str]) -> dict[str, str]:
    try:
        import torch
    except ImportError as error:
        problems.append(f"torch cannot be imported: {error}; reinstall with pip install 'torch>=2.10,<2.14'")
        return {"version": "missing"}
    return {"version": torch.__version__, "threads": str(torch.get_num_threads()), **_devices()}


def _devices() -> dict[str, str]:
    """A row for every device that `--device` takes, and for each kind that is not here the reason."""
    import torch

    from mudg.base import devices

    rows: dict[str, str] = {"--device auto": f"{devices.usual_device()}"}
    for kind, problem_of in devices.PROBLEMS.items():
        count = torch.cuda.device_count() if kind == "cuda" else 1
        for number in range(max(count, 1)):
            problem = problem_of(number)
            here = torch.device(kind) if kind == "cpu" else torch.device(kind, number)
            name = kind if problem or kind != "cuda" else f"{kind}:{number}"
            rows[f"--device {name}"] = f"no: {problem}" if problem else devices.described(here)
    return rows


def _native(problems: list[str]) -> dict[str, str]:
    from mudg import native

    if native.library() is None:
        problems.append("the native library is not in use: " + native.REMEDY)
    return {"status": native.status().removeprefix("native library: ")}


def _packages(problems: list[str]) -> dict[str, str]:
    rows = {name: installed(name) or "missing" for name in _CORE}
    missing = [name for name, found in rows.items() if found == "missing"]
    if missing:
        problems.append(f"packages are missing: {', '.join(missing)}; reinstall mudg with pip")
    if find_spec("torchvision") is not None:
        rows["torchvision"] = "present but never used; where its build does not fit torch, uninstall it"
    return rows


def _optional() -> dict[str, str]:
    rows = {
        name: found if (found := installed(name)) else f"not installed ({use}; {how})"
        for name, (use, how) in _OPTIONAL.items()
    }
    if installed("gsplat") and find_spec("torch") is not None:
        from mudg.core.raster import gsplat_cuda

        rows["gsplat"] += f"; {gsplat_cuda.status()}"
    return rows


def _video(problems: list[str]) -> dict[str, str]:
    if find_spec("av") is None:
        return {"encoders": "unknown (av is missing)"}
    from mudg.formats.exporters.video import video_encoders

    found = video_encoders()
    if not found:
        problems.append("PyAV has no H.264 encoder: reports will show pictures instead of videos")
    return {"encoders": ", ".join(found) or "none"}


def _weights(problems: list[str]) -> dict[str, str]:
    folder = Path(__file__).resolve().parents[1] / "assets"
    models = sorted({p.parent for p in folder.rglob("*.safetensors")})
    rows = {}
    for model in models:
        size = sum(p.stat().st_size for p in model.rglob("*.safetensors")) / 2**20
        rows[model.name] = f"shipped with mudg, {size:.1f} MiB"
    if not models:
        problems.append("no diffusion model is shipped with this build: train one with mudg learn")
        rows["diffusion model"] = "none found"
    return rows
