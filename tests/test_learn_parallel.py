"""Training on several processes, killed, warned and changed in number: the losses of one that was left alone."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from torch import nn
from toy_clips import losses_of, tiny, write_clips

from mudg.base import checkpoint
from mudg.base.config import dump_yaml
from mudg.base.errors import NumericsError, UsageError
from mudg.diffusion import learn, model_files, models, parallel
from mudg.diffusion.clips import ShardFolder, class_weights
from mudg.diffusion.model import MDM, BatchPart
from mudg.diffusion.parallel import Ranks, TrainingState
from mudg.steps.synthesize import Learn

SAME = 2e-6
"""Relative. The same sums in another order; measured for 1 -> 2 -> 1 processes over 6 steps: 7e-8 (pytest -s shows
it)."""
STEPS = 8
ALONE = Ranks(0, 1, torch.device("cpu"))


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("clips"))


def environment():
    here = Path(__file__).parent
    paths = os.pathsep.join([str(here), *sys.path])
    return os.environ | {"PYTHONPATH": paths, "GLOO_SOCKET_IFNAME": "lo", "OMP_NUM_THREADS": "1"}


@pytest.mark.slow
def test_a_run_may_go_on_in_another_number_of_processes(clips, tmp_path):
    common = {"batch_frames": 8, "log_every": 1, "checkpoint_every": 100, "steps": 6}
    Learn(out=tmp_path / "whole", settings=tiny(clips, **common)).run()

    stop = TrainingState.blend

    def stop_after_two(state, decay):
        stop(state, decay)
        if state.step == 2:
            state.save(tmp_path / "parts" / "steps", ALONE, {})
            raise KeyboardInterrupt

    TrainingState.blend = stop_after_two
    try:
        with pytest.raises(KeyboardInterrupt):
            Learn(out=tmp_path / "parts", settings=tiny(clips, **common)).run()
    finally:
        TrainingState.blend = stop
    both_run("learn_together.py", tmp_path / "store", clips, tmp_path)
    said = [json.loads((tmp_path / f"said_{rank}.json").read_text()) for rank in (0, 1)]
    for words in said:  # one process was asked to stop, both did; one had numbers that are not finite, both say so
        assert words["stopped"] and "divided evenly" in words["uneven"]
        assert "step" in words["numerics"] and "of 2" in words["numerics"]
    saved = checkpoint.latest(tmp_path / "parts" / "steps")
    assert saved is not None and saved.step == 5 and saved.state["processes"] == 2
    parts = Learn(out=tmp_path / "parts", settings=tiny(clips, **common)).run()

    assert_same_training(tmp_path / "whole", parts.parent, (3, 4, 5, 6), model_files.load)


def both_run(script, *arguments):
    """Runs a script of this folder in two processes, given their ranks."""
    words = [sys.executable, str(Path(__file__).with_name(script))]
    how = {"env": environment(), "stderr": subprocess.PIPE, "text": True}
    both = [subprocess.Popen([*words, str(rank), *map(str, arguments)], **how) for rank in (0, 1)]
    errors = [process.communicate(timeout=540)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], "\n".join(errors)


def assert_same_losses(one, other, steps):
    losses, others = losses_of(one), losses_of(other)
    off = {step: abs(losses[step] - others[step]) / losses[step] for step in steps}
    print(f"largest relative difference of a step's loss: {max(off.values()):.1e}")
    assert max(off.values()) < SAME, off


def assert_same_training(one, other, steps, load):
    """Losses of two trainings, and their weights, which are stored in half precision."""
    assert_same_losses(one, other, steps)
    first, second = (load(folder / "model").state_dict() for folder in (one, other))
    for name in first:
        torch.testing.assert_close(first[name], second[name], rtol=2e-3, atol=2e-5)


def torchrun(processes, clips, out, fault="", restarts=0, **changes):
    """Command and environment of a training by torch's launcher, with a fault (see `learn_on_nodes.py`)."""
    usual = {"steps": STEPS, "batch_frames": 16, "checkpoint_every": 2, "log_every": 1}
    recipe = out.with_suffix(".yaml")
    recipe.write_text(dump_yaml(tiny(clips, **usual | changes)))
    command = [sys.executable, *"-m torch.distributed.run --rdzv-backend c10d --nnodes 1".split()]
    command += ["--rdzv-endpoint", "127.0.0.1:0", "--max-restarts", str(restarts), "--nproc-per-node", str(processes)]
    command += [str(Path(__file__).with_name("learn_on_nodes.py")), "learn", "--config", str(recipe), "--out", str(out)]
    return command, environment() | {"FAULT": fault, "TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"}


