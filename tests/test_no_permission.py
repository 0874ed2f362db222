"""A user who is not root, before closed files and folders: errors in words, and what can go on goes on."""

from __future__ import annotations

import contextlib
import encodings.ascii  # noqa: F401
import os
import shutil
import tempfile
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import toy_views
from test_gallery import run_of
from toy_clips import tiny

from mudg import app
from mudg.base.errors import ResourceError
from mudg.diffusion import learn
from mudg.diffusion.settings import LearnConfig
from mudg.viewer import gallery

NOBODY = 65534
pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="users are those of Unix")


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A temporary folder that everybody may enter and write to."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o777)
    yield folder
    for path in [folder, *folder.rglob("*")]:
        path.chmod(0o777)
    shutil.rmtree(folder)


def as_nobody(work: Callable[[], object], said: Path) -> int:
    """Exit code of the work in a copy of this process that is not root's; what it says on stderr goes to a file."""
    child = os.fork()
    if child == 0:
        code = 99
        try:
            with said.open("w") as file, contextlib.redirect_stderr(file):
                if os.geteuid() == 0:
                    os.setgroups([])
                    os.setresgid(NOBODY, NOBODY, NOBODY)
                    os.setresuid(NOBODY, NOBODY, NOBODY)
                found = work()
                code = found if isinstance(found, int) else 0
        finally:
            if code == 99:
                traceback.print_exc()
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.mark.parametrize(
    ("closed", "mode", "code", "words"),
    [
        ("scene", 0, 5, "access to a file was refused"),
        ("scene/scene.json", 0, 3, "file cannot be read"),
        ("scene/images/front/000000.png", 0, 3, "file cannot be read"),
        ("runs", 0o555, 5, "cannot create a folder"),
        ("fuse.yaml", 0, 3, "file cannot be read"),
    ],
)
def test_what_is_closed_is_said(
    closed: str, mode: int, code: int, words: str, open_folder: Path, tmp_path: Path
) -> None:
    toy_views.write_scene(open_folder / "scene", lidar=True)
    (open_folder / "fuse.yaml").write_text("voxel_m: 0.2\n")
    (open_folder / "runs").mkdir()
    (open_folder / "runs").chmod(0o777)
    for scene in ("scene", "none"):  # what it imports may lie where nobody else reads
        app.main(["fuse", str(open_folder / scene), "--out", str(tmp_path / "out")])
    scene, config, out = (str(open_folder / name) for name in ("scene", "fuse.yaml", "runs/out"))
    command = ["fuse", scene, "--config", config, "--out", out]
    (open_folder / closed).chmod(mode)
    assert as_nobody(lambda: app.main(command), tmp_path / "said") == code
    said = (tmp_path / "said").read_text()
    assert words in said and "Permission denied" in said and "Traceback" not in said


def test_a_closed_folder_is_listed_and_the_other_runs_are_shown(open_folder: Path, tmp_path: Path) -> None:
    run_of(open_folder / "runs" / "good")
    # what it imports may lie where nobody else reads
    gallery.run([open_folder / "runs", tmp_path / "none"], tmp_path / "all.html")
    run_of(open_folder / "runs" / "closed").chmod(0)
    (open_folder / "pages").mkdir()
    (open_folder / "pages").chmod(0o777)
    page = open_folder / "pages" / "all.html"
    assert as_nobody(lambda: gallery.run([open_folder / "runs"], page) and None, tmp_path / "said") == 0
    assert "access was refused" in page.read_text() and "1 finished runs" in page.read_text()


def test_clips_that_cannot_be_written_are_refused_before_any_is_made(open_folder: Path, tmp_path: Path) -> None:
    (open_folder / "clips").mkdir()
    (open_folder / "clips").chmod(0o555)
    config: LearnConfig = tiny(open_folder / "clips", workers=1)

    def begin() -> int:
        try:
            clips, rules = open_folder / "clips", learn.city_rules(config)
            with learn.making_clips(learn.clips_of_cities(config, clips), clips, rules):
                return 0
        except ResourceError as error:
            return error.exit_code

    assert as_nobody(begin, tmp_path / "said") == 5
