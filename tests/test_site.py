"""The site of the documentation, its notebooks from their first cell to their last, and the fault matrix."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest


def pages_of(menu: Any) -> list[str]:
    if isinstance(menu, str):
        return [menu]
    return [page for entry in (menu.values() if isinstance(menu, dict) else menu) for page in pages_of(entry)]


def test_the_menu_names_every_page_once_and_the_front_page_links_to_it(repository: Path) -> None:
    menu = tomllib.loads((repository / "zensical.toml").read_text(encoding="utf-8"))["project"]["nav"]
    there = sorted(page.relative_to(repository / "docs").as_posix() for page in (repository / "docs").rglob("*.md"))
    assert sorted(pages_of(menu)) == there
    text = (repository / "docs" / "index.md").read_text(encoding="utf-8")
    pages = (page.relative_to(repository / "docs").as_posix() for page in (repository / "docs").rglob("*.md"))
    assert not [page for page in pages if page != "index.md" and f"]({page})" not in text]


def test_the_site_builds_strictly(repository: Path, tmp_path: Path) -> None:
    program = shutil.which("zensical")
    if program is None:
        pytest.skip("zensical is not installed (extra docs)")
    shutil.copytree(repository / "docs", tmp_path / "docs")
    shutil.copy(repository / "zensical.toml", tmp_path)
    done = subprocess.run([program, "build", "--strict"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert (tmp_path / "site" / "index.html").is_file()


TESTS = Path(__file__).resolve().parent
PAGE = TESTS.parent / "docs" / "reliability.md"


def test_every_promise_of_the_matrix_has_its_test() -> None:
    matrix = PAGE.read_text(encoding="utf-8").partition("## The fault matrix")[2].partition("\n## ")[0]
    rows = [line for line in matrix.splitlines() if line.startswith("| ") and not line.startswith("| fault")]
    assert len(rows) > 40
    for row in rows:
        (name,) = re.findall(r"`tests/([\w/]+\.py)::(\w+)` \|$", row)
        text = (TESTS / name[0]).read_text(encoding="utf-8")
        assert re.search(rf"^def {name[1]}\(", text, re.MULTILINE), row
        slow = re.search(rf"slow(?:\n@pytest\.mark\.parametrize[^\n]*)*\ndef {name[1]}\(", text)
        assert bool(slow) == ("*slow*" in row) or name[0] in ("test_run.py", "test_fit.py"), row


FOLDER = TESTS.parent / "docs" / "notebooks"
SMALL = {"FRAMES": 4, "WIDTH": 96, "HEIGHT": 64, "STEPS": 20, "LESSONS": 2}


@pytest.mark.slow
@pytest.mark.parametrize("name", [path.name for path in sorted(FOLDER.iterdir())])
def test_a_notebook_runs(name: str, tmp_path: Path) -> None:
    """As one program in an empty folder. Its links lead to pages, and no output is stored in it."""
    cells = json.loads((FOLDER / name).read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    text = "\n\n".join("".join(cell["source"]) for cell in code)
    (settings,) = re.findall(r"^([A-Z, ]+) = [0-9, ]+$", text, re.MULTILINE)
    values = ", ".join(str(SMALL[key]) for key in settings.split(", "))
    text = re.sub(rf"^{settings} = .*$", f"{settings} = {values}", text, flags=re.MULTILINE)
    run = subprocess.run([sys.executable, "-c", text], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr[-3000:]
    for link in re.findall(r"\]\(([^)#]+)", "".join("".join(cell["source"]) for cell in cells)):
        assert link.startswith("https:") or (FOLDER / link).is_file(), link