@pytest.mark.slow
def test_ctrl_c_under_torchrun_saves_the_step(clips, tmp_path):
    """The terminal sends the signal to all processes, and the launcher sends it on once more."""
    out = tmp_path / "out"
    command, variables = torchrun(2, clips, out, steps=5000, checkpoint_every=5000)
    process = subprocess.Popen(command, env=variables, start_new_session=True, stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 500
        while time.monotonic() < deadline and process.poll() is None:
            if (out / "steps").is_dir() or len(losses_of(out) if (out / "log.jsonl").is_file() else {}) > 1:
                break
            time.sleep(0.2)
        os.killpg(process.pid, signal.SIGINT)
        said = process.communicate(timeout=120)[1]
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode not in (0, None)
    saved = checkpoint.latest(out / "steps")
    assert saved is not None, said
    assert saved.step == max(losses_of(out)), said
    assert json.loads((out / "run.json").read_text())["state"] == "interrupted"


@pytest.mark.slow
def test_two_processes_then_one_then_four(clips, tmp_path):
    def run(processes, out, fault="", restarts=0):
        command, variables = torchrun(processes, clips, out, fault, restarts)
        done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=500)
        said = done.stdout + done.stderr
        assert (done.returncode == 0) is not fault.startswith("warn"), said
        return said

    whole, killed, changed = (tmp_path / name for name in ("whole", "killed", "changed"))
    run(1, whole)
    assert "resuming at step 2" in run(2, killed, "kill:3:1", 1)  # killed in step 4, resumed after step 2
    assert_same_losses(whole, killed, range(1, STEPS + 1))
    said = [run(2, changed, "warn:2:1"), run(1, changed, "warn:4:0"), run(4, changed)]
    assert ["143" in text for text in said[:2]] == [True, True]
    assert [re.findall(r"resuming at step (\d+)", text) for text in said] == [[], ["3"], ["5"]]
    assert set(re.findall(r"checkpoint of step (\d+)", "\n".join(said))) == {"2", "3", "4", "5", "6", "8"}
    assert_same_losses(whole, changed, range(1, STEPS + 1))
    assert sorted(p.name for p in (changed / "steps").iterdir()) == ["step_00000006", "step_00000008"]
    assert checkpoint.latest(changed / "steps").state["processes"] == 4


def test_draws_do_not_depend_on_the_part_of_a_batch(clips):
    source = learn.clips_of_cities(tiny(clips), clips)
    everything = source.draw(7, 4, 2, "batch")
    for part in (slice(0, 1), slice(1, 3), slice(3, 4)):
        for own, clip in zip(source.draw(7, 4, 2, "batch", part), everything[part], strict=True):
            assert torch.equal(own.rgb, clip.rgb)
            assert torch.equal(own.condition.semantics, clip.condition.semantics)
            assert torch.equal(own.condition.reference, clip.condition.reference)
            assert own.shift_m == clip.shift_m


def test_the_loss_of_a_batch_is_the_mean_of_its_parts(clips):
    model = MDM(models.model_config(tiny(clips)))
    models.draw_weights(model.net, 0, "weights")
    settings, balance = tiny(clips), class_weights(ShardFolder(clips), range(2), 0.5)

    def loss(part, step):
        drawn = learn.clips_of_cities(settings, clips).draw(step, 4, 2, "batch", part)
        own = BatchPart(settings.seed, step, part.start or 0, 4, balance, refined_share=0.5)
        return float(model(drawn, own).total.detach())

    for step in range(3):
        parts = [loss(slice(n, n + 1), step) for n in range(4)]
        assert sum(parts) / 4 == pytest.approx(loss(slice(None), step), rel=2e-6)


def test_portions_and_recomputing_change_nothing(clips, tmp_path):
    common = {"batch_frames": 8, "log_every": 1, "steps": 2}
    Learn(out=tmp_path / "plain", settings=tiny(clips, **common)).run()
    Learn(out=tmp_path / "portions", settings=tiny(clips, **common, accumulate=2, recompute=True)).run()
    assert_same_losses(tmp_path / "plain", tmp_path / "portions", (1, 2))


def test_clips_are_shared_evenly_or_not_at_all_and_bad_terms_are_named():
    taken = [part for rank in range(4) for part in Ranks(rank, 4, torch.device("cpu")).share(24, 3)]
    assert [n for part in taken for n in range(part.start, part.stop)] == list(range(24))
    with pytest.raises(UsageError, match="divided evenly"):
        Ranks(0, 4, torch.device("cpu")).share(6, 1)
    with pytest.raises(NumericsError, match=r"depth term of the network(.|\n)*step 4"):
        parallel.agreed_terms(ALONE, {"rgb": 1.0, "depth": float("nan")}, 1, 4, "network")
    assert parallel.agreed_terms(ALONE, {"rgb": 3.0}, 2, 4, "network") == ({"rgb": 1.5}, False)


def test_what_repeats_is_recomputed():
    first, second, outer = (
        nn.Sequential(nn.Linear(2, 2), nn.ModuleList([nn.Sequential(nn.Linear(2, 2))])) for _ in range(3)
    )
    part = nn.Sequential(nn.Linear(2, 2), nn.ModuleList([nn.ModuleList([first, second]), nn.Linear(2, 2), outer]))
    assert parallel.recompute(part) == 3
    assert [m for m in part.modules() if "forward" in vars(m)] == [first, second, outer]
