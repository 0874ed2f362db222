"""The build back-end: which compiler is chosen, what happens when one fails, what the wheel is called."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "build_backend"
pytestmark = pytest.mark.skipif(not FOLDER.exists(), reason="the build back-end is part of the source tree only")


def _load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def mc() -> ModuleType:
    """build_backend/mudg_compile.py."""
    return _load("mudg_compile")


def _completed(code: int = 0, out: str = "", error: str = "") -> subprocess.CompletedProcess[str]:
    return subprocess.CompletedProcess([], code, out, error)


def test_system_compilers_are_tried_in_order(mc: ModuleType) -> None:
    found = {"c++": "/bin/c++", "clang++": "/bin/clang++"}
    commands = [c.command for c in mc.system_candidates({"CXX": "ccache my-c++ -m64"}, which=found.get)]
    assert commands == [("ccache", "my-c++", "-m64"), ("/bin/c++",), ("/bin/clang++",)]
    commands = [c.command for c in mc.system_candidates({"CXX": "/bin/c++"}, which=found.get)]
    assert commands == [("/bin/c++",), ("/bin/clang++",)]
    assert mc.system_candidates({}, which=lambda name: None) == []


def test_the_first_compiler_that_works_is_taken_and_the_log_says_why(mc: ModuleType) -> None:
    broken, good, spare = (mc.Compiler((name,), "system") for name in ("broken", "good", "spare"))

    def check(compiler: object) -> object:
        reason = "cannot build a small C++17 library: no headers" if compiler is broken else ""
        return mc.ProbeResult(not reason, reason, "good 1.0", True)

    chosen, notes = mc.find_compiler([broken, good, spare], check)
    assert chosen.command == ("good",) and chosen.x86_64
    assert "no headers" in notes[0] and notes[1].startswith("using good")
    assert mc.find_compiler([broken], check)[0] is None


def test_the_probe_reports_every_way_to_fail(mc: ModuleType) -> None:
    compiler = mc.Compiler(("cc",), "system")

    def missing(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
        raise FileNotFoundError("cc")

    assert "cannot be started" in mc.probe(compiler, missing).reason
    refusing = mc.probe(compiler, lambda command: _completed(1, error="error: unknown flag"))
    assert not refusing.works and "unknown flag" in refusing.reason

    def foreign(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
        if command[0] == "cc":
            Path(command[-1]).write_bytes(b"")
            return _completed()
        return _completed(1, error="OSError: wrong ELF class")

    assert "wrong ELF class" in mc.probe(compiler, foreign).reason


def _build(mc: ModuleType, tmp_path: Path, mode: str, failing: set[str], working: Sequence[str]) -> object:
    candidates = [mc.Compiler((name,), "ziglang" if name == "zig" else "system") for name in working]

    def compile_with(compiler: object, library: Path, objects: Path) -> list[str]:
        name = compiler.command[0]
        if name in failing:
            raise mc.CompileError(f"raster.cpp does not compile with {name}")
        library.write_bytes(b"library")
        return []

    check = lambda _: mc.ProbeResult(True, version="1")
    how = {"candidates": candidates, "check": check, "compile_with": compile_with}
    return mc.build(tmp_path, tmp_path / "objects", {"MUDG_NATIVE": mode}, **how)


def test_a_failing_compile_hands_over_to_the_next_compiler(mc: ModuleType, tmp_path: Path) -> None:
    outcome = _build(mc, tmp_path, "auto", {"gcc"}, ["gcc", "zig"])
    assert outcome.library == tmp_path / mc.LIBRARY_NAME and outcome.compiler.kind == "ziglang"
    assert any("does not compile with gcc" in note for note in outcome.notes)


def test_without_any_compiler_the_build_goes_on_and_says_so(mc: ModuleType, tmp_path: Path) -> None:
    outcome = _build(mc, tmp_path, "auto", set(), [])
    assert outcome.library is None and "no C++ compiler was found" in outcome.reason
    assert all(word in mc.report(outcome) for word in ("pure Python", "ziglang"))
    stored = json.loads(mc.write_build_info(outcome, tmp_path).read_text())
    assert stored["native"] is False and "no C++ compiler" in stored["reason"]


def test_the_mode_says_whether_there_has_to_be_a_library(mc: ModuleType, tmp_path: Path) -> None:
    for mode, failing, working, said in (
        ("auto", {"gcc", "zig"}, ["gcc", "zig"], "does not compile with zig"),
        ("off", set(), ["gcc"], "off"),
    ):
        outcome = _build(mc, tmp_path, mode, failing, working)
        assert outcome.library is None and said in outcome.reason
    with pytest.raises(mc.CompileError, match="MUDG_NATIVE=require"):
        _build(mc, tmp_path, "require", {"gcc"}, ["gcc"])
    assert _build(mc, tmp_path, "require", set(), ["gcc"]).library is not None
    with pytest.raises(mc.CompileError, match="auto, require, off"):
        mc.native_mode({"MUDG_NATIVE": "maybe"})
    assert mc.native_mode({}) == mc.native_mode({"MUDG_NATIVE": ""}) == "auto"
    assert mc.native_mode({"MUDG_NATIVE": " Off "}) == "off"


def test_flags_and_sources_follow_the_processor_and_the_compiler(mc: ModuleType) -> None:
    gcc, zig = mc.Compiler(("g++",), "system", x86_64=True), mc.Compiler(("zig",), "ziglang", x86_64=True)
    assert "-mavx512f" in mc.flags_for(gcc, Path("kernels_avx512.cpp"))
    assert "-mavx2" in mc.flags_for(gcc, Path("kernels_avx2.cpp"))
    assert not [f for f in mc.flags_for(gcc, Path("zbuffer.cpp")) if f.startswith("-m")]
    assert "-mcpu=baseline" in mc.flags_for(zig, Path("zbuffer.cpp"))
    assert any("avx512f" in f for f in mc.flags_for(zig, Path("kernels_avx512.cpp")))
    for compiler in (gcc, zig):
        flags = mc.flags_for(compiler, Path("kernels_avx2.cpp"))
        assert "-ffp-contract=off" in flags and "-ffast-math" not in flags
    plain, x86 = ({p.name for p in mc.sources_for(mc.Compiler(("c++",), "system", x86_64=x))} for x in (False, True))
    assert "kernels_portable.cpp" in plain and x86 - plain == {"kernels_avx2.cpp", "kernels_avx512.cpp"}


def test_object_files_are_named_after_all_they_depend_on(mc: ModuleType, tmp_path: Path) -> None:
    compiler = mc.Compiler(("c++",), "system", "1.0")
    (tmp_path / "a.cpp").write_text('#include "b.h"\nint x;\n')
    (tmp_path / "b.h").write_text('#  include "c.h"\n')
    (tmp_path / "c.h").write_text("// one\n")
    digest = lambda by=compiler, flag="-O3": mc.digest_of(by, (flag,), tmp_path / "a.cpp")
    first = digest()
    assert first == digest() and first not in (digest(flag="-O2"), digest(mc.Compiler(("c++",), "system", "2.0")))
    (tmp_path / "c.h").write_text("// two\n")
    assert first != digest()


@pytest.mark.skipif(importlib.util.find_spec("setuptools") is None, reason="setuptools is not installed")
def test_the_backend_asks_for_ziglang_only_without_a_system_compiler(
    mc: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("setuptools.command.bdist_wheel")
    backend = _load("mudg_build")
    monkeypatch.delenv("MUDG_NATIVE", raising=False)
    monkeypatch.setattr(backend.mudg_compile, "find_compiler", lambda candidates: (mc.Compiler(("c++",), "system"), []))
    assert backend.extra_requirements() == []
    places = (("linux", "x86_64"), ("darwin", "arm64"), ("linux", "sparc64"), ("sunos5", "x86_64"))
    assert [mc.zig_is_offered(*place) for place in places] == [True, True, False, False]
    monkeypatch.setattr(backend.mudg_compile, "find_compiler", lambda candidates: (None, ["c++ is broken"]))
    for offered, wanted in ((True, ["ziglang"]), (False, [])):
        monkeypatch.setattr(backend.mudg_compile, "zig_is_offered", lambda offered=offered: offered)
        assert backend.extra_requirements() == wanted
    monkeypatch.setenv("MUDG_NATIVE", "off")
    monkeypatch.setattr(backend.mudg_compile, "zig_is_offered", lambda: True)
    assert backend.extra_requirements() == []


@pytest.mark.slow
def test_variants_share_no_function_with_the_rest(mc: ModuleType, tmp_path: Path) -> None:
    """A weak symbol in an AVX object could be picked by the linker for every processor."""
    compiler, _ = mc.find_compiler(mc.system_candidates({}))
    if compiler is None or not compiler.x86_64 or shutil.which("nm") is None:
        pytest.skip("needs a system compiler for x86-64 and nm")
    for name in ("kernels_avx2", "kernels_avx512"):
        source, target = mc.NATIVE_SOURCES / f"{name}.cpp", tmp_path / f"{name}.o"
        flags = mc.flags_for(compiler, source)
        subprocess.run([*compiler.command, *flags, "-c", str(source), "-o", str(target)], check=True)
        listing = ["nm", "--defined-only", str(target)]
        symbols = subprocess.run(listing, capture_output=True, text=True, check=True).stdout
        kinds = {line.split()[-1]: line.split()[-2] for line in symbols.splitlines()}
        assert any(name in symbol for symbol in kinds)
        # those are addresses, alike in all
        weak = [s for s, kind in kinds.items() if kind in "WVu" and not s.startswith("DW.ref.")]
        assert weak == []
        assert [s for s in kinds if "GLOBAL__sub_I" in s] == []  # nothing runs when the library is loaded


def test_every_file_that_is_no_module_has_a_place_in_the_wheel() -> None:
    """Package data is listed by pattern: templates and weights that no pattern names would be missing from a wheel."""
    root = Path(__file__).parent.parent
    patterns = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["mudg"]
    package = root / "src" / "mudg"
    listed = {path for pattern in patterns for path in package.glob(pattern)}
    templates = {path for path in package.rglob("*") if path.suffix in (".j2", ".css", ".js", ".safetensors")}
    assert templates and templates <= listed
