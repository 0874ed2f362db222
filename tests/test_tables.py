"""Tables of text: one renderer for Markdown, CSV and pages."""

from mudg.base import html
from mudg.base.html import PUBLISHED, TextCell, TextLine, TextTable, best_of, markdown, markdown_table

TABLE = TextTable(
    ("", "FID ↓", "a_b"),
    (
        TextLine("A paper's & method", (TextCell("50.00"), TextCell("")), PUBLISHED),
        TextLine("the truth", (TextCell("6.00"), TextCell("-")), "anchor"),
        TextLine("ours (mudg_s)", (TextCell("45 %", best=True), TextCell("-")), "ours"),
    ),
    "2 m",
)


def test_markdown_marks_the_best():
    assert markdown(TABLE) == [
        "|  | FID ↓ | a_b |",
        "|---|---|---|",
        "| A paper's & method | 50.00 |  |",
        "| the truth | 6.00 | - |",
        "| ours (mudg_s) | **45 %** | - |",
    ]
    assert markdown_table(["a", "b"], []) == ["| a | b |", "|---|---|"]


def test_a_page_escapes_cells_and_marks_lines():
    evil = TextTable(("", "n"), (TextLine("<script>", (TextCell("<b>", best=True),), "n"),), "<i>")
    empty = {name: [] for name in ("notes", "below", "films", "walls", "log_choices", "shift_choices")}
    sections = [{"title": "s", "tables": [TABLE, evil], **empty}]
    text = html.render("bench.html.j2", title="t", kicker="k", lead="l", footer="", sections=sections)
    row = '<tr class="n"><th scope="row">&lt;script&gt;</th><td><strong>&lt;b&gt;</strong></td></tr>'
    assert "<script>" not in text and row in text
    assert '<tr class="published">' in text and "<h3>2 m</h3>" in text and "<h3>&lt;i&gt;</h3>" in text


def test_the_best_of_a_column():
    for better, best in (("higher", ["b"]), ("lower", ["a"]), ("one", ["c"])):
        assert best_of(better, {"a": 0.4, "b": 1.3, "c": 0.9}) == best and best_of(better, {"a": 1.0}) == []
    assert best_of("lower", {"a": 0.1, "b": 0.1, "c": 0.2}) == ["a", "b"]
