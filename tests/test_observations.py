"""Observation folders: round trip, resume, and refusal of what does not fit."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refused

from mudg.base.types import Camera, Observation, View
from mudg.scene.observations import ObservationWriter, list_observation_sets, read_observations

CAMERA = Camera("front", 8, 6, 5.0, 5.0, 4.0, 3.0)


def _observation(index: int) -> Observation:
    g = torch.Generator().manual_seed(index)
    pose = np.eye(4)
    pose[0, 3] = index
    depth = torch.rand(1, 6, 8, generator=g) * 50
    depth[0, 0, 0] = float("nan")
    rgb, classes = (torch.rand(3, 6, 8, generator=g) * 255).round() / 255, torch.randint(0, 19, (6, 8), generator=g)
    confidence = (torch.rand(1, 6, 8, generator=g) * 1024).round() / 1024
    mask = torch.rand(1, 6, 8, generator=g) > 0.5
    return Observation(View(CAMERA, pose, index / 10), rgb, depth, classes, confidence, mask, "virtual", "mudg_r")


def test_round_trip(tmp_path: Path) -> None:
    with ObservationWriter(tmp_path / "front_shift+2.0", "front_shift+2.0", "mudg_r") as writer:
        for i in range(3):
            writer.add(_observation(i))
    found = read_observations(list_observation_sets(tmp_path)["front_shift+2.0"])
    assert (found.trajectory, found.source, len(found)) == ("front_shift+2.0", "mudg_r", 3)
    for i in range(3):
        want, got = _observation(i), found[i]
        torch.testing.assert_close(got.rgb, want.rgb, atol=1e-6, rtol=0)
        torch.testing.assert_close(got.depth, want.depth, equal_nan=True, atol=0, rtol=0)
        torch.testing.assert_close(got.confidence, want.confidence, atol=1e-3, rtol=0)
        assert torch.equal(got.semantics, want.semantics) and torch.equal(got.mask, want.mask)
        assert np.array_equal(got.view.world_from_cam, want.view.world_from_cam)
        assert got.view.time_s == want.view.time_s
    with pytest.raises(IndexError):
        found[3]


def test_modalities_not_produced_stay_none(tmp_path: Path) -> None:
    bare = _observation(0)
    with ObservationWriter(tmp_path / "t", "t", "x") as writer:
        writer.add(Observation(bare.view, bare.rgb, None, None, bare.confidence, bare.mask, "virtual", "x"))
    got = read_observations(tmp_path / "t")[0]
    assert got.depth is None
    assert got.semantics is None
    (tmp_path / "t" / "observations.json").unlink()
    with ObservationWriter(tmp_path / "t", "t", "x") as writer:
        writer.skip(bare.view)
    assert read_observations(tmp_path / "t")[0].depth is None


def test_an_interrupted_folder_is_not_readable_but_its_files_are_kept(tmp_path: Path) -> None:
    def interrupted() -> None:
        with ObservationWriter(tmp_path / "t", "t", "x") as writer:
            writer.add(_observation(0))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    refused("finished", read_observations, tmp_path / "t")
    with ObservationWriter(tmp_path / "t", "t", "x") as writer:
        assert writer.done == 1
        writer.skip(_observation(0).view)
        writer.add(_observation(1))
    assert len(read_observations(tmp_path / "t")) == 2


BAD_ARRAYS = {
    "cut off": (lambda arrays, content: content[: len(content) // 2], "not a valid .npz file"),
    "empty": (lambda arrays, content: b"", "not a valid .npz file"),
    "altered": (lambda arrays, content: content[:200] + b"XXXX" + content[204:], "not a valid .npz file"),
    "objects": (lambda arrays, content: _npz(arrays | {"depth": np.array([{}])}), "not a valid .npz file"),
    "another size": (lambda arrays, content: _npz(arrays | {"depth": np.zeros((2, 2), "f4")}), r"float32\[2, 2\]"),
    "another type": (lambda arrays, content: _npz(arrays | {"mask": arrays["mask"] + 0.0}), r"float64"),
    "none": (lambda arrays, content: _npz({"depth": arrays["depth"]}), "missing"),
    "a bomb": (lambda arrays, content: _npz(arrays | {"depth": np.zeros(2**24, np.float32)}), "too large"),
}


def _npz(arrays) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


@pytest.mark.parametrize("name", [*BAD_ARRAYS, "a picture"])
def test_damaged_arrays_and_pictures_are_named(name: str, tmp_path: Path) -> None:
    damaged, words = BAD_ARRAYS.get(name, (lambda _, content: content[: len(content) // 2], "."))
    with ObservationWriter(tmp_path / "t", "t", "x") as writer:
        writer.add(_observation(0))
    with np.load(tmp_path / "t" / "data" / "000000.npz", allow_pickle=False) as arrays:  # numpy reads what was written
        kept = dict(arrays)
    path = tmp_path / "t" / ("rgb/000000.png" if name == "a picture" else "data/000000.npz")
    path.write_bytes(damaged(kept, path.read_bytes()))
    assert path.name in str(refused(words, read_observations(tmp_path / "t").__getitem__, 0))
