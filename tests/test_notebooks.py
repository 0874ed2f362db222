"""The notebooks run from their first cell to their last, on small settings, and hold no outputs."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "docs" / "notebooks"
SMALL = {"FRAMES": 4, "WIDTH": 96, "HEIGHT": 64, "STEPS": 20, "LESSONS": 2}


def cells(name: str) -> list[dict]:
    return json.loads((FOLDER / name).read_text())["cells"]


def test_every_notebook_is_known() -> None:
    assert sorted(path.name for path in FOLDER.iterdir()) == ["dataset.ipynb", "edit.ipynb", "look.ipynb"]


@pytest.mark.parametrize("name", ["look.ipynb", "edit.ipynb", "dataset.ipynb"])
def test_a_notebook_runs(name: str, tmp_path: Path) -> None:
    """As one program in an empty folder. Its links lead to pages, and no output is stored in it."""
    code = [cell for cell in cells(name) if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    text = "\n\n".join("".join(cell["source"]) for cell in code)
    (settings,) = re.findall(r"^([A-Z, ]+) = [0-9, ]+$", text, re.MULTILINE)
    values = ", ".join(str(SMALL[key]) for key in settings.split(", "))
    text = re.sub(rf"^{settings} = .*$", f"{settings} = {values}", text, flags=re.MULTILINE)
    run = subprocess.run([sys.executable, "-c", text], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr[-3000:]
    for link in re.findall(r"\]\(([^)#]+)", "".join("".join(cell["source"]) for cell in cells(name))):
        assert link.startswith("https:") or (FOLDER / link).is_file(), link
