"""Every verb: an output that touches an input is refused, and a result is replaced only by a finished one."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final

import kitti_folders
import pytest
import torch
import toy_views
from fit_settings import fit_config
from refusals import refused
from tiny_networks import small_mdm
from toy_clips import tiny, write_clips
from toy_published import TINY, tiny_checkpoint
from toy_scene import ToyStreet

from mudg.base import store
from mudg.base.errors import UsageError
from mudg.base.run_folder import RunDir
from mudg.benchmarks import chain
from mudg.city.config import CityConfig
from mudg.core import trajectory
from mudg.diffusion import convert
from mudg.diffusion import model_files as files
from mudg.diffusion.model import MDM
from mudg.diffusion.settings import ConvertConfig, SynthesizeConfig
from mudg.editing.settings import RenderConfig, ScoreConfig
from mudg.formats import ingest
from mudg.formats.settings import IngestConfig
from mudg.labels.settings import AnnotateConfig
from mudg.scene.read import read_scene
from mudg.scene.settings import FuseConfig
from mudg.steps import pipeline
from mudg.steps.export import Convert
from mudg.steps.fit import Fit
from mudg.steps.ingest import Annotate, Fuse, Ingest
from mudg.steps.render import DrawTruth, RenderViews, Score
from mudg.steps.run import Run
from mudg.steps.settings import RunConfig
from mudg.steps.synthesize import Learn, Synthesize

CITY = CityConfig(seed=3, n_frames=3, width=48, height=32, cameras=("front",), lidar_beams=8, lidar_azimuth_step_deg=4)


Given = dict[str, Path]


def _ingest(g: Given) -> Any:
    config = IngestConfig(poses=str(g.get("poses", "")), workers=1, contact_sheet=False)
    return partial(Ingest, log=g["log"], settings=config)


def _synthesize(g: Given) -> Any:
    size = {"width_px": 48, "full_size": False, "precision": "float32", "processes": 1}
    config = SynthesizeConfig(cameras=("front",), shifts_m=(1.0, -1.0), model=str(g["model"]), steps=1, **size)
    return partial(Synthesize, scene=g["scene"], fused=g["fused"], fitted=g["fitted"], settings=config)


def _fit(g: Given) -> Any:
    config = fit_config(method="mudg_s", iterations=6, start__gaussians=200, checkpoint_every=2, preview_every=3)
    return partial(Fit, scene=g["scene"], fused=g["fused"], observations=(g["views"],), settings=config)


def _score(g: Given) -> Any:
    config = ScoreConfig(width_px=24, perceptual_views=0)
    return partial(Score, scene=g["scene"], fused=g["fused"], views={"a": g["views"]}, truth=None, settings=config)


def _paths(scene: Path) -> tuple[Any, ...]:
    loaded = read_scene(scene)
    return trajectory.recorded(loaded, "front"), trajectory.shifted(loaded, "front", 1.0)


LABELS: Final = AnnotateConfig(sweeps=1, processes=1)
STEPS: dict[str, Callable[[Given], Any]] = {
    "ingest a log": _ingest,
    "ingest a scene": lambda g: _ingest({"log": g["scene"]}),
    "annotate": lambda g: partial(Annotate, scene=g["plain scene"], settings=LABELS),
    "fuse": lambda g: partial(Fuse, scene=g["scene"], settings=FuseConfig()),
    "learn": lambda g: partial(Learn, settings=tiny(g["clips"])),
    "synthesize": _synthesize,
    "fit": _fit,
    "render": lambda g: partial(
        RenderViews, scene=g["scene"], model=g["fitted"], settings=RenderConfig(shifts_m=(0.0, 1.0))
    ),
    "score": _score,
    "truth": lambda g: partial(DrawTruth, scene=g["city"], trajectories=_paths(g["city"])),
    "film": lambda g: partial(chain.Film, views={"truth": (g["views"],)}, paths=_paths(g["scene"])),
    "fill": lambda g: partial(chain.FillViews, scene=g["scene"], fused=g["fused"], paths=_paths(g["scene"])),
}
"""Verb -> the step from inputs by name."""


def call(name: str, given: Given, out: Path, overwrite: bool = False) -> None:
    STEPS[name](given)(out=out, overwrite=overwrite).run()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Given:
    """One input of every kind, small."""
    root = tmp_path_factory.mktemp("world")
    ToyStreet(times=[0.0, 0.1]).write(root / "plain", width=60, height=40, labels=False)
    given = {
        "scene": toy_views.write_scene(root / "scene", lidar=True),
        "plain scene": root / "plain",
        "log": kitti_folders.write_raw_drive(root / "day"),
        "clips": write_clips(root / "clips"),
    }
    given["fused"] = Fuse(scene=given["scene"], out=root / "fused", settings=FuseConfig()).run()
    given["views"] = toy_views.write_views(given["scene"], root / "views", "a", (0.0, 1.0))
    config = fit_config(method="street_gaussians", iterations=2, start__gaussians=200)
    given["fitted"] = Fit(scene=given["scene"], fused=given["fused"], out=root / "fitted", settings=config).run()
    torch.manual_seed(0)
    files.save(MDM(small_mdm(renders=True)), root / "model", "", {})
    given["model"] = root / "model"
    settings = IngestConfig(city=CITY, contact_sheet=False)
    given["city"] = Ingest(log=ingest.CITY, out=root / "city", settings=settings).run()
    return given


def tree(root: Path) -> dict[str, int]:
    """Every file below a folder and when it was written."""
    return {p.relative_to(root).as_posix(): p.lstat().st_mtime_ns for p in sorted(root.rglob("*")) if p.is_file()}


# ---- inputs and outputs apart --------------------------------------------------------------------


def test_files_of_a_log_that_lie_beside_it_count(world: Given, tmp_path: Path) -> None:
    shutil.copytree(world["log"].parent, tmp_path / "day")
    drive, calibration = tmp_path / "day" / world["log"].name, tmp_path / "day" / "calib_cam_to_cam.txt"
    assert calibration.is_file()
    step = Ingest(log=drive, out=calibration, overwrite=True, settings=IngestConfig())
    refused("is also an input", step.run, raises=UsageError)


def test_clips_of_a_training_lie_in_its_folder_only_where_they_do_by_default(world: Given, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(world["clips"], out / "clips")
    for clips in (out, out / "steps", tmp_path, out / "clips" / "deep"):
        refused("an input", Learn(out=out, settings=tiny(clips)).run, raises=UsageError)
    refused("an input", Learn(out=out, overwrite=True, settings=tiny(out / "clips")).run, raises=UsageError)
    refused("something else", Learn(out=out, settings=tiny(out / "clips")).run, raises=UsageError)  # not from here
    assert len(tree(out)) == len(tree(world["clips"]))


def chain_refused(
    words: str, source: Path | str, out: Path, overwrite: bool, settings: RunConfig | None = None
) -> None:
    step = Run(source=source, out=out, overwrite=overwrite, settings=settings or RunConfig())
    refused(words, step.run, raises=UsageError)


@pytest.mark.parametrize("overwrite", [False, True])
def test_the_chain_never_writes_into_its_log_or_the_folder_of_a_verb(
    world: Given, tmp_path: Path, overwrite: bool
) -> None:
    given = {name: tmp_path / name / "input" for name in ("log", "scene", "fused")}
    for name, place in given.items():
        shutil.copytree(world[name], place)
    before = tree(tmp_path)
    chain_refused("do not belong to this run", "city", given.pop("fused"), overwrite)
    for path in given.values():
        for out in (path, path.parent, path / "out"):
            chain_refused("an input", str(path), out, overwrite)
    config = dataclasses.replace(RunConfig(), synthesize=SynthesizeConfig(model=str(given["scene"])))
    chain_refused(r"synthesize\.model", "city", given["scene"].parent, overwrite, config)
    assert tree(tmp_path) == before


def test_the_chain_takes_the_scene_in_its_own_folder_and_leaves_it_alone(
    world: Given, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    shutil.copytree(world["scene"], out / "scene")
    before = tree(out)
    reached: list[Path] = []

    def stop(_config: RunConfig, scene: Path, *_: object) -> Any:
        reached.append(scene)
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "steps_of", stop)
    for overwrite in (False, True):
        with pytest.raises(KeyboardInterrupt):
            Run(source=out / "scene", out=out, overwrite=overwrite, settings=RunConfig()).run()
    assert reached == [out / "scene"] * 2
    assert before.items() <= tree(out).items()
    (out / "run.json").unlink()
    (out / "mine.md").write_text("mine")
    chain_refused("do not belong to this run", out / "scene", out, True)
    chain_refused("an input", out / "scene", out / "scene", True)


# ---- replaced by a finished result only ----------------------------------------------------------


@contextmanager
def counted_writes(monkeypatch: pytest.MonkeyPatch, stop_at: int = 0) -> Iterator[list[Path]]:
    """Note every file that is written; the ``stop_at``-th is not, as if Ctrl-C had come."""
    written: list[Path] = []
    atomic_path, write_in_tree = store.atomic_path, store.write_in_tree

    def note(path: Path) -> None:
        written.append(Path(path))
        if len(written) == stop_at:
            raise KeyboardInterrupt

    @contextmanager
    def path_noted(path: Path) -> Iterator[Path]:
        note(path)
        with atomic_path(path) as temporary:
            yield temporary

    def tree_noted(path: Path, content: bytes) -> None:
        note(path)
        write_in_tree(path, content)

    with monkeypatch.context() as patched:
        patched.setattr(store, "atomic_path", path_noted)
        patched.setattr(store, "write_in_tree", tree_noted)
        yield written


def listed(folder: Path) -> dict[str, Any]:
    return {n: f["sha256"] for n, f in store.read_json(folder / store.MANIFEST)["files"].items()}


@pytest.mark.parametrize("name", STEPS)
def test_an_interrupted_replacement_keeps_the_old_result_and_continues(
    name: str, world: Given, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made_by, out, whole = partial(call, name, world), tmp_path / "out", tmp_path / "whole"
    with counted_writes(monkeypatch) as written:
        made_by(whole)
    total, wanted = len(written), listed(whole)
    made = {n for n in tree(whole) if n not in ("run.json", "log.jsonl", "manifest.json")}
    assert set(wanted) == made, "a file is missing among the names that the verb declares"
    old = RunDir.open(out, STEPS[name](world)(out=out).output(), {"of": "other settings"}, {})
    store.write_text(old.path / next(n for n in sorted(made) if n != "run.yaml"), "old")
    old.finish()
    (out / "mine.md").write_text("mine")
    before = tree(out)
    refused("another configuration", made_by, out, raises=UsageError)
    with counted_writes(monkeypatch, stop_at=max(4, total // 2)), pytest.raises(KeyboardInterrupt):
        made_by(out, True)
    assert tree(out) == before
    store.verify_manifest(out)
    made_by(out, True)
    assert "mine.md" in capsys.readouterr().err
    assert (out / "mine.md").read_text() == "mine"
    store.verify_manifest(out)
    found = listed(out)
    assert found.keys() == wanted.keys()
    assert not {n for n in found if found[n] != wanted[n] and Path(n).name != "state.json"}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "whole"]
    assert not [p for p in out.rglob("*") if p.is_file() and b".new.part" in p.read_bytes()]
    made_by(out, True)  # finished: reused


def test_a_model_is_replaced_by_a_whole_one_and_other_files_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.save({"state_dict": tiny_checkpoint()}, tmp_path / "512.ckpt")

    def converted(dtype: str, *, overwrite: bool) -> Path:
        config = ConvertConfig(dtype=dtype, resolution="320x512")
        work = partial(convert.of_diffusion, config, tmp_path / "512.ckpt", network=TINY)
        return convert.run(config, tmp_path / "512.ckpt", tmp_path / "to", work, overwrite=overwrite)

    monkeypatch.setattr(convert.processes, "run_limited", lambda work, *_: work() or 0)
    to = converted("float32", overwrite=False)
    (to / "mine.md").write_text("mine")
    before = tree(to)
    convert_to = partial(Convert, checkpoint=tmp_path / "512.ckpt", overwrite=True, settings=ConvertConfig())
    for out in (tmp_path, tmp_path / "512.ckpt"):
        refused("an input", convert_to(to=out).run, raises=UsageError)
    (tmp_path / "fit").mkdir()
    store.write_json(tmp_path / "fit" / "model.json", {"schema": 1, "nodes": []})
    refused("do not belong to a model", convert_to(to=tmp_path / "fit").run, raises=UsageError)
    with counted_writes(monkeypatch, stop_at=2), pytest.raises(KeyboardInterrupt):
        converted("float16", overwrite=True)
    assert tree(to) == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["512.ckpt", "fit", "to"]
    converted("float16", overwrite=True)
    assert (to / "mine.md").read_text() == "mine"
    assert store.read_json(to / "model.json")["files"] != {}
    assert tree(to).keys() == before.keys()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["512.ckpt", "fit", "to"]
