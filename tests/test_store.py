"""Nothing half-written, nothing silently wrong: files, manifests, checkpoints."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refused

from mudg.base import checkpoint, store
from mudg.base.errors import InputError, IntegrityError, ResourceError
from mudg.base.run_folder import is_temporary


def test_atomic_path_leaves_the_old_file_when_the_writer_fails(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    store.write_text(target, "old")

    def fail() -> None:
        with store.atomic_path(target) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert target.read_text() == "old" and [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_written_files_follow_the_umask_and_json_refuses_to_write_nan(tmp_path: Path) -> None:
    store.write_safetensors(tmp_path / "a.safetensors", {"x": np.zeros(3)})
    mask = os.umask(0)
    os.umask(mask)
    assert (tmp_path / "a.safetensors").stat().st_mode & 0o777 == 0o666 & ~mask
    refused(r"x\.y\[1\]", store.write_json, tmp_path / "a.json", {"x": {"y": [1.0, float("nan")]}})
    assert not (tmp_path / "a.json").exists()


def test_unwritable_folder_is_a_resource_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    refused("--out", store.write_text, tmp_path / "file" / "b.txt", "x", raises=ResourceError)


@pytest.mark.parametrize("text", ['{"a": NaN}', '{"a": 1, "a": 2}', "{", "[" * 100_000])
def test_json_is_strict(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text)
    refused(r"a\.json", store.read_json, tmp_path / "a.json")


def test_safetensors_round_trip_and_truncation(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    store.write_safetensors(path, {"n": np.arange(6).reshape(2, 3), "t": torch.ones(2, 2).t()})
    back = store.read_safetensors(path)
    np.testing.assert_array_equal(back["n"], np.arange(6).reshape(2, 3))
    content = path.read_bytes()
    for keep in (0, 4, 12, len(content) - 1):
        path.write_bytes(content[:keep])
        refused(r"a\.safetensors", store.read_safetensors, path)


def test_manifest_detects_every_single_bit_flip(tmp_path: Path) -> None:
    store.write_safetensors(tmp_path / "a.safetensors", {"x": np.arange(32, dtype=np.float32)})
    store.write_manifest(tmp_path)
    content = (tmp_path / "a.safetensors").read_bytes()
    for position in range(0, len(content), 17):
        flipped = bytearray(content)
        flipped[position] ^= 1 << (position % 8)
        (tmp_path / "a.safetensors").write_bytes(bytes(flipped))
        refused(r"a\.safetensors", store.verify_manifest, tmp_path, raises=IntegrityError)
    (tmp_path / "a.safetensors").write_bytes(content)
    store.verify_manifest(tmp_path)
    (tmp_path / "a.safetensors").unlink()
    refused("missing", store.verify_manifest, tmp_path, raises=IntegrityError)


def test_checkpoints_keep_two_and_fall_back_past_a_damaged_one(tmp_path: Path) -> None:
    for foreign in ("step_00000005.part", "step_latest"):
        (tmp_path / foreign).mkdir()
        assert checkpoint.latest(tmp_path) is None
        (tmp_path / foreign).rmdir()
    for step in (10, 20, 30):
        checkpoint.save(tmp_path, step, {"model": {"w": torch.full((4,), float(step))}}, {"loss": 1 / step})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["step_00000020", "step_00000030"]
    newest = checkpoint.latest(tmp_path)
    assert newest.step == 30 and torch.equal(newest.tensors("model")["w"], torch.full((4,), 30.0))
    damaged = tmp_path / "step_00000030" / "model.safetensors"
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"\xff")
    assert checkpoint.latest(tmp_path).step == 20
    (tmp_path / "step_00000020" / store.MANIFEST).unlink()
    refused("no checkpoint verifies", checkpoint.latest, tmp_path, raises=IntegrityError)
    assert damaged.exists()


def test_large_checkpoints_take_a_small_share_of_the_time_and_small_ones_are_always_due(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [100.0]
    monkeypatch.setattr(checkpoint.time, "monotonic", lambda: now[0])

    def taking(seconds: float) -> None:
        with pace.saving():
            now[0] += seconds

    pace = checkpoint.Pace()
    assert pace.due()
    taking(0.9)
    assert pace.due()
    taking(7.0)
    due = []
    for _ in range(200):
        now[0] += 1.0
        due.append(pace.due())
    assert due.index(True) + 1 == 140  # a twentieth of 140 s is 7 s
    assert all(due[139:])
    taking(0.5)
    assert pace.due()


def test_safetensors_are_the_library_s_own_bytes_and_a_killed_writer_leaves_names_of_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import safetensors.numpy

    arrays = {"b": np.arange(7, dtype=np.uint8), "a": np.ones((3, 2), np.float32), "z": np.zeros((0, 4), np.int64)}
    store.write_safetensors(tmp_path / "a.safetensors", arrays)
    assert (tmp_path / "a.safetensors").read_bytes() == safetensors.numpy.save(arrays)
    seen: list[str] = []
    write = safetensors.numpy.save_file

    def looked_at(found: dict[str, np.ndarray], path: Path) -> None:
        write(found, path)
        seen.extend(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file())

    monkeypatch.setattr(safetensors.numpy, "save_file", looked_at)
    store.write_safetensors(tmp_path / "b.safetensors", arrays)
    assert sorted(map(is_temporary, seen)) == [False, True, True]  # a.safetensors, and what is being written
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.safetensors", "b.safetensors"]


def test_a_full_disk_is_a_resource_error_of_safetensors_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import safetensors.numpy

    def full(arrays: object, path: Path) -> None:
        path.write_bytes(b"half")
        raise safetensors.SafetensorError("I/O error: No space left on device")

    monkeypatch.setattr(safetensors.numpy, "save_file", full)
    words = r"a\.safetensors[\s\S]*No space left[\s\S]*free disk space"
    refused(words, store.write_safetensors, tmp_path / "a.safetensors", {"x": np.zeros(3)}, raises=ResourceError)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_checkpoint_leaves_nothing(tmp_path: Path) -> None:
    refused(".", checkpoint.save, tmp_path, 1, {"model": {"w": torch.zeros(1)}}, {"loss": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_errors_carry_all_fields_and_cross_process_boundaries() -> None:
    error = InputError("bad", where="a.json: x", expected="1", got="2", remedy="fix it")
    text = str(error)
    assert all(part in text for part in ("bad", "a.json: x", "expected: 1", "got: 2", "fix it"))
    again = pickle.loads(pickle.dumps(error))
    assert isinstance(again, InputError) and str(again) == text


def test_half_a_line_of_a_log_does_not_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = tmp_path / "log.jsonl"
    store.append_line(log, '{"a": 1}')
    log.write_bytes(log.read_bytes() + b'{"b": ' + b"x" * 5000)  # a crash
    store.append_line(log, '{"c": "\u00e4"}')
    assert log.read_text(encoding="utf-8") == '{"a": 1}\n{"c": "\u00e4"}\n'
    (tmp_path / "half").write_bytes(b"no line at all")
    store.append_line(tmp_path / "half", "1")
    assert (tmp_path / "half").read_text() == "1\n"
    refused("writing failed", store.append_line, Path("/dev/full"), "x", raises=ResourceError)
