"""Shards of training clips that are damaged: `mudg learn` ends in words, and leaves no model."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load, save
from toy_clips import tiny, write_clips

from mudg.base.errors import InputError
from mudg.diffusion import clips as clip_shards
from mudg.steps.synthesize import Learn

Arrays = dict[str, np.ndarray]
NOT_FINITE = "depth sparse_depth render_depth world_from_cam intrinsics shift_m fine_depth fine_world_from_cam".split()
NO_CLASS = ("semantics", "ids", "backdrop_ids", "render_ids", "fine_semantics", "fine_ids")


def with_value(array: np.ndarray, value: float) -> np.ndarray:
    changed = array.copy()
    changed.reshape(-1)[:] = value
    return changed


DAMAGE: dict[str, Callable[[bytes, Arrays], bytes]] = {
    "empty": lambda content, _: content[:0],
    "cut off": lambda content, _: content[:-100],
    "header alone": lambda content, _: content[: 8 + int.from_bytes(content[:8], "little")],
    "header that lies": lambda content, _: content.replace(b'"U8"', b'"I8"', 1),
    "header of another size": lambda content, _: content.replace(b"[2,4,3,32,48]", b"[2,4,3,48,32]", 1),
    "header longer than the file": lambda content, _: b"\xff" * 7 + content[7:],
    "no array": lambda _, __: save({}),
    "fewer frames": lambda _, a: save({n: v[:, :2].copy() if v.shape[1:2] == (4,) else v for n, v in a.items()}),
    "no clip": lambda _, a: save({n: v[:0].copy() for n, v in a.items()}),
    "without its patches' place in two numbers": lambda _, a: save({**a, "fine_place": a["fine_place"][:, :2].copy()}),
}
PER_ARRAY: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "another type": lambda v: v.astype(np.float32 if v.dtype != np.float32 else np.float64),
    "another width": lambda v: v[..., :-1].copy(),
    "another axis": lambda v: v[None].copy(),
    "a clip less": lambda v: v[:-1].copy(),
}


def read_whole(path: Path) -> None:
    for clip in range(clip_shards.counts_at(path)[0]):
        clip_shards.clip_at(path, clip, range(4))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return clip_shards.shard_path(write_clips(tmp_path_factory.mktemp("clips")), 1).read_bytes()


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_shard_is_refused(kind: str, whole: bytes, tmp_path: Path) -> None:
    (tmp_path / "shard").write_bytes(whole)
    read_whole(tmp_path / "shard")
    (tmp_path / "shard").write_bytes(DAMAGE[kind](whole, load(whole)))
    if kind == "no clip":
        with pytest.raises(InputError, match="damaged"):
            clip_shards.counts_at(tmp_path / "shard")
    with pytest.raises(InputError) as refused:
        read_whole(tmp_path / "shard")
    assert str(tmp_path / "shard") in refused.value.where


@pytest.mark.parametrize("kind", PER_ARRAY)
def test_an_array_that_does_not_fit_the_others_is_refused(kind: str, whole: bytes, tmp_path: Path) -> None:
    arrays = load(whole)
    assert len(arrays) > 30
    for name in arrays:
        (tmp_path / "shard").write_bytes(save({**arrays, name: PER_ARRAY[kind](arrays[name])}))
        with pytest.raises(InputError, match="damaged"):
            read_whole(tmp_path / "shard")


def test_an_array_that_is_missing_is_refused(whole: bytes, tmp_path: Path) -> None:
    arrays = load(whole)
    optional = {"fine_place", "rendered", "fine_rendered"}  # without these, what they announce is not read
    for name in set(arrays) - optional:
        (tmp_path / "shard").write_bytes(save({n: v for n, v in arrays.items() if n != name}))
        with pytest.raises(InputError, match=f"no {name}"):
            read_whole(tmp_path / "shard")


@pytest.mark.parametrize(
    ("name", "value"),
    [*((name, value) for name in NOT_FINITE for value in (np.nan, np.inf)), *((name, 19) for name in NO_CLASS)],
)
def test_values_that_cannot_be_are_refused(name: str, value: float, whole: bytes, tmp_path: Path) -> None:
    arrays = load(whole)
    (tmp_path / "shard").write_bytes(save({**arrays, name: with_value(arrays[name], value)}))
    with pytest.raises(InputError, match="damaged"):
        read_whole(tmp_path / "shard")


def test_learn_finds_a_damaged_shard_before_it_begins(tmp_path: Path) -> None:
    clips = write_clips(tmp_path / "clips")
    path = sorted(clips.iterdir())[2]
    path.write_bytes(DAMAGE["cut off"](path.read_bytes(), {}))
    with pytest.raises(InputError, match="damaged") as refused:
        Learn(out=tmp_path / "out", settings=tiny(clips)).run()
    assert str(path) in refused.value.where
    left = {p.name for p in (tmp_path / "out").rglob("*") if p.is_file()}
    assert left <= {"run.json", "run.yaml", "log.jsonl", "lock"}
