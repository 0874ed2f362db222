"""A video on a full disk or under a limit of file size: an error in words, and nothing half-written."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

WRITES = """
import resource, sys
import numpy as np
from pathlib import Path
from mudg import app
from mudg.base import failures
from mudg.base.errors import ResourceError
from mudg.formats.exporters.video import write_mp4
resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
rng = np.random.default_rng(0)
try:
    write_mp4(Path(sys.argv[1]), (rng.integers(0, 255, (96, 160, 3), np.uint8) for _ in range(60)), 10.0)
except Exception as error:
    told = failures.in_words(error)
    assert isinstance(told, ResourceError), repr(error)
    print("in words", told.what)
else:
    print("written")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit of file size")
@pytest.mark.parametrize(
    "limit", [1000, 10_000_000, *(pytest.param(limit, marks=pytest.mark.slow) for limit in (1, 30_000))]
)
def test_a_video_that_does_not_fit_on_the_disk_ends_in_words(limit: int, tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", WRITES.format(limit=limit), str(tmp_path / "film.mp4")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith("written" if limit == 10_000_000 else "in words")
    assert [path.name for path in tmp_path.iterdir()] == (["film.mp4"] if limit == 10_000_000 else [])
