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


@pytest.mark.parametrize(
    "arguments", [["--help"], ["--version"], ["demo", "--help"], ["fit", "--help"], ["fit"], ["nonsense"]]
)
def test_the_command_line_answers_without_torch(arguments: list[str]) -> None:
    code = f"import contextlib\nfrom mudg import app\nwith contextlib.suppress(SystemExit): app.main({arguments!r})"
    found = loaded_by(code)
    assert "torch" not in found
    assert "scipy" not in found


def best_of(count: int, command: list[str]) -> float:
    """Least processor time of several runs: what the program costs, not what else the machine does meanwhile."""
    times = []
    for _ in range(count):
        before = os.times()
        subprocess.run(command, capture_output=True, timeout=300, check=False)
        after = os.times()
        times.append(after.children_user + after.children_system - before.children_user - before.children_system)
    return min(times)


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
def test_starting_takes_less_than_half_a_second(arguments: list[str]) -> None:
    """On a machine that is slow just now: less than six times what Python takes to import a piece of its own library."""
    library = best_of(
        3, [sys.executable, "-c", "import asyncio, unittest.mock, xml.dom.minidom, email.message, http.client"]
    )
    allowed_s = max(0.45, 6 * library) * float(os.environ.get("MUDG_SLOW_MACHINE", "1"))
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
