"""What importing costs, and what it must not load. Each check is a fresh process."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

LIGHT = """
import contextlib, sys
def unloaded(*names): assert not {*names} & set(sys.modules), {*names} & set(sys.modules)
import mudg
unloaded("torch", "torchvision", "scipy", "av", "PIL", "matplotlib", "cv2")
mudg.Camera, mudg.Scene, mudg.MudgError
unloaded("torch")
from mudg import app, steps
for words in ([], ["--help"], ["--version"], ["demo", "--help"], ["fit", "--help"], ["nonsense"]):
    with contextlib.suppress(SystemExit): app.main(words)
for verb in steps.VERBS:
    assert app.main([*verb.split(), "--help-all"]) == 0
    unloaded("torch", "scipy", "pydantic")
assert app.main(["fit"]) == 2
unloaded("torch", "scipy")
"""
QUIET = """
import socket, threading
def refuse(*args, **kwargs): raise SystemExit("a connection was opened")
socket.socket.connect = refuse
import mudg
for name in mudg.__all__: getattr(mudg, name)
assert threading.active_count() == 1
"""


@pytest.mark.parametrize("code", [LIGHT, QUIET], ids=["help loads nothing heavy", "no connection, no thread"])
def test_importing(code: str) -> None:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)
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


@pytest.mark.parametrize("words", ["-c import\tmudg", "-m mudg --help", "-m mudg run --help", "-m mudg learn --help"])
def test_starting_takes_a_third_of_a_second(words: str, library_s: float) -> None:
    """On a machine that is slow just now: less than six times what Python takes to import a piece of its own
    library."""
    allowed_s = max(0.35, 6 * library_s) * float(os.environ.get("MUDG_SLOW_MACHINE", "1"))
    assert best_of(3, [sys.executable, *words.split(" ")]) < allowed_s
