"""Install the wheel in the situations that users are in, and run the demo in each.

    python tools/install_matrix.py WHEEL --work FOLDER
    python tools/install_matrix.py WHEEL --work FOLDER --python python3.11 python3.12 --pip-options '--find-links DIR'

Each interpreter gets an environment and `mudg demo --fast`. The first one is then used without a network, as another
user, with read-only packages, in a folder with spaces and letters, on one core, and its peak of memory is held against
2 GiB. Cases that this machine cannot make (no root, no such interpreter) are said to be left out. Prints a line per
case; the exit code is the number of failures.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from mudg.base import store

DEMO = ("demo", "--fast", "--out")
MOST_BYTES = 2 * 2**30
NOBODY = 65534


def main() -> int:
    """Try all cases; returns the number of failures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--python", nargs="+", default=["python3.11", "python3.12", "python3.13"])
    parser.add_argument("--pip-options", default="")
    given, failures = parser.parse_args(), 0
    for title, words, folder, check in cases(given):
        folder.mkdir(parents=True, exist_ok=True)
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False) if words else None
        problem = "left out" if done is None else "" if done.returncode == 0 else done.stderr.strip()[-300:]
        if done is not None and not problem:
            problem = check(folder)
        print(f"{title}: {problem or 'ok'}", flush=True)
        failures += bool(problem) and problem != "left out"
    return failures


def cases(given: argparse.Namespace) -> Iterator[tuple[str, Sequence[str], Path, object]]:
    """Title, command (empty: cannot be tried here), folder that it runs in, and what looks at the folder after."""
    work = given.work.resolve()
    found: list[Path] = []
    for name in given.python:
        program, venv = shutil.which(name), work / name.strip("/").replace("/", "-")
        works = (
            program is not None
            and not subprocess.run((program, "--version"), capture_output=True, check=False).returncode
        )
        install = f"{program} -m venv {venv} && {venv}/bin/pip install -q {given.pip_options} {given.wheel.resolve()}"
        yield f"{name}: install", ("bash", "-c", install) if works else (), work, lambda _folder: ""
        if (venv / "bin" / "mudg").is_file():
            found.append(venv)
            yield f"{name}: demo", (str(venv / "bin" / "mudg"), *DEMO, "demo"), work / f"run {venv.name}", report_of
    if not found:
        return
    mudg, root = str(found[0] / "bin" / "mudg"), os.geteuid() == 0
    alone = ("unshare", "-rn") if shutil.which("unshare") else ()
    yield "no network", (*alone, mudg, *DEMO, "demo") if alone else (), work / "alone", report_of
    odd = work / "Straße mit Leerzeichen 街"
    yield "spaces and letters", (mudg, *DEMO, "démo run"), odd, report_of
    yield (
        "one core",
        ("taskset", "-c", "0", mudg, *DEMO, "demo") if shutil.which("taskset") else (),
        work / "one",
        report_of,
    )
    yield "at most 2 GiB", ("true",), work / f"run {found[0].name}", memory_of
    home = Path("/tmp/mudg_nobody")
    user = f"install -d -o {NOBODY} {home} && chmod -R a-w {found[0]}/lib && cd {home} && rm -rf demo && "
    user += f"setpriv --reuid={NOBODY} --clear-groups env HOME={home} {mudg} {shlex.join(DEMO)} demo"
    program = (found[0] / "bin" / "python").resolve()  # an interpreter in somebody's home is closed to others
    reached = all(folder.stat().st_mode & 0o001 for folder in program.parents)
    yield "another user, read-only packages", ("bash", "-c", user) if root and reached else (), home, report_of


def report_of(folder: Path) -> str:
    """Whether a demo left its pages."""
    pages = list(folder.glob("*/report.html"))
    return "" if pages and pages[0].stat().st_size > 100_000 else "no report"


def memory_of(folder: Path) -> str:
    """Whether no step of a demo took more than the limit."""
    steps = store.read_json(folder / "demo" / "run.json")["steps"]
    peak = max(step["peak_bytes"] or 0 for step in steps.values())
    return "" if peak <= MOST_BYTES else f"{peak / 2**30:.2f} GiB"


if __name__ == "__main__":
    sys.exit(main())
