"""The documentation: examples run, and every flag, setting, path and link that a page names exists.

A page's examples are its blocks marked ``console`` (lines that start with ``$``) and ``python``. A page stands alone:
its examples make all that they read, in one folder that all pages share, so what two pages make in the same way is made
once. The ``python`` blocks of a page share their names. One that needs something absent is preceded by a comment ``<!--
not run: reason -->``.
"""

from __future__ import annotations

import json
import re
import runpy
import shlex
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from mudg import app, native

REPOSITORY = Path(__file__).resolve().parents[1]
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
PRINTED = ("docs/reference/commands.md", "docs/reference/names.md")
"""Pages that the program prints (tools/reference.py)."""
TEXTS = [
    *(page for page in PAGES if page.relative_to(REPOSITORY).as_posix() not in PRINTED),
    REPOSITORY / "CONTRIBUTING.md",
]
FLAGS: dict[str, list[str]] = {
    verb: [*flags, *(re.sub(r"([^.-]+(?:-[^.]+)*)$", r"no-\1", flag) for flag in flags)]
    for verb, flags in json.loads((REPOSITORY / "tests" / "house" / "cli.json").read_text(encoding="utf-8")).items()
}

FOREIGN_FLAGS = {
    f"--{flag}": program
    for program, flags in {
        "torchrun": "nproc-per-node nnodes standalone rdzv-conf rdzv-backend rdzv-endpoint rdzv-id max-restarts"
        " signals-to-handle shutdown-timeout",
        "mudg": "version help help-all",
        "pytest": "dist",
        "zensical": "strict",
        "docker": "rm network gpus build-arg user",
        "hf": "local-dir",
        "sbatch": "nodes ntasks-per-node signal",
    }.items()
    for flag in flags.split()
}
FOLDERS = (
    "benchmarks fleet steps viewer scoring exporting editing diffusion baselines gaussians labels formats city scene"
    " networks core native base bench docs tests tools build_backend src"
).split()
GROUPS = "virtual loss densify poses objects appearance start optimizer compute network codec city".split()
FILE_ENDINGS = tuple(".py .json .jsonl .yaml .csv .txt .md .png .jpg .mp4 .html .pt .ckpt .safetensors".split())
FOREIGN_NAMES = (
    "PromptDepthAnything DepthLab DistributedDataParallel DynamiCrafter DeepSpeed SegFormer MergedPointCloud RayCluster"
    " RayJob"
).split()
LONG = "bench_shift gallery paper_tables results simulate/closed_loop start/demo training"
SLOW = tuple(f"docs/{page}.md" for page in LONG.split())
"""Pages whose examples take longer: benchmarks, the whole chain, drives. So do formats, training and tutorials."""


class Block(NamedTuple):
    """A fenced block of a page."""

    language: str
    text: str
    line: int
    skip: str


def name_of(page: Path) -> str:
    return page.relative_to(REPOSITORY).as_posix()


def takes_long(page: Path) -> bool:
    return page.parent.name in ("formats", "training", "tutorials") or name_of(page) in SLOW


