"""The fault matrix: every row names a test, and that exists."""

from __future__ import annotations

import re
from pathlib import Path

TESTS = Path(__file__).resolve().parent
PAGE = TESTS.parent / "docs" / "reliability.md"


def test_every_promise_of_the_matrix_has_its_test() -> None:
    matrix = PAGE.read_text(encoding="utf-8").partition("## The fault matrix")[2].partition("\n## ")[0]
    rows = [line for line in matrix.splitlines() if line.startswith("| ") and not line.startswith("| fault")]
    assert len(rows) > 40
    for row in rows:
        (name,) = re.findall(r"`tests/([\w/]+\.py)::(\w+)` \|$", row)
        assert re.search(rf"^def {name[1]}\(", (TESTS / name[0]).read_text(encoding="utf-8"), re.MULTILINE), row
        slow = re.search(
            rf"slow(?:\n@pytest\.mark\.parametrize[^\n]*)*\ndef {name[1]}\(",
            (TESTS / name[0]).read_text(encoding="utf-8"),
        )
        assert bool(slow) == ("*slow*" in row) or name[0] in ("test_run.py", "test_fit.py"), row
