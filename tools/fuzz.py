"""Throw mutated bytes at every parser of foreign files.

    pip install . atheris
    python tools/fuzz.py --seconds 60 --corpus corpus                              # all parsers, one after the other
    python tools/fuzz.py --parser spz pickle --runs 1000000 --corpus corpus

A parser may answer with a value or with an error of mudg. Any other exception, an input that takes longer than a
second, or more than 1 GiB of memory is a failure: the input stays in CORPUS/failures. Prints a line per parser; the
exit code is the number of failures. The corpus is read again by the next run.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import atheris
import numpy as np

from mudg.base import log

with atheris.instrument_imports(include=["mudg"]):
    from mudg.base import plain_pickle, plain_yaml
    from mudg.base.errors import MudgError
    from mudg.editing.script import parse_edits
    from mudg.formats.importers import clouds, kitti, waymo_logs
    from mudg.formats.splats.cloud import SplatCloud, SplatNode, SplatScene
    from mudg.formats.splats.formats import FORMATS, WriteRequest
    from mudg.scene import schema
    from mudg.sim import lidar as tables

STATS = ("number_of_executed_units", "slowest_unit_time_sec", "peak_rss_mb")
LIMITS = ("-timeout=1", "-rss_limit_mb=1024", "-max_len=4096", "-print_final_stats=1")
HERE = Path(__file__).resolve().parent
SCRATCH = Path(tempfile.gettempdir()) / "mudg_fuzz"


def in_file(read: Callable[[Path], object], ending: str = ".txt") -> Callable[[bytes], object]:
    """A parser that takes a path."""

    def parse(content: bytes) -> object:
        with tempfile.NamedTemporaryFile(suffix=ending, dir=SCRATCH) as file:
            file.write(content)
            file.flush()
            return read(Path(file.name))

    return parse


def records_of(path: Path) -> None:
    """Every record of a TFRecord file, as a frame of Waymo."""
    with path.open("rb") as file:
        for place in waymo_logs.record_places(path):
            waymo_logs.parse_message(waymo_logs.read_payload(file, *place), waymo_logs.FRAME, "input")


def scene_of(content: bytes) -> object:
    """The file scene.json."""
    return schema.parse_scene(schema.parse_object(content, "input"), None, "input", "input")


def matrices_of(content: bytes) -> object:
    """A range image."""
    return waymo_logs.range_image(content, 4, "input")


def splats_by(read: Callable[[bytes, str], object]) -> Callable[[bytes], object]:
    """A reader of Gaussians."""
    return lambda content: read(content, "input")


PARSERS: dict[str, Callable[[bytes], object]] = {
    "pickle": lambda content: plain_pickle.read_pickle(content, "input", plain_pickle.NUMPY_MAKERS),
    "yaml": lambda content: plain_yaml.parse_yaml(content, "input"),
    "edits": lambda content: parse_edits(content, "input"),
    "scene": scene_of,
    "beams": in_file(tables.read_table, ".json"),
    "pcd": lambda content: clouds.read_pcd(content, "input"),
    "cloud-ply": lambda content: clouds.read_ply(content, "input"),
    "npz": lambda content: clouds.read_npz(content, "input"),
    "lzf": lambda content: clouds.lzf_decompress(content, 2000, "input"),
    "waymo": lambda content: waymo_logs.parse_message(content, waymo_logs.FRAME, "input"),
    "range-image": matrices_of,
    "tfrecord": in_file(records_of, ".tfrecord"),
    "calibration": in_file(kitti.read_calibration_text),
    "tracklets": in_file(kitti.read_tracklets, ".xml"),
    "label": in_file(lambda path: kitti.read_label_text(path, np.eye(4))),
    **{
        name: (lambda read: lambda content: read(content, "input"))(one.read)
        for name, one in FORMATS.items()
        if one.read
    },
}
SEEDS: dict[str, list[bytes]] = {
    "pickle": [b"\x80\x04]\x94(K\x01G?\xf0\x00\x00\x00\x00\x00\x00\x8c\x01a\x94e.", b"(lp0\nI1\naF2.5\na."],
    "yaml": [b"a: [1, 2.5, null]\nb: {c: 'x', d: |\n  text\n}\n", b"- &x 1\n- *x\n"],
    "edits": [b"edits:\n- remove: car-1\n- move: {object: car-2, by: [1, 0, 0]}\n"],
    "beams": [b'{"elevations_deg": [-10, 0], "azimuth_step_deg": 1, "range_m": [1, 50], "field_deg": 90}'],
    "scene": [b'{"schema": 1, "name": "x", "cameras": {}, "frames": [], "sweeps": [], "ego": {}}'],
    "pcd": [
        b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\n"
        b"DATA ascii\n1 2 3\n"
    ],
    "cloud-ply": [
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        b"end_header\n1 2 3\n"
    ],
    "calibration": [
        b"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
    ],
    "label": [b"0 1 Car 0.00 0 0.1 1 2 3 4 1.5 1.6 4.0 1.0 1.5 10.0 0.2\n"],
    "tracklets": [b"<boost_serialization><tracklets><count>0</count></tracklets></boost_serialization>"],
}


def seeds_of(name: str) -> list[bytes]:
    """Small valid files to begin with."""
    if name not in FORMATS or FORMATS[name].write is None:
        return SEEDS.get(name, [])
    rng, count = np.random.default_rng(0), 3
    columns = (rng.normal(size=(count, 3)), np.eye(4)[:count], rng.uniform(-5, 0, (count, 3)), rng.normal(size=count))
    columns = (*columns, rng.normal(size=(count, 4, 3)) * 0.1)
    cloud = SplatCloud(*(np.asarray(column, np.float32) for column in columns), None)
    return [FORMATS[name].write(WriteRequest(SplatScene("x", (SplatNode("background", cloud),)), 0.0))]


def fuzz(name: str, words: list[str]) -> None:
    """Give a parser inputs until libFuzzer's limits end the process."""
    parse = PARSERS[name]
    log.set_quiet(True)

    def once(content: bytes) -> None:
        try:
            parse(content)
        except MudgError:
            return

    atheris.Setup([name, *words], once)
    atheris.Fuzz()


