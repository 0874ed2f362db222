"""Training whose processes are killed, warned and changed in number: the losses of an uninterrupted run."""

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from test_learn_parallel import environment
from toy_clips import losses_of, training_words, write_clips

from mudg.base import checkpoint

pytestmark = pytest.mark.slow
SAME = 1e-6
"""Relative."""
STEPS = 8


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("clips"))


def start(processes, clips, out, fault="", restarts=0, **changes):
    nodes = ("--nnodes", "1", "--rdzv-endpoint", "127.0.0.1:0", "--max-restarts", str(restarts))
    command, variables = torchrun(nodes, processes, clips, out, fault, **changes)
    return subprocess.run(command, env=variables, capture_output=True, text=True, timeout=500)


def torchrun(nodes, processes, clips, out, fault="", **changes):
    """Command and environment of a training with `processes` on this node."""
    usual = {
        "steps": STEPS,
        "data.clips-per-city": 2,
        "network.finish-widths": "8 16",
        "network.finish-blocks": "1 1",
        "optimizer.batch-frames": 16,
        "optimizer.warmup-steps": 1,
        "score.every": 100,
        "precision": "float32",
        "compute.checkpoint-every": 2,
        "compute.checkpoints-kept": 3,
    }
    words = training_words(clips, out, **usual | changes)
    here = Path(__file__).parent
    command = [sys.executable, *"-m torch.distributed.run --rdzv-backend c10d".split(), *nodes]
    command += ["--nproc-per-node", str(processes), str(here / "learn_on_nodes.py"), "learn", *words]
    return command, environment() | {"FAULT": fault, "TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"}


def test_two_processes_then_one_then_four(clips, tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    done = start(1, clips, whole)
    assert done.returncode == 0, done.stderr
    said = []
    done = start(2, clips, parts, "kill:3:1", restarts=1, **{"steps": STEPS, "compute.parallel": "fsdp"})
    # killed in step 4, resumed after step 2
    assert done.returncode == 0 and "resuming at step 2" in done.stderr + done.stdout, done.stderr
    assert max_difference(whole, parts) < SAME

    parts = tmp_path / "changed"
    for processes, fault, changes in (
        (2, "warn:2:1", {"compute.parallel": "fsdp"}),
        (1, "warn:4:0", {}),
        (4, "", {"compute.parallel": "fsdp"}),
    ):
        done = start(processes, clips, parts, fault, **changes)
        said.append(done.stdout + done.stderr)
        assert (done.returncode == 0) is (not fault), done.stderr
        if fault:
            assert "143" in said[-1], said[-1]
    assert [re.findall(r"resuming at step (\d+)", text) for text in said] == [[], ["3"], ["5"]]
    times = re.findall(r"checkpoint of step (\d+) in ([\d.]+) s", "\n".join(said))
    print("checkpoints:", times, f"largest relative difference of a loss: {max_difference(whole, parts):.1e}")
    assert {step for step, _ in times} == {"2", "3", "4", "5", "6", "8"}
    assert max_difference(whole, parts) < SAME
    kept = sorted(p.name for p in (parts / "steps").iterdir())
    assert kept == ["step_00000005", "step_00000006", "step_00000008"]
    newest = checkpoint.latest(parts / "steps")
    assert newest is not None and newest.state["processes"] == 4
    assert len(list(newest.path.glob("net.*.safetensors"))) == 4


def test_a_node_that_vanishes_leaves_the_training_to_the_other(clips, tmp_path):
    """Two nodes, each with its own torchrun; all of the second is killed without a word. `--nnodes 1:2` lets the first
    go on alone."""
    steps = 30
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert start(1, clips, whole, steps=steps).returncode == 0
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    nodes = f"--nnodes 1:2 --rdzv-id training --rdzv-endpoint 127.0.0.1:{port} --max-restarts 3 --rdzv-conf".split()
    patience = "last_call_timeout=5,keep_alive_interval=1,keep_alive_max_attempt=3"
    said = [(tmp_path / f"node{number}").open("w+") for number in range(2)]
    running = []
    for number, end in enumerate(("is_host=true", "is_host=false")):
        command, variables = torchrun((*nodes, f"{patience},{end}"), 1, clips, out, steps=steps)
        running.append(subprocess.Popen(command, env=variables, stdout=said[number], stderr=subprocess.STDOUT))
    try:
        began = time.monotonic()
        while not (out / "log.jsonl").is_file() or len(losses_of(out)) < 4:
            assert time.monotonic() - began < 200 and running[1].poll() is None, Path(said[0].name).read_text()
            time.sleep(0.05)
        kill_all(running[1].pid)
        assert running[0].wait(300) == 0, Path(said[0].name).read_text()
    finally:
        for one in running:
            kill_all(one.pid)
            one.wait()
        for file in said:
            file.close()
    text = (tmp_path / "node0").read_text()
    assert re.search(r"resuming at step \d+", text), text
    assert checkpoint.latest(out / "steps").state["processes"] == 1
    assert max_difference(whole, out, steps) < SAME


def kill_all(pid):
    """A process and all that it has started: torchrun gives every worker a session of its own."""
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in children.read_text().split():
            kill_all(int(child))
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def max_difference(one, other, steps=STEPS):
    first, second = losses_of(one), losses_of(other)
    assert set(first) == set(second) == set(range(1, steps + 1))
    return max(abs(first[step] - second[step]) / abs(first[step]) for step in first)