def blocks(text: str) -> Iterator[Block]:
    """The fenced blocks of a page in order."""
    for found in re.finditer(r"(?:<!-- not run: (.+?) -->\n)?^```([a-z]*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        yield Block(found[2], found[3], text[: found.start()].count("\n") + 1, found[1] or "")


def commands(block: Block) -> list[str]:
    """The command lines of a ``console`` block; a backslash at the end of a line continues it."""
    found = re.findall(r"^\$ ((?:.*\\\n)*.*)$", block.text, re.MULTILINE)
    return [" ".join(command.replace("\\\n", " ").split()) for command in found]


def has_example(text: str) -> bool:
    return any(
        (b.language == "console" and commands(b)) or (b.language == "python" and not b.skip) for b in blocks(text)
    )


# --- examples run ---------------------------------------------------------------------------------


def run_command(command: str) -> None:
    """Run ``mudg ...`` or ``python FILE.py ...`` in this process; a failure raises."""
    program, *arguments = shlex.split(command, comments=True)
    if program == "mudg":
        assert app.main(arguments) == 0, command
    else:
        assert program == "python", f"a console example starts mudg or a script of the repository: {command}"
        before, path = sys.argv, list(sys.path)
        script = REPOSITORY / arguments[0]
        try:
            sys.argv = [str(script), *arguments[1:]]
            runpy.run_path(str(script), run_name="__main__")
        finally:
            sys.argv, sys.path[:] = before, path


def run_page(text: str, finished: set[str]) -> None:
    """Run the examples of a page in the current folder, leaving out commands that another page ran there."""
    names: dict[str, object] = {"__name__": "example"}
    for block in blocks(text):
        if block.language == "console":
            for command in commands(block):
                if command not in finished:
                    run_command(command)
                    finished.add(command)
        elif block.language == "python" and not block.skip:
            exec(compile(block.text, f"example at line {block.line}", "exec"), names)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, set[str]]:
    """The folder in which all examples run, and the commands that have run there."""
    return tmp_path_factory.mktemp("examples"), set()


