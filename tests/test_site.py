"""The site of the documentation builds without a dead link, and its menu names every page."""

from __future__ import annotations

import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest


def pages_of(menu: Any) -> list[str]:
    if isinstance(menu, str):
        return [menu]
    return [page for entry in (menu.values() if isinstance(menu, dict) else menu) for page in pages_of(entry)]


def test_the_menu_names_every_page_once(repository: Path) -> None:
    menu = tomllib.loads((repository / "zensical.toml").read_text(encoding="utf-8"))["project"]["nav"]
    there = sorted(page.relative_to(repository / "docs").as_posix() for page in (repository / "docs").rglob("*.md"))
    assert sorted(pages_of(menu)) == there


def test_the_front_page_links_to_every_page(repository: Path) -> None:
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
