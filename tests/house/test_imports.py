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


def processor_s(*words: str) -> float:
    """Processor time of Python with these words: what it costs, not what else the machine does meanwhile."""
    before = os.times()
    subprocess.run([sys.executable, *words], capture_output=True, timeout=300, check=False)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


LIBRARY = "import asyncio, unittest.mock, xml.dom.minidom, email.message, http.client"


@pytest.mark.parametrize("words", ["-c import\tmudg", "-m mudg --help", "-m mudg run --help", "-m mudg learn --help"])
def test_starting_takes_a_third_of_a_second(words: str) -> None:
    """In one of three runs; on a machine that is slow just now, less than six times what Python takes to import a piece
    of its own library."""
    slow = float(os.environ.get("MUDG_SLOW_MACHINE", "1"))
    if not any(processor_s(*words.split(" ")) < 0.35 * slow for _ in range(3)):
        library_s = min(processor_s("-c", LIBRARY) for _ in range(3))
        assert processor_s(*words.split(" ")) < 6 * library_s * slow
