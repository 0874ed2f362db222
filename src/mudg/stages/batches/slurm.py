"""Slurm: a batch as one array job of plain ``sbatch``. Its tasks are ``mudg batch run --engine env``."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from mudg.base import store
from mudg.base.errors import ResourceError, UsageError

_POLL_S: Final = 10.0
_OPTION_NAMES: Final = frozenset({"array", "job-name", "signal", "requeue", "no-requeue", "open-mode", "output"})
"""Options that the script sets itself."""


@dataclass(frozen=True)
class SlurmJob:
    """An array job. words: command line of a task; folder: where tasks run; output: pattern of their logs; options: of sbatch."""

    words: tuple[str, ...]
    shards: int
    folder: str
    output: str
    grace_s: float
    at_once: int = 0
    options: tuple[str, ...] = ()


def script_of(job: SlurmJob) -> str:
    """The text of the batch script.

    Slurm sends USR1 to the script some time before the limit, and TERM when it takes the node away. The script passes either on,
    waits for the checkpoint, and puts the task back into the queue if that is why it ended (exit code 143).

    Raises:
        UsageError: an option that the script sets itself, or one of several lines.
    """
    for option in job.options:
        name = option.partition("=")[0]
        if name in _OPTION_NAMES or name.startswith("-") or any(letter in option for letter in "\n\r"):
            raise UsageError("not an option for the array job", where="--slurm-options", got=option[:80],
                expected="NAME or NAME=VALUE without dashes, other than " + ", ".join(sorted(_OPTION_NAMES)))  # fmt: skip
    at_once = f"%{job.at_once}" if job.at_once else ""
    lines = [
        "#!/bin/bash",
        "#SBATCH --job-name=mudg-batch",
        f"#SBATCH --array=0-{job.shards - 1}{at_once}",
        "#SBATCH --requeue",
        "#SBATCH --open-mode=append",
        f"#SBATCH --signal=B:USR1@{int(job.grace_s) + 20}",
        f"#SBATCH --output={job.output}",
        *(f"#SBATCH --{option}" for option in job.options),
        "",
        f"cd {shlex.quote(job.folder)} || exit 2",
        "pass_on() { kill -TERM \"$child\" 2>/dev/null; }",
        "trap pass_on USR1 TERM",
        f"{shlex.join(job.words)} &",
        "child=$!",
        "wait \"$child\"",
        "while kill -0 \"$child\" 2>/dev/null; do wait \"$child\"; done",
        "wait \"$child\"  # one that a signal cut short does not say how the task ended",
        "code=$?",
        "if [ \"$code\" -eq 143 ]; then",
        "  scontrol requeue \"${SLURM_ARRAY_JOB_ID}_${SLURM_ARRAY_TASK_ID}\" && sleep 60",
        "fi",
        "exit \"$code\"",
    ]
    return "\n".join(lines) + "\n"


def task_words(words: Sequence[str], shards: int) -> tuple[str, ...]:
    """The command line of a task: the submitted one with engine ``env``.

    Args:
        words: behind ``mudg``.
    """
    kept: list[str] = []
    skip = False
    for word in words:
        if skip:
            skip = False
        elif word in ("--engine", "--shards"):
            skip = True
        elif word != "--wait" and not word.startswith(("--engine=", "--shards=")):
            kept.append(word)
    return (sys.executable, "-m", "mudg", *kept, "--engine", "env", "--shards", str(shards), "--quiet")


class SlurmArray:
    """A submitted array job."""

    def __init__(self, job: SlurmJob) -> None:
        self._job = job
        self.number = ""

    def submit(self) -> str:
        """Hand the job to Slurm; returns its number.

        Raises:
            ResourceError: there is no Slurm, or it refuses.
        """
        if shutil.which("sbatch") is None:
            remedy = "run this on a login node, or take another --engine"
            raise ResourceError("there is no Slurm on this machine", where="sbatch", remedy=remedy)
        store.make_folder(Path(self._job.output).parent)
        self.number = _said(["sbatch", "--parsable"], script_of(self._job)).strip().split(";")[0]
        return self.number

    def poll(self) -> int:
        """Tasks that wait or run."""
        return len(_said(["squeue", "--noheader", "--array", "--jobs", self.number, "--format", "%i"], "", "Invalid job id").split())

    def cancel(self) -> None:
        """Take the job out of the queue; running tasks write their checkpoints."""
        _said(["scancel", self.number])

    def wait(self) -> None:
        """Wait until no task is left."""
        while self.poll():
            time.sleep(_POLL_S)


def _said(words: Sequence[str], given: str = "", taken: str = "") -> str:
    """What a program of Slurm says; taken: an error that counts as an empty answer."""
    done = subprocess.run(list(words), input=given, capture_output=True, text=True, check=False, timeout=120)
    if done.returncode and not (taken and taken in done.stderr):
        raise ResourceError("Slurm refused", where=shlex.join(words), got=done.stderr.strip()[:500])
    return "" if done.returncode else done.stdout
