"""The native kernels under the address and undefined-behaviour sanitizers."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FLAGS = ("-O1", "-g1", "-fno-omit-frame-pointer", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
RUN = """
import sys
from pathlib import Path
import pytest
from mudg import native
native.LIBRARY_PATH = Path(sys.argv[1])
assert native.library() is not None, native.status()
sys.exit(pytest.main(["-q", "-x", "-s", "-p", "no:cacheprovider", "-m", "not slow", *sys.argv[2:]]))
"""


def _runtime(command: tuple[str, ...], name: str) -> str:
    words = [*command, f"-print-file-name={name}"]
    found = subprocess.run(words, capture_output=True, text=True, check=False).stdout.strip()
    return found if os.path.isabs(found) and Path(found).exists() else ""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the sanitizers are preloaded the Linux way")
def test_kernels_are_clean_under_the_sanitizers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not (ROOT / "build_backend").is_dir():
        pytest.skip("not a checkout: there are no sources to compile")
    monkeypatch.syspath_prepend(str(ROOT / "build_backend"))
    import mudg_compile

    compiler, notes = mudg_compile.find_compiler(mudg_compile.system_candidates(os.environ))
    if compiler is None:
        pytest.skip(f"no system compiler works: {notes}")
    # torch throws through the sanitizer's run time, which therefore needs the C++ run time beside it from the start.
    runtime = [_runtime(compiler.command, name) for name in ("libasan.so", "libstdc++.so.6")]
    if not all(runtime):
        pytest.skip("this compiler has no sanitizer run time")
    monkeypatch.setattr(mudg_compile, "COMMON_FLAGS", (*mudg_compile.COMMON_FLAGS, *FLAGS))
    monkeypatch.setattr(mudg_compile, "LINK_FLAGS", (*mudg_compile.LINK_FLAGS[:2], "-fsanitize=address,undefined"))
    monkeypatch.setattr(mudg_compile, "check_loads", lambda library, run: None)  # it loads only with the run time below
    library = tmp_path / mudg_compile.LIBRARY_NAME
    mudg_compile.compile_library(compiler, library, tmp_path / "objects")
    environment = {
        **os.environ,
        "LD_PRELOAD": " ".join(runtime),
        "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0",
        "OMP_NUM_THREADS": "1",
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "MUDG_THREADS": "2",
    }
    tests = [str(ROOT / "tests" / name) for name in ("test_raster.py", "test_native.py")]
    # Loading other libraries on purpose, and forking, is what these tests do; the sanitizers have nothing to say to
    # that.
    skipped = "not library and not forked and not environment"
    command = [sys.executable, "-c", RUN, str(library), *tests, "-k", skipped]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=1800, check=False)
    assert done.returncode == 0, (done.stdout + done.stderr)[-20000:]
