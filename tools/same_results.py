"""Proves that a refactor changed nothing: runs the same commands at two commits and compares everything that they leave
behind.

    python tools/same_results.py main~3 main            # all commands, about fifteen minutes on two cores
    python tools/same_results.py main . --only 'fit'    # "." is the working tree; only commands whose name matches

Each side gets a checkout of its own with its own native library, one thread, and the same inputs: driving logs, clips
and toy weights, written by the test suite of the first commit. Compared are, per command: the exit code, what was
printed, and every file below the working folder. A finished result's key of reuse (`run.json`) must be equal, so
results of one commit are reused by the other.

What may differ is named in `VOLATILE` and in `neutral`: times, memory, process numbers and versions of packages.
Exit code: 0 identical, 1 something differs (a table says what and by how much), 2 the comparison could not be made.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import contextlib
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[1]
TIMEOUT_S = 600

# Fields of JSON files that hold a time, a size in memory, a process or a machine.
VOLATILE = re.compile(
    r"(^|_)(seconds|s_per|elapsed|started|finished|"
    r"created|time_spent|wall|cpu|processor|peak|rss|memory|pid|host|hostname|usage|ledger|machine|versions|"
    r"created_at|finished_at|started_at|steps_per_s|fps_reached|took|mudg_version)(_|$)"
)
SKIPPED = re.compile(r"(^|/)(log\.jsonl|.*\.lock|__pycache__(/.*)?)$")
# hold sums of files that hold times; what they seal is compared itself
SEALS = re.compile(r"(^|/)(manifest\.json|run\.json)$")
TEXT = (".json", ".md", ".html", ".txt", ".yaml", ".csv", ".tex")


@dataclass(frozen=True)
class Command:
    """One command line of `same_results.txt`."""

    name: str
    words: list[str]
    stop_after_s: float = 0.0  # interrupt it after so many seconds, once, then repeat it


def commands() -> list[Command]:
    """What is run, in order."""
    rows = []
    for line in Path(__file__).with_suffix(".txt").read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            name, *words = line.split()
            stop_after_s = float(words.pop(0)[1:]) if words and words[0].startswith("@") else 0.0
            rows.append(Command(name, words, stop_after_s))
    return rows


# --- the two sides --------------------------------------------------------------------------------

INPUTS = """
import json, pathlib, sys
from dataclasses import asdict
import numpy as np, torch, yaml
import kitti_folders, roundtrip, toy_clips, toy_published
import write_av2, write_custom, write_kitti360, write_nuplan, write_nuscenes, write_pandaset, write_waymo
from mudg.city import sensors
root = pathlib.Path(sys.argv[1]); logs = root / "logs"; logs.mkdir(parents=True)
truth = roundtrip.small_log(root.parent / "truth")
write_av2.write_av2(truth, logs / "argoverse2")
write_custom.write_log(truth, logs / "custom")
write_kitti360.write_kitti360(truth, logs / "kitti360")
write_nuplan.write_nuplan(truth, logs / "nuplan")
write_nuscenes.write_nuscenes(truth, logs / "nuscenes")
write_pandaset.write_pandaset(truth, logs / "pandaset" / "001")
log = write_waymo.log_of(truth, truth.tracks, beams=sensors.lidar_elevations(roundtrip.SMALL), columns=240)
write_waymo.write(log, "v1", logs / "waymo_v1"); write_waymo.write(log, "v2", logs / "waymo_v2")
kitti_folders.write_raw_drive(logs / "kitti_raw" / "2011_09_26")
kitti_folders.write_odometry(logs / "kitti_odometry"); kitti_folders.write_tracking(logs / "kitti_tracking")
kitti_folders.write_object(logs / "kitti_object")
clips = toy_clips.write_clips(root / "clips"); points = toy_clips.write_clips(root / "points", 32, 32, points=True)
model = toy_published.write_tiny(root)
for name, settings in (
    ("learn", toy_clips.tiny("in/clips")), ("published", toy_published.published_settings("in/model", "in/points"))
):
    (root / f"{name}.yaml").write_text(yaml.safe_dump(json.loads(json.dumps(asdict(settings)))))