@pytest.mark.skipif(native.library() is None, reason="the city needs the native library")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=name_of(page), marks=pytest.mark.slow if takes_long(page) else ())
        for page in PAGES
        if page.name != "python.md"  # its code runs in test_python.py
    ],
)
def test_examples_run(page: Path, shared: tuple[Path, set[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    folder, finished = shared
    monkeypatch.chdir(folder)
    run_page(page.read_text(encoding="utf-8"), finished)


@pytest.mark.parametrize("page", [p for p in PAGES[1:] if p.parent.name not in ("research", "reference")], ids=name_of)
def test_every_page_has_an_example(page: Path) -> None:
    """README's are its two lines, which `.ci/run` runs; pages of research and reference belong to one that has some."""
    text = page.read_text(encoding="utf-8")
    assert has_example(text), f"{name_of(page)} has no example that runs: a block marked console or python"
    fences = re.findall(r"^```.*$", text, re.MULTILINE)
    assert len(fences) % 2 == 0, f"{name_of(page)}: a fenced block is not closed"


@pytest.mark.parametrize(
    "broken",
    [
        "```console\n$ mudg fit scene --fused f --out o --iteratons 3\n```\n",
        "```console\n$ mudg doctor no/such/folder\n```\n",
        "```console\n$ mudg doctor \\\n    no/such/folder\n```\n",
        "```console\n$ rm -r scenes\n```\n",
        "```python\nimport mudg\nmudg.read_scenes('a')\n```\n",
    ],
)
def test_a_broken_example_fails(broken: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises((AssertionError, SystemExit, AttributeError)):
        run_page(broken, set())


# --- what pages name exists -----------------------------------------------------------------------


def code_in(text: str) -> Iterator[str]:
    """The code of a page: fenced and indented blocks, and what stands between backticks."""
    rest = text
    for block in re.findall(r"^```.*?^```$", text, re.MULTILINE | re.DOTALL):
        yield block
        rest = rest.replace(block, "")
    yield from re.findall(r"^ {4,}(?![*-] ).+$", rest, re.MULTILINE)
    yield from (found.replace("\n", " ") for found in re.findall(r"(?<!`)`([^`]+)`(?!`)", rest))


@cache
def script_flags() -> frozenset[str]:
    """Flags of the scripts of the repository."""
    scripts = [p for folder in ("bench", "tools", "build_backend") for p in (REPOSITORY / folder).glob("*.py")]
    return frozenset(f for p in scripts for f in re.findall(r'"(--[a-z][a-z0-9-]*)"', p.read_text(encoding="utf-8")))


def unknown_flags(text: str) -> list[str]:
    """Flags that nothing has, and flags that the verb in whose command they stand lacks."""
    known = {flag for flags in FLAGS.values() for flag in flags} | set(FOREIGN_FLAGS) | script_flags()
    problems = []
    for code in code_in(text):
        problems += [f for f in re.findall(r"(?<![\w-])--[a-z][a-z0-9.-]*", code) if f.rstrip(".") not in known]
        for verb, rest in re.findall(r"(?<![\w/.])mudg ([a-z]+)((?:\\\n|[^\n#])*)", code):
            flags = re.findall(r"(?<![\w-])--[a-z][a-z0-9.-]*", rest)
            problems += [f"mudg {verb} {f}" for f in flags if verb in FLAGS and f not in {*FLAGS[verb], *FOREIGN_FLAGS}]
    return problems


def unknown_settings(text: str) -> list[str]:
    """Settings written as ``group.name`` that no verb has as a flag."""
    known = {flag for flags in FLAGS.values() for flag in flags}
    found = [
        m for code in code_in(text) for m in re.findall(rf"(?<![\w./-])((?:{'|'.join(GROUPS)})\.[a-z][a-z0-9_]*)", code)
    ]
    return [name for name in found if "--" + name.replace("_", "-") not in known and not name.endswith(FILE_ENDINGS)]


@cache
def source() -> dict[str, str]:
    """The text of every module, keyed by its path."""
    return {str(p): p.read_text(encoding="utf-8") for p in (REPOSITORY / "src" / "mudg").rglob("*.py")}


def unknown_names(text: str) -> list[str]:
    """Functions written as ``module.name`` and classes, with or without a member, that the package lacks."""
    problems = []
    for code in re.findall(r"(?<!`)`([^`\n]+)`(?!`)", text):
        found = re.match(r"([a-z0-9_]+)\.([A-Za-z_]\w*)(?:\(|$)", code)
        homes = [t for p, t in source().items() if found and p.endswith(f"/{found[1]}.py")]
        if found and homes and found[1] not in GROUPS and not code.endswith(FILE_ENDINGS):
            known = any(re.search(rf"^(?:def |class )?{found[2]}\b", t, re.MULTILINE) for t in homes)
            problems += [] if known else [code]
        found = re.match(r"([A-Z][a-z]+[A-Z]\w*)(?:\.(\w+))?(?:\(|$)", code)
        if found:
            homes = [t for t in source().values() if re.search(rf"^class {found[1]}\b", t, re.MULTILINE)]
            known = any(found[2] is None or re.search(rf"\b{found[2]}\b", t) for t in homes)
            problems += [] if known or found[1] in FOREIGN_NAMES else [code]
    return problems


def unknown_paths(text: str) -> list[str]:
    """Files of the source tree that do not exist: Python and C++ paths, and folders that end in a slash."""
    roots = [REPOSITORY / folder for folder in ("", "src/mudg", "src", "docs", "src/mudg/data")]
    folders = ("src", "tests", "docs", "bench", "tools")
    names = {path.name for folder in folders for path in (REPOSITORY / folder).rglob("*.py")}
    problems = []
    for code in re.findall(r"(?<!`)`([^`\s]+)`(?!`)", text):
        path = code.split(":")[0].split("#")[0]
        is_folder = path.endswith("/") and path.count("/") > 1 and path.split("/")[0] in FOLDERS
        if not (path.endswith((".py", ".cpp", ".h")) or is_folder or (path.split("/")[0] in FOLDERS and "*" in path)):
            continue
        if "/" not in path:
            problems += [path] if path not in names else []
        elif not any(next(root.glob(path.rstrip("/")), None) for root in roots):
            problems.append(path)
    return problems


def anchors_of(text: str) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    plain = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    heads = re.findall(r"^#+ (.+)$", plain, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def broken_links(page: Path) -> list[str]:
    """Relative links to files or headings that are not there."""
    problems = []
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        goal = (page.parent / path) if path else page
        if not goal.exists() or (anchor and anchor not in anchors_of(goal.read_text(encoding="utf-8"))):
            problems.append(target)
    return problems


@pytest.mark.parametrize("page", TEXTS, ids=name_of)
def test_flags_settings_paths_names_and_links_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert not unknown_flags(text)
    assert not unknown_settings(text)
    assert not unknown_paths(text)
    assert not unknown_names(text)
    assert not broken_links(page)


def rows_after(text: str, heading: str) -> dict[str, list[str]]:
    """Label -> cells of the table whose heading begins so, emphasis removed."""
    table = text[text.index(heading) :].split("\n\n")[0].replace("*", "")
    rows = [[cell.strip() for cell in line.strip("| ").split("|")] for line in table.splitlines()]
    return {row[0]: row[1:] for row in rows}


def test_the_numbers_of_the_readme_are_those_of_the_results() -> None:
    """One version of every number: the README's table of the demo and its headline stand in docs/results.md, too."""
    readme, results = ((REPOSITORY / name).read_text(encoding="utf-8") for name in ("README.md", "docs/results.md"))
    lines = readme[readme.index("| | recorded | 2 m") :].split("\n\n")[0].replace("*", "").splitlines()[2:]
    columns = {"PSNR dB": "PSNR", "perceptual distance": "perceptual", "depth RMSE m": "RMSE m", "mIoU": "mIoU"}
    measure, checked = "", 0
    for line in lines:
        label, *cells = (cell.strip() for cell in line.strip().strip("|").split("|"))
        measure = label.split(":")[0] if ":" in label else measure
        method = re.sub(r" \(.*| with the nearest", "", label.split(": ")[-1])
        for cell, heading in zip(cells, ("| recorded path, held-out", "| 2 m |", "| 3 m |", "| 4 m |"), strict=True):
            if cell:
                table = rows_after(results, heading)
                head = heading.strip("| ") if heading.endswith("|") else "recorded path, held-out frames"
                column = table[head].index(columns[measure])
                assert table[method][column] == cell, f"{measure} of {method} ({heading}): README {cell}"
                checked += 1
    assert checked == 11
    gain = re.search(r"diffusion gains ([\d.]+) dB \(([\d.]+) to ([\d.]+)\)", readme)
    assert gain, "the README's headline"
    logs = re.search(r"PSNR \| \+([\d.]+) dB \([\d.]+; ([\d. ]+)\)", results)
    assert logs, "the table of the eight logs"
    each = [float(value) for value in logs[2].split()]
    assert (gain[1], float(gain[2]), float(gain[3])) == (logs[1], min(each), max(each))


def test_the_map_names_every_folder_of_the_package() -> None:
    text = (REPOSITORY / "docs" / "architecture.md").read_text(encoding="utf-8")
    package = REPOSITORY / "src" / "mudg"
    folders = {p.parent.relative_to(package).as_posix() for p in package.rglob("*.py")} - {"."}
    assert not {folder for folder in folders if f"`{folder}/`" not in text}


def test_what_does_not_exist_is_found(tmp_path: Path) -> None:
    assert unknown_flags("`mudg fit --shifts-m 2`") == ["mudg fit --shifts-m"]
    assert unknown_flags("```console\n$ mudg fit a \\\n  --virtual-probability 1\n```\n")
    assert not unknown_flags("`mudg fit --virtual.probability 0.4`, `--inplace`")
    assert unknown_settings("`virtual.probabilty`") == ["virtual.probabilty"]
    assert not unknown_settings("`virtual.probability`")
    names = ["losses.no_such", "NoSuch(a=1)", "SceneModel.no_such"]
    assert unknown_names(" ".join(f"`{name}`" for name in names)) == names
    assert not unknown_names("`losses.object_map` `SceneModel.without_nodes` `run.json`")
    paths = ["gaussians/no_such.py", "no_such.py", "diffusion/no_such/"]
    assert unknown_paths(" ".join(f"`{path}`" for path in paths)) == paths
    assert not unknown_paths("`gaussians/fit.py` `src/mudg/app.py` `diffusion/`")
    page = tmp_path / "page.md"
    page.write_text("# One head\n[a](other.md) [b](#one-head) [c](#two)", encoding="utf-8")
    assert broken_links(page) == ["other.md", "#two"]
