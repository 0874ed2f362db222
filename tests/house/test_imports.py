"""What importing costs, and what it must not load. Each check is a fresh process."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

HEAVY = ("torch", "torchvision", "scipy", "av", "PIL", "matplotlib", "cv2")


def fresh(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)


def loaded_by(code: str) -> list[str]:
    done = fresh(f"{code}\nimport sys, json; print(json.dumps([m for m in {HEAVY!r} if m in sys.modules]))")
    assert done.returncode == 0, done.stderr
    import json

    return json.loads(done.stdout.splitlines()[-1])


def test_importing_mudg_loads_nothing_heavy() -> None:
    assert loaded_by("import mudg") == []


def test_the_words_of_the_package_need_no_torch() -> None:
    assert "torch" not in loaded_by("import mudg; mudg.Camera, mudg.Scene, mudg.MudgError")


def test_the_command_line_answers_without_torch() -> None:
    commands = [["--help"], ["--version"], ["demo", "--help"], ["fit", "--help"], ["fit"], ["nonsense"]]
    code = f"""
import contextlib, sys
from mudg import app
for arguments in {commands!r}:
    with contextlib.suppress(SystemExit): app.main(arguments)
    assert not {{"torch", "scipy"}} & set(sys.modules), arguments
"""
    done = fresh(code)
    assert done.returncode == 0, done.stderr


def test_help_checks_no_setting() -> None:
    """Checking needs pydantic, which takes longer to import than all else that a page of help needs."""
    code = """
import sys
from mudg import app, steps
for verb in steps.VERBS:
    assert app.main([*verb.split(), "--help-all"]) == 0
    assert "pydantic" not in sys.modules, verb
"""
    done = fresh(code)
    assert done.returncode == 0, done.stderr


def best_of(count: int, command: list[str]) -> float:
    """Least processor time of several runs: what the program costs, not what else the machine does meanwhile."""
    times = []
    for _ in range(count):
        before = os.times()
        subprocess.run(command, capture_output=True, timeout=300, check=False)
        after = os.times()
        times.append(after.children_user + after.children_system - before.children_user - before.children_system)
    return min(times)


@pytest.fixture(scope="module")
def library_s() -> float:
    """What Python takes to import a piece of its own library."""
    code = "import asyncio, unittest.mock, xml.dom.minidom, email.message, http.client"
    return best_of(3, [sys.executable, "-c", code])


@pytest.mark.parametrize(
    "arguments",
    [
        ["-c", "import mudg"],
        ["-m", "mudg", "--help"],
        ["-m", "mudg", "run", "--help"],
        ["-m", "mudg", "learn", "--help"],
    ],
    ids=" ".join,
)
def test_starting_takes_a_third_of_a_second(arguments: list[str], library_s: float) -> None:
    """On a machine that is slow just now: less than six times what Python takes to import a piece of its own
    library."""
    allowed_s = max(0.35, 6 * library_s) * float(os.environ.get("MUDG_SLOW_MACHINE", "1"))
    assert best_of(3, [sys.executable, *arguments]) < allowed_s


def test_importing_everything_opens_no_connection_and_starts_no_thread() -> None:
    code = """
import socket, threading
def refuse(*args, **kwargs): raise SystemExit("a connection was opened")
socket.socket.connect = refuse
import mudg
for name in mudg.__all__: getattr(mudg, name)
print(threading.active_count())
"""
    done = fresh(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-1] == "1"