edits = root / "edits"; edits.mkdir()
for name, text in {
    "remove": "- remove: {ids: [car-001]}", "move": "- move: {id: car-001, along_m: -2}",
    "lane": "- lane_change: {id: ego, left_m: 1.5, start_s: 0, duration_s: 2}",
    "stop": "- stop: {id: car-001, at_s: 0.1}",
    "speed": "- speed: {id: car-001, factor: 0.5}", "weather": "- weather: {fog: {visibility_m: 40}}",
    "light": "- light: {time: dusk}",
    "wrong_key": "- remove: {idss: [car-001]}", "wrong_id": "- remove: {ids: [car-999]}",
}.items():
    (edits / f"{name}.yaml").write_text(text + "\\n")
(root / "list.txt").write_text("logs/custom name=a\\nlogs/kitti360 name=b\\n")
"""


def environment(checkout: Path) -> dict[str, str]:
    """The environment of every command: this side's sources, one thread, no color, no network proxy."""
    keep = {name: value for name, value in os.environ.items() if not name.startswith(("MUDG_", "PYTHON"))}
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MUDG_THREADS"), "1")
    path = os.pathsep.join((str(checkout / "src"), str(checkout / "tests")))
    return (
        keep
        | threads
        | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1", "NO_COLOR": "1", "COLUMNS": "120", "PYTHONHASHSEED": "0"}
    )


