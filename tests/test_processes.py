"""Other processes: an error that comes from one is its own, and workers end with their parent."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

from mudg.base.errors import NumericsError
from mudg.base.processes import error_from_record, error_record, process_alive

PATIENCE_S = 60.0


def wait_for(path: Path) -> None:
    """Until the file is there."""
    end = time.monotonic() + PATIENCE_S
    while not path.exists():
        if time.monotonic() > end:
            raise TimeoutError(str(path))
        time.sleep(0.01)


def folders(root: Path, *names: str) -> list[Path]:
    made = [root / name for name in names]
    for folder in made:
        folder.mkdir()
    return made


def test_an_error_crosses_a_process_boundary_as_it_is() -> None:
    sent = NumericsError("a loss is not finite", where="view 3, step 9", got="nan", remedy="look")
    error = error_from_record(json.loads(json.dumps(error_record(sent))))
    assert isinstance(error, NumericsError)
    assert (error.what, error.where, error.got, error.remedy) == (sent.what, sent.where, sent.got, sent.remedy)
    assert error.exit_code == 6


def sleep_long(folder: Path) -> None:
    """Says which process it is, and works for longer than any test waits."""
    (folder / "started").write_text(str(os.getpid()))
    time.sleep(600)


def test_workers_of_a_parent_that_is_killed_end(tmp_path: Path) -> None:
    (folder,) = folders(tmp_path, "a")
    script = (
        "import sys; sys.path[:0] = sys.argv[2:]\nfrom pathlib import Path\nimport test_processes as t\n"
        "from mudg.base.processes import run_in_processes\n"
        "if __name__ == '__main__': list(run_in_processes(t.sleep_long, [(Path(sys.argv[1]),)] * 2, 2))"
    )
    (tmp_path / "parent.py").write_text(script)
    places = [str(Path(__file__).parent), *(path for path in sys.path if path)]
    parent = subprocess.Popen([sys.executable, str(tmp_path / "parent.py"), str(folder), *places])
    wait_for(folder / "started")
    time.sleep(0.2)
    worker = int((folder / "started").read_text())
    parent.kill()
    parent.wait()
    for _ in range(200):
        if not process_alive(worker):
            return
        time.sleep(0.1)
    os.kill(worker, 9)
    raise AssertionError("the worker outlived its parent")
