"""Damage by chance to files of every format that is read: an error in words or a sound result, in bounded memory and
time, nothing left.

Cases that were thought of are in ``test_splats_bad.py``, ``test_bad_*.py`` and the tests of the formats; this is for
those that were not.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bad_logs
import numpy as np
import pytest
import roundtrip
import test_clouds
import toy_splats
from byte_faults import damaged, damaged_within
from memory_limits import at_most
from test_hostile_files import ends_within

from mudg.base.errors import MudgError
from mudg.base.types import Scene
from mudg.formats.importers.clouds import read_cloud
from mudg.formats.splats import formats
from mudg.formats.splats.cloud import SplatCloud
from mudg.scene.read import read_points

pytestmark = pytest.mark.skipif(importlib.util.find_spec("resource") is None, reason="the system limits no memory")
many_damages = pytest.mark.parametrize("damages", [30, pytest.param(150, marks=pytest.mark.slow)])
SPLATS = [name for name, one in formats.FORMATS.items() if one.read]


@contextlib.contextmanager
def bounded(mib: int, seconds: float) -> Iterator[None]:
    """No more memory and time than this."""
    with ends_within(seconds), at_most(mib):
        yield


def spoilt(name: str, content: bytes, seed: int, count: int) -> Iterator[bytes]:
    """The file cut at some lengths, and damaged in other ways, within and without."""
    rng = np.random.default_rng(seed)
    yield from (content[:length] for length in np.unique(np.geomspace(1, len(content), 24).astype(int) - 1))
    for number in range(count):
        yield damaged_within(name, content, rng) if number % 3 else damaged(content, rng)


# --- Gaussians ------------------------------------------------------------------------------------


def assert_sound(cloud: SplatCloud) -> None:
    for values in (cloud.means, cloud.quats, cloud.log_scales, cloud.logits, cloud.sh):
        assert len(values) == len(cloud) > 0
        assert np.isfinite(values).all()
    assert np.abs(np.linalg.norm(cloud.quats, axis=1) - 1).max() < 1e-4


@many_damages
@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("name", SPLATS)
def test_damaged_gaussians_are_refused_in_words_or_read(name: str, degree: int, damages: int) -> None:
    scene = toy_splats.SplatScene("toy", (toy_splats.SplatNode("background", toy_splats.cloud(5, degree)),))
    content = formats.FORMATS[name].write(formats.WriteRequest(scene, 0.0))
    file = f"bad{formats.FORMATS[name].suffixes[0]}"
    refused = 0
    for bad in spoilt(file, content, degree, 4 * damages):
        told = ""
        with bounded(200, 10):
            try:
                assert_sound(formats.read_cloud(bad, file)[0])
            except MudgError as error:
                told = str(error)
        assert not told or file in told
        refused += bool(told)
    assert refused > 2 * damages if name != "splat" else refused > damages


# --- clouds ---------------------------------------------------------------------------------------

CLOUDS = {**test_clouds.GOOD, "a.bin": np.column_stack([test_clouds.XYZ, [0.1, 0.5, 1.0]]).astype("<f4").tobytes()}


@many_damages
@pytest.mark.parametrize("name", CLOUDS)
def test_damaged_clouds_are_refused_in_words_or_read(name: str, damages: int, tmp_path: Path) -> None:
    content, file = CLOUDS[name], tmp_path / name
    for bad in spoilt(name, content, 1, 2 * damages):
        file.write_bytes(bad)
        with bounded(200, 10), np.errstate(over="ignore", invalid="ignore"):
            try:
                cloud = read_cloud(file)
            except MudgError as error:
                told = str(error)
            else:
                told = name
                assert np.isfinite(cloud.xyz).all()
        assert name in told


# --- logs -----------------------------------------------------------------------------------------


@functools.cache
def log_of(kind: str, folder: Path) -> tuple[Path, tuple[Path, ...], Any]:
    """A copy of the log of a format that may be damaged: what is imported, its files of every kind, and options."""
    whole = bad_logs.written(kind, folder)
    target = folder / f"{kind} to damage"
    if isinstance(whole, bad_logs.Files):
        inside = next(one for one in (whole.source, *whole.source.parents) if one.parent == folder)
        shutil.copytree(inside, target)
        source = target / whole.source.relative_to(inside)
    else:
        target.mkdir()
        source = bad_logs.write_waymo_log(whole, kind, target)
    return source, tuple(path for path in sorted(target.rglob("*")) if path.is_file()), bad_logs.options_of(whole)


def one_of_each(files: tuple[Path, ...], rng: np.random.Generator) -> Path:
    """A file by chance, every kind of file as often as any other."""
    kinds = sorted(
        {(path.suffix, path.suffix in (".json", ".txt", ".feather", ".parquet") and path.name) for path in files},
        key=str,
    )
    suffix, name = kinds[int(rng.integers(len(kinds)))]
    fitting = [path for path in files if path.suffix == suffix and (not name or path.name == name)]
    return fitting[int(rng.integers(len(fitting)))]


def assert_readable(scene: Scene) -> None:
    assert scene.frames
    for sweep in scene.sweeps:
        assert np.isfinite(read_points(scene, sweep).xyz).all()


@roundtrip.needs_native
@pytest.mark.parametrize("damages", [12, pytest.param(400, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", bad_logs.FORMATS)
def test_damaged_logs_are_refused_in_words_or_read(
    kind: str, damages: int, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    if kind in bad_logs.NEEDS_PYARROW:
        pytest.importorskip("pyarrow")
    source, files, options = log_of(kind, bad_logs.shared(tmp_path_factory))
    rng, out = np.random.default_rng(damages), tmp_path / "out"
    for number in range(damages):
        path = one_of_each(files, rng)
        content = path.read_bytes()
        path.write_bytes(damaged_within(path.name, content, rng) if number % 3 else damaged(content, rng))
        try:
            with bounded(600, 30):
                assert_readable(bad_logs.ingest(kind, source, out, options))
            shutil.rmtree(out)
        except MudgError as error:
            told = error
        else:
            told = None
        finally:
            path.write_bytes(content)
        assert told is None or told.where
        assert not list(tmp_path.iterdir())
