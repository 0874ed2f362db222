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
from typing import Annotated, Any

from mudg.base.errors import plain_lines
from mudg.base.memory import free_bytes, in_words
from mudg.base.versions import installed, origin, plugins, version
from mudg.steps.step import Flag, Step


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

    encoders: list[str] = []
    if find_spec("av") is not None:
        from mudg.formats.exporters.video import video_encoders

        encoders = video_encoders()
    shipped: Counter[str] = Counter()  # bytes of models
    for file in (Path(__file__).resolve().parents[1] / "assets").rglob("*.safetensors"):
        shipped[file.parent.name] += file.stat().st_size
    packages = {name: installed(name) or "missing" for name in _CORE}
    missing = [name for name, found in packages.items() if found == "missing"]
    rows_of_torch = _torch()
    checks = (
        (not missing, f"packages are missing: {', '.join(missing)}; reinstall mudg with pip"),
        (len(rows_of_torch) > 1, "torch cannot be imported; reinstall with pip install 'torch>=2.10,<2.14'"),
        (native.library() is not None, f"the native library is not in use: {native.REMEDY}"),
        (encoders, "PyAV has no H.264 encoder: reports will show pictures instead of videos"),
        (shipped, "no diffusion model is shipped with this build: train one with mudg learn"),
    )
    problems = [problem for fine, problem in checks if not fine]
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
        "weights": {name: f"shipped with mudg, {in_words(size)}" for name, size in sorted(shipped.items())},
    }
    if installed("gsplat") and len(rows_of_torch) > 1:
        from mudg.core.raster import gsplat_cuda

        sections["optional packages"]["gsplat"] += f"; {gsplat_cuda.status()}"
    lines = []
    for title, rows in sections.items():
        lines += [title] if rows else []
        lines += [f"  {name:<18} {value}" for name, value in rows.items()]
    told = [f"problem: {problem}" for problem in problems] or ["everything that the default run needs is here"]
    lines += ["", *told]
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


def report_scene(scene: Path) -> dict[str, Any]:
    """What is wrong or odd about a scene directory, that of a run, or a log in the neutral layout, as plain values;
    ``text`` is the same for people; ``exit_code`` is 3 if it cannot be used. Of a sound scene, ``alignment`` tells for
    each camera whether LiDAR and image edges agree."""
    from mudg.editing.runs import scene_of_run
    from mudg.formats.importers import RECOGNISERS
    from mudg.formats.importers.custom import check_log
    from mudg.scene import check
    from mudg.scene.check import Finding, check_scene, worst_first
    from mudg.scene.read import read_scene

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
        for name, one in check.camera_alignment(read_scene(scene)).items():
            alignment[name], text = check.to_json(one), check.describe(name, one)
            if one.verdict == "doubtful":
                found = [*found, Finding("warning", f"camera {name}", text.partition(": ")[2])]
            else:
                agreements.append(text)
        found = worst_first(found)
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
