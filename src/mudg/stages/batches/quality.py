"""What a result is worth: bounds on its numbers, facts about its log, its digest, and who is run a second time."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from mudg.base import store
from mudg.base.errors import InputError, UsageError

_BOUND: Final = re.compile(r"(?:(?P<file>[^:<>=]+):)?(?P<path>[^:<>=]+?)(?:@(?P<distance>[\d.]+))?(?P<sign><=|>=)(?P<limit>[-+.\deE]+)")
FOUND: Final = ": it is "
"""Between a bound and the number that does not keep it."""
_SCORES: Final = ("score/metrics.json", "metrics.json")
_LARGEST: Final = 64 << 20


@dataclass(frozen=True)
class Bound:
    """A bound on a number of a result.

    Args:
        text: as it was given. file: JSON file of the result (empty: its scores). path: names with dots in that file; of scores, method
            and metric. distance_m: distance from the recorded path. lower: whether the limit is the least value.
    """

    text: str
    file: str
    path: str
    distance_m: float
    lower: bool
    limit: float

    def value(self, folder: Path) -> float | None:
        """The number, None where the result has no such number: it is another step's."""
        if self.file:
            found: Any = _json(folder / self.file)
            for name in self.path.split("."):
                found = found.get(name) if isinstance(found, Mapping) else None
            return _number(found)
        method, _, metric = self.path.rpartition(".")
        for name in _SCORES:
            scores = _json(folder / name)
            try:
                for row in scores.get("by_distance", []) if isinstance(scores, Mapping) else []:
                    if row.get("method") == method and abs(float(row.get("distance_m", math.inf)) - self.distance_m) < 1e-6:
                        return _number(row.get("values", {}).get(metric))
            except (AttributeError, TypeError, ValueError) as error:
                raise InputError("the scores of a result cannot be read", where=str(folder / name), got=str(error)) from error
        return None

    def problem(self, folder: Path) -> str:
        """What is wrong with a result by this bound; empty if nothing is."""
        value = self.value(folder)
        if value is None or (value >= self.limit if self.lower else value <= self.limit):
            return ""
        return f"{self.text}{FOUND}{value:g}"


def parse_bounds(texts: Sequence[str]) -> tuple[Bound, ...]:
    """Bounds from ``METHOD.METRIC[@METRES]>=NUMBER`` or ``FILE.json:NAME.NAME<=NUMBER``.

    Raises:
        UsageError: not of this form.
    """
    found = []
    for text in texts:
        match = _BOUND.fullmatch(text.replace(" ", ""))
        limit = _parsed(match["limit"]) if match else None
        if match is None or limit is None or (not match["file"] and "." not in match["path"]):
            raise UsageError("not a bound on a result", where="--bounds", got=text,
                expected="METHOD.METRIC@METRES>=NUMBER, as mudg_s.psnr@0>=20, or FILE.json:NAME<=NUMBER")  # fmt: skip
        file = match["file"] or ""
        if file and store_name(file) is None:
            raise UsageError("the file of a bound lies in the result", where="--bounds", got=text)
        found.append(Bound(text, file, match["path"], float(match["distance"] or 0.0), match["sign"] == ">=", limit))
    return tuple(found)


def store_name(name: str) -> str | None:
    """A relative name that stays below its folder, else None."""
    return None if name.startswith("/") or ".." in name.split("/") else name


def problems(bounds: Iterable[Bound], folder: Path) -> list[str]:
    """What is wrong with a result."""
    return [words for bound in bounds if (words := bound.problem(folder))]


def is_sampled(key: str, share: float) -> bool:
    """Whether a result belongs to the sample of this share; the same for all workers."""
    return int(hashlib.sha256(f"second run {key}".encode()).hexdigest()[:13], 16) < share * 16**13


def digest_of(folder: Path) -> str:
    """What the bytes of a result are told by: the hash of its manifest; of a chain, of the manifests of its steps; else of all files."""
    if (folder / store.MANIFEST).is_file():
        return store.sha256_file(folder / store.MANIFEST)
    manifests = sorted(path.relative_to(folder).as_posix() for path in folder.rglob(store.MANIFEST))
    names = manifests or (store.list_files(folder) if folder.is_dir() else [""])
    total = hashlib.sha256()
    for name in names:
        total.update(f"{name}\0{store.sha256_file(folder / name if name else folder)}\n".encode())
    return total.hexdigest()


def facts_of(folder: Path) -> dict[str, Any]:
    """Facts about the log that a result holds a scene of: cameras, images, seconds and metres driven, objects by class. Empty where there
    is none that can be read."""
    with contextlib.suppress(AttributeError, TypeError, ValueError):  # any command may have made it
        return _facts_of(folder)
    return {}


def _facts_of(folder: Path) -> dict[str, Any]:
    for scene in (folder, folder / "scene"):
        index = _json(scene / "scene.json")
        if not isinstance(index, Mapping) or "frames" not in index:
            continue
        ego = index.get("ego", {})
        times = [float(time) for time in ego.get("times_s", [])]
        tracks = _json(scene / "tracks.json")
        labels = Counter(str(one.get("label")) for one in tracks.get("tracks", [])) if isinstance(tracks, Mapping) else Counter()
        return {
            "dataset": str(index.get("source", {}).get("dataset", "")),
            "cameras": len(index.get("cameras", {})),
            "images": len(index["frames"]),
            "seconds": round(max(times) - min(times), 3) if times else 0.0,
            "metres": round(_length(ego.get("world_from_ego", [])), 1),
            "objects": dict(sorted(labels.items())),
        }
    return {}


def _length(poses: Any) -> float:
    """Metres along a path, from its poses as rows of a matrix; 0 where they are none."""
    try:
        places = [(float(pose[3]), float(pose[7]), float(pose[11])) for pose in poses]
    except (IndexError, TypeError, ValueError):
        return 0.0
    return sum(math.dist(one, following) for one, following in itertools.pairwise(places))


def spent_of(folder: Path) -> dict[str, Any]:
    """What the record of a run says that it took: of a chain, by step."""
    state = _json(folder / store.RUN_STATE)
    with contextlib.suppress(AttributeError, TypeError, ValueError):  # any command may have made it
        steps = state.get("steps")
        if isinstance(steps, Mapping):
            peaks = [int(one["peak_bytes"]) for one in steps.values() if one.get("peak_bytes")]
            return {"peak_bytes": max(peaks, default=None), "steps": {name: float(one.get("seconds", 0.0)) for name, one in steps.items()}}
        return {"peak_bytes": None if state.get("peak_bytes") is None else int(state["peak_bytes"])}
    return {}


def _json(path: Path) -> Any:
    try:
        return store.read_json(path) if path.is_file() and path.stat().st_size <= _LARGEST else {}
    except InputError:
        return {}


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _parsed(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