def main() -> int:
    """Fuzz each parser in a process of its own; returns the number of failures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parser", nargs="+", default=sorted(PARSERS), choices=sorted(PARSERS), metavar="NAME")
    parser.add_argument("--seconds", type=int, default=0)
    parser.add_argument("--runs", type=int, default=-1)
    parser.add_argument("--corpus", type=Path, required=True)
    given, failures = parser.parse_args(), 0
    for name in given.parser:
        corpus, failed = given.corpus / name, given.corpus / "failures" / f"{name}-"
        for folder in (corpus, failed.parent, SCRATCH):
            folder.mkdir(parents=True, exist_ok=True)
        for number, content in enumerate(seeds_of(name)):
            (corpus / f"seed{number}").write_bytes(content)
        limits = [*LIMITS, f"-max_total_time={given.seconds}", f"-runs={given.runs}", f"-artifact_prefix={failed}"]
        words = [name, [*limits, str(corpus)]]
        program = f"import sys; sys.path.insert(0, {str(HERE)!r}); import fuzz; fuzz.fuzz(*{words!r})"
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, errors="replace", check=False
        )
        stats = dict(re.findall(r"stat::(\w+):\s+(\d+)", done.stderr))
        said = json.dumps({key: int(stats[key]) for key in STATS if key in stats})
        print(f"{name:14s} {said}{'' if not done.returncode else ' FAILED: ' + _reason(done.stderr)}", flush=True)
        failures += bool(done.returncode)
    return failures


def _reason(text: str) -> str:
    """The line that says what went wrong."""
    lines = [line for line in text.splitlines() if "Error" in line or "ERROR" in line or "Exception" in line]
    return (lines or text.splitlines() or ["?"])[-1][:200]


if __name__ == "__main__":
    sys.exit(main())