def check_out(commit: str, folder: Path) -> Path:
    """A checkout of the commit ("." = the working tree, uncommitted files included) with its native library."""
    if commit == ".":
        listed = subprocess.run(
            ["git", "ls-files", "-co", "--exclude-standard", "-z"], cwd=REPOSITORY, check=True, capture_output=True
        ).stdout
        for name in filter(None, listed.decode().split("\0")):
            if (REPOSITORY / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(REPOSITORY / name, folder / name)
    else:
        subprocess.run(["git", "clone", "-q", "--shared", "--no-checkout", str(REPOSITORY), str(folder)], check=True)
        subprocess.run(["git", "checkout", "-q", "--detach", resolved(commit)], cwd=folder, check=True)
    return folder


def build(checkout: Path, built: Path | None) -> None:
    """The checkout's native library: that of another checkout where its sources are the same, else compiled."""
    native = [side / "src" / "mudg" / "native" for side in (checkout, built) if side is not None]
    sources = [
        {p.name: p.read_bytes() for p in side.rglob("*") if p.suffix in (".cpp", ".h", ".hpp")} for side in native
    ]
    if built is not None and sources[0] == sources[1]:
        for path in native[1].iterdir():
            if path.is_file() and not (native[0] / path.name).exists():
                shutil.copy2(path, native[0] / path.name)
    else:
        subprocess.run(
            [sys.executable, "build_backend/mudg_build.py", "--inplace"], cwd=checkout, check=True, capture_output=True
        )


def resolved(commit: str) -> str:
    """The full hash of a commit of this repository."""
    return subprocess.run(
        ["git", "rev-parse", f"{commit}^{{commit}}"], cwd=REPOSITORY, check=True, capture_output=True, text=True
    ).stdout.strip()


def write_inputs(checkout: Path, target: Path) -> None:
    """Logs, clips, toy weights and edit scripts, by the tests of the checkout."""
    done = subprocess.run(
        [sys.executable, "-c", INPUTS, str(target)], env=environment(checkout), capture_output=True, text=True
    )
    if done.returncode:
        sys.exit(f"the inputs could not be written by {checkout}:\n{done.stderr}")


@dataclass
class Outcome:
    """What one command left: exit code, both streams, name -> sum of each file that it wrote or changed."""

    code: int
    out: str
    err: str
    files: dict[str, str]
    seconds: float


def run_side(checkout: Path, work: Path, chosen: list[Command], say: str) -> dict[str, Outcome]:
    """All commands of one side, in order."""
    outcomes: dict[str, Outcome] = {}
    before: dict[str, str] = {}
    for command in chosen:
        started = time.perf_counter()
        argv = [sys.executable, "-m", "mudg", *command.words]
        env = environment(checkout)
        if command.stop_after_s:
            interrupted(argv, work, env, command.stop_after_s)
        try:
            done = subprocess.run(
                argv, cwd=work, env=env, capture_output=True, text=True, timeout=TIMEOUT_S, stdin=subprocess.DEVNULL
            )
            code, out, err = done.returncode, done.stdout, done.stderr
        except subprocess.TimeoutExpired:
            code, out, err = -1, "", f"took longer than {TIMEOUT_S} s"
        after = sums(work)
        written = {name: digest for name, digest in after.items() if before.get(name) != digest}
        gone = {name: "removed" for name in before if name not in after}
        before = after
        seconds = time.perf_counter() - started
        outcomes[command.name] = Outcome(code, told(out, work), told(err, work), written | gone, seconds)
        print(f"{say} {command.name}: exit {code}, {len(written)} files, {seconds:.1f} s", file=sys.stderr, flush=True)
    return outcomes


def interrupted(argv: list[str], work: Path, env: dict[str, str], after_s: float) -> None:
    """Start the command and send it Ctrl-C after a while; it must leave something that the repeated command resumes."""
    process = subprocess.Popen(
        argv, cwd=work, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL
    )
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(after_s)
    process.send_signal(signal.SIGINT)
    process.wait(120)


def told(text: str, work: Path) -> str:
    """Printed text without the folder and without numbers of seconds, bytes and processes."""
    text = text.replace(str(work), "WORK")
    text = re.sub(r"\d+(\.\d+)? ?(seconds|s|ms|min|MB|MiB|GB|GiB|kB)\b", "N", text)
    return "\n".join(
        line.rstrip() for line in re.sub(r"\d+:\d\d(:\d\d)?", "N", text).splitlines() if "resum" not in line
    )


# --- what is compared -----------------------------------------------------------------------------


def sums(work: Path) -> dict[str, str]:
    """Relative name -> SHA-256 of the neutral content of every file below the folder, inputs left out."""
    digests = {}
    for path in sorted(work.rglob("*")):
        name = path.relative_to(work).as_posix()
        if path.is_file() and not path.is_symlink() and not name.startswith("in/") and not SKIPPED.search(name):
            digests[name] = hashlib.sha256(neutral(path, work)).hexdigest()
    return digests


def neutral(path: Path, work: Path) -> bytes:
    """The file's bytes without what may differ between two runs of one commit."""
    data = path.read_bytes()
    if SEALS.search(path.as_posix()) or path.suffix == ".json":
        with contextlib.suppress(ValueError):
            value = json.loads(data)
            if path.name == "manifest.json":
                return json.dumps(sorted(names_of(value))).encode()
            if path.name == "run.json" and isinstance(value, dict):
                value = {name: value.get(name) for name in ("verb", "key", "state", "settings", "inputs", "files")}
            return json.dumps(without_volatile(value), sort_keys=True).replace(str(work), "WORK").encode()
    if path.suffix in TEXT:
        return told(data.decode("utf-8", "replace"), work).encode()
    return data


def names_of(value: Any) -> list[str]:
    """Names of the files that a manifest lists."""
    listed = value.get("files", value) if isinstance(value, dict) else value
    return [str(name) for name in listed]


def without_volatile(value: Any) -> Any:
    """JSON without fields of times, memory and machines."""
    if isinstance(value, dict):
        return {name: without_volatile(item) for name, item in value.items() if not VOLATILE.search(name)}
    return [without_volatile(item) for item in value] if isinstance(value, list) else value


def differences(name: str, left: Outcome, right: Outcome, works: tuple[Path, Path]) -> list[str]:
    """What differs, a line each."""
    lines = []
    if left.code != right.code:
        lines.append(f"exit code {left.code} -> {right.code}")
    for stream in ("out", "err"):
        a, b = getattr(left, stream), getattr(right, stream)
        if a != b:
            pairs = zip(a.splitlines() + [""] * 999, b.splitlines() + [""] * 999, strict=False)
            first = next(((x, y) for x, y in pairs if x != y), ("", ""))
            lines.append(f"std{stream}: {first[0][:160]!r} -> {first[1][:160]!r}")
    for file in sorted(left.files.keys() | right.files.keys()):
        a, b = left.files.get(file), right.files.get(file)
        if a != b:
            lines.append(
                f"{file}: "
                + (
                    "only before"
                    if b is None
                    else "only after"
                    if a is None
                    else how_much(works[0] / file, works[1] / file)
                )
            )
    return lines


def how_much(left: Path, right: Path) -> str:
    """By how much two files differ: largest difference of tensors or pixels, or the first differing place."""
    if not (left.is_file() and right.is_file()):
        return "removed meanwhile"
    try:
        if left.suffix == ".safetensors":
            from safetensors.numpy import load_file

            a, b = load_file(left), load_file(right)
            if a.keys() != b.keys():
                return f"tensors {sorted(a.keys() ^ b.keys())[:4]}"
            worst = max(((tensor_distance(a[key], b[key]), key) for key in a), default=(0.0, "only the header"))
            return f"{worst[1]} differs by up to {worst[0]:.3g}"
        if left.suffix in (".png", ".jpg"):
            import numpy as np
            from PIL import Image

            return (
                "pixels differ by up to"
                f" {tensor_distance(np.asarray(Image.open(left)), np.asarray(Image.open(right))):.3g} levels"
            )
    except (OSError, ValueError) as error:
        return f"not comparable: {error}"
    if left.suffix in TEXT:
        a, b = (re.split(r"(?<=[,\n])", path.read_text(errors="replace")) for path in (left, right))
        pairs = [
            (x.strip(), y.strip())
            for x, y in zip(a, b, strict=False)
            if x != y and not VOLATILE.search(x.partition(":")[0].strip(' "'))
        ]
        return (
            f"{len(pairs)} places, first {pairs[0][0][:80]!r} -> {pairs[0][1][:80]!r}"
            if pairs
            else f"{len(a)} -> {len(b)} places"
        )
    return f"{left.stat().st_size} -> {right.stat().st_size} bytes"


def tensor_distance(a: Any, b: Any) -> float:
    """Largest absolute difference; infinite where shapes differ."""
    if a.shape != b.shape:
        return float("inf")
    return float(abs(a.astype("float64") - b.astype("float64")).max()) if a.size else 0.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("before", help="commit, or . for the working tree")
    parser.add_argument("after", help="commit, or . for the working tree")
    parser.add_argument(
        "--only",
        default="",
        help="run only commands whose name matches this expression (what they read must be among them)",
    )
    parser.add_argument("--work", type=Path, help="keep both sides in this new folder (default: a temporary one)")
    options = parser.parse_args()
    chosen = [command for command in commands() if re.search(options.only, command.name)]
    with contextlib.ExitStack() as stack:
        root = options.work or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="same_results.")))
        root.mkdir(parents=True, exist_ok=options.work is None)
        sides = []
        for side, commit in (("before", options.before), ("after", options.after)):
            (root / side).mkdir()
            sides.append(check_out(commit, root / side / "checkout"))
            build(sides[-1], sides[0] if len(sides) > 1 else None)
        write_inputs(sides[0], root / "in")
        works = (root / "before" / "work", root / "after" / "work")
        for work in works:
            work.mkdir()
            shutil.copytree(root / "in", work / "in")
        with concurrent.futures.ThreadPoolExecutor(2) as pool:
            runs = [
                pool.submit(run_side, checkout, work, chosen, say)
                for checkout, work, say in zip(sides, works, ("before", "after "), strict=True)
            ]
            before, after = (run.result() for run in runs)
        changed = 0
        for command in chosen:
            lines = differences(command.name, before[command.name], after[command.name], works)
            changed += bool(lines)
            for line in lines:
                print(f"{command.name}: {line}")
        seconds = [sum(outcome.seconds for outcome in side.values()) for side in (before, after)]
        print(f"{len(chosen)} commands, {changed} differ; {seconds[0]:.0f} s before, {seconds[1]:.0f} s after")
        print("identical" if not changed else "not identical")
    return 1 if changed else 0


if __name__ == "__main__":
    sys.exit(main())
