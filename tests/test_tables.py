"""Tables of text: one renderer for Markdown, LaTeX, CSV and pages."""

import csv
import io

from mudg.base import html
from mudg.base.html import PUBLISHED, TextCell, TextLine, TextTable, best_of, csv_text, latex, markdown, markdown_table

TABLE = TextTable(
    ("", "FID ↓", "a_b"),
    (
        TextLine("A paper's & method", (TextCell("50.00"), TextCell("")), PUBLISHED),
        TextLine("the truth", (TextCell("6.00"), TextCell("-", reason="no weights")), "anchor"),
        TextLine("ours (mudg_s)", (TextCell("45 %", best=True), TextCell("-", reason="no weights")), "ours"),
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


def test_latex_escapes_gives_reasons_and_sets_published_lines_apart():
    assert latex(TABLE) == [
        "% 2 m",
        "% -- a_b: no weights",
        r"\begin{tabular}{lrr}",
        r"\hline",
        r" & FID $\downarrow$ & a\_b \\",
        r"\hline",
        r"A paper's \& method & 50.00 &  \\",
        r"\hline",
        r"the truth & 6.00 & -- \\",
        r"ours (mudg\_s) & \textbf{45 \%} & -- \\",
        r"\hline",
        r"\end{tabular}",
    ]


def test_csv_quotes_what_it_must():
    text = csv_text(["row", "value"], [['a, "b"', 0.5], ["c", ""]])
    assert list(csv.reader(io.StringIO(text))) == [["row", "value"], ['a, "b"', "0.5"], ["c", ""]] and "\r" not in text


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
