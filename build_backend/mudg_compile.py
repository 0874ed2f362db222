"""Compiles the C++ files of `src/mudg/native` into one shared library, with whatever compiler this machine has.

The choice, in this order:

1. a system compiler: ``$CXX``, then ``c++``, ``g++``, ``clang++`` from the search path;
2. the compiler inside the ``ziglang`` wheel (a tool chain that pip alone can install);
3. none: the package is then installed as pure Python and works through slow fall-backs.

The environment variable ``MUDG_NATIVE`` steers it: ``auto`` (default) does the above, ``require`` turns "no library"
into an error, ``off`` skips compilation. A compiler counts as working only when a probe library that it made can be
loaded and answers; `--version` proves little. Standard library only.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
NATIVE_SOURCES = REPOSITORY / "src" / "mudg" / "native"
LIBRARY_NAME = {"darwin": "libmudg_native.dylib", "win32": "mudg_native.dll"}.get(sys.platform, "libmudg_native.so")
BUILD_INFO_NAME = "build_info.json"
MODES = ("auto", "require", "off")

# Contraction is off on purpose: the forward and the backward pass evaluate the same inline functions and have to agree
# bit for bit on which pixels a Gaussian touches, so a multiply and an add may only fuse where the source says fma().
# No -ffast-math: NaN and infinity must stay visible. math-errno and trapping-math change no value.
COMMON_FLAGS = (
    "-O3",
    "-std=c++17",
    "-fPIC",
    "-pthread",
    "-fvisibility=hidden",
    "-fvisibility-inlines-hidden",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=off",
    "-Wall",
    "-Wextra",
    "-Wno-unused-function",
    "-Wno-uninitialized",
    "-Wno-maybe-uninitialized",
)
LINK_FLAGS = ("-shared", "-pthread", "-Wl,-s") if sys.platform == "linux" else ("-shared", "-pthread")

# Files called *_avx2.cpp and *_avx512.cpp are compiled only for x86-64, each for its own instruction set; which one
# runs is decided when the library is loaded (cpu.cpp). All other files are compiled for the baseline of the
# architecture.
VARIANT_FLAGS: dict[str, tuple[str, ...]] = {
    "_avx2": ("-mavx2", "-mfma", "-mbmi", "-mbmi2"),
    "_avx512": (
        "-mavx512f",
        "-mavx512dq",
        "-mavx512vl",
        "-mavx512bw",
        "-mavx2",
        "-mfma",
        "-mbmi",
        "-mbmi2",
        "-mprefer-vector-width=512",
    ),
}
# zig spells processors its own way and, left alone, would target the processor of the build machine.
ZIG_VARIANT_FLAGS: dict[str, tuple[str, ...]] = {
    "": ("-mcpu=baseline",),
    "_avx2": ("-mcpu=x86_64+avx2+fma+bmi+bmi2",),
    "_avx512": ("-mcpu=x86_64+avx512f+avx512dq+avx512vl+avx512bw+avx2+fma+bmi+bmi2", "-mprefer-vector-width=512"),
}
ZIG_FLAGS = ("-fno-sanitize=all", "-g0", "-Wno-unknown-warning-option")

PROBE_SOURCE = """
#include <atomic>
#include <string_view>
#include <thread>
#include <vector>
#if defined(_WIN32)
#define PROBE_API extern "C" __declspec(dllexport)
#else
#define PROBE_API extern "C" __attribute__((visibility("default")))
#endif
typedef float four_floats __attribute__((vector_size(16)));
PROBE_API int mudg_probe() {
  std::atomic<int> sum{0};
  std::vector<std::thread> threads;
  for (int i = 1; i <= 3; ++i) threads.emplace_back([&sum, i] { sum += i; });
  for (auto& thread : threads) thread.join();
  if constexpr (std::string_view("mudg").size() != 4) return -1;
  four_floats one = {1, 1, 1, 1};
  one += one;
#if defined(__x86_64__)
  const int architecture = 1;
#else
  const int architecture = 2;
#endif
  return sum.load() == 6 && one[3] == 2.0f ? architecture : -1;
}
"""

Run = Callable[[Sequence[str]], "subprocess.CompletedProcess[str]"]
Probe = Callable[["Compiler"], "ProbeResult"]


class CompileError(Exception):
    """The library could not be built; the message says which command failed and what it printed."""


@dataclass(frozen=True)
class Compiler:
    """A way to call a C++ compiler. `kind` is "system" or "ziglang"."""

    command: tuple[str, ...]
    kind: str
    version: str = ""
    x86_64: bool = False

    def __str__(self) -> str:
        return f"{shlex.join(self.command)} ({self.version})" if self.version else shlex.join(self.command)


@dataclass(frozen=True)
class ProbeResult:
    """What the probe found: works or the reason why not, and whether it makes x86-64 code."""

    works: bool
    reason: str = ""
    version: str = ""
    x86_64: bool = False


@dataclass(frozen=True)
class Outcome:
    """The end of a build: the library, or None and the reason in words. `notes` is the log on the way."""

    library: Path | None
    reason: str
    compiler: Compiler | None = None
    notes: tuple[str, ...] = field(default=())

    def as_json(self) -> dict[str, object]:
        """What is stored beside the library, for `mudg doctor`."""
        compiler = "" if self.compiler is None else self.compiler.version or shlex.join(self.compiler.command)
        return {"native": self.library is not None, "compiler": compiler, "reason": self.reason}


def run_command(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Runs a command without a shell and captures what it prints."""
    return subprocess.run(list(command), capture_output=True, text=True, errors="replace", check=False)


def native_mode(environ: Mapping[str, str]) -> str:
    """The value of MUDG_NATIVE. Raises CompileError for a word that is not auto, require or off."""
    mode = environ.get("MUDG_NATIVE", "auto").strip().lower() or "auto"
    if mode not in MODES:
        raise CompileError(f"MUDG_NATIVE={mode!r} is not one of {', '.join(MODES)}")
    return mode


def system_candidates(environ: Mapping[str, str], which: Callable[[str], str | None] = shutil.which) -> list[Compiler]:
    """System compilers in order of preference: $CXX (which may carry arguments), c++, g++, clang++."""
    commands: list[tuple[str, ...]] = []
    if environ.get("CXX", "").strip():
        commands.append(tuple(shlex.split(environ["CXX"])))
    commands += [(found,) for name in ("c++", "g++", "clang++") if (found := which(name))]
    unique = list(dict.fromkeys(commands))
    return [Compiler(command, "system") for command in unique]


def zig_is_offered(system: str = sys.platform, machine: str = platform.machine()) -> bool:
    """Whether the package index has a ziglang wheel for this platform; asking for one that is not there would end the
    build."""
    return system in ("linux", "darwin", "win32") and machine.lower() in ("x86_64", "amd64", "aarch64", "arm64")


def zig_candidate() -> Compiler | None:
    """The compiler of the ziglang wheel, if that wheel is installed for this Python."""
    if importlib.util.find_spec("ziglang") is None:
        return None
    return Compiler((sys.executable, "-m", "ziglang", "c++"), "ziglang")


def probe(compiler: Compiler, run: Run = run_command) -> ProbeResult:
    """Builds a small threaded C++17 library with the compiler, loads it in a fresh Python and asks it for its
    architecture."""
    with tempfile.TemporaryDirectory(prefix="mudg-probe-") as folder:
        source, library = Path(folder, "probe.cpp"), Path(folder, LIBRARY_NAME)
        source.write_text(PROBE_SOURCE, encoding="utf-8")
        flags = flags_for(compiler, source)
        try:
            made = run([*compiler.command, *flags, *LINK_FLAGS, str(source), "-o", str(library)])
        except OSError as error:
            return ProbeResult(False, f"cannot be started: {error}")
        if made.returncode != 0 or not library.exists():
            return ProbeResult(False, f"cannot build a small C++17 library: {last_lines(made.stderr or made.stdout)}")
        script = f"import ctypes; print(ctypes.CDLL({str(library)!r}).mudg_probe())"
        loaded = run([sys.executable, "-c", script])
        answer = loaded.stdout.strip()
        if loaded.returncode != 0 or answer not in ("1", "2"):
            reason = last_lines(loaded.stderr) or f"it answered {answer!r}"
            return ProbeResult(False, f"makes libraries that do not load here: {reason}")
        version = run([*compiler.command, "--version"])
        first_line = (version.stdout.strip().splitlines() or ["unknown version"])[0]
        return ProbeResult(True, version=first_line, x86_64=answer == "1")


def find_compiler(candidates: Sequence[Compiler], check: Probe = probe) -> tuple[Compiler | None, list[str]]:
    """The first candidate that works, and a log line for each that was tried."""
    notes = []
    for candidate in candidates:
        result = check(candidate)
        if result.works:
            found = Compiler(candidate.command, candidate.kind, result.version, result.x86_64)
            notes.append(f"using {found}")
            return found, notes
        notes.append(f"{candidate} {result.reason}")
    return None, notes


def flags_for(compiler: Compiler, source: Path) -> tuple[str, ...]:
    """Compiler flags for one source file, by the ending of its name."""
    variant = variant_of(source)
    if compiler.kind == "ziglang":
        return (*COMMON_FLAGS, *ZIG_FLAGS, *ZIG_VARIANT_FLAGS[variant])
    return (*COMMON_FLAGS, *VARIANT_FLAGS.get(variant, ()))


def variant_of(source: Path) -> str:
    """ "_avx2", "_avx512" or "" (baseline)."""
    return next((suffix for suffix in VARIANT_FLAGS if source.stem.endswith(suffix)), "")


def sources_for(compiler: Compiler, folder: Path = NATIVE_SOURCES) -> list[Path]:
    """The files to compile, largest jobs (the instruction-set variants) first so that the cores stay busy."""
    files = [path for path in sorted(folder.glob("*.cpp")) if compiler.x86_64 or not variant_of(path)]
    return sorted(files, key=lambda path: variant_of(path) == "")


def digest_of(compiler: Compiler, flags: Sequence[str], source: Path) -> str:
    """A hash over everything that an object file depends on: compiler, flags, the source and the headers it
    includes."""
    hasher = hashlib.sha256(repr((compiler.command, compiler.version, tuple(flags))).encode())
    pending, seen = [source], set()
    while pending:
        path = pending.pop()
        if path in seen or not path.exists():
            continue
        seen.add(path)
        data = path.read_bytes()
        hasher.update(path.name.encode() + b"\0" + data)
        names = re.findall(rb'^\s*#\s*include\s+"([^"]+)"', data, flags=re.MULTILINE)
        pending += [path.parent / name.decode() for name in names]
    return hasher.hexdigest()[:24]


def compile_library(
    compiler: Compiler, library: Path, objects: Path, run: Run = run_command, jobs: int = 0
) -> list[str]:
    """Compiles all sources in parallel into `objects` (reused by content hash) and links them into `library`.

    Returns warnings that the compiler printed. Raises CompileError; an existing library is then left as it was.
    """
    objects.mkdir(parents=True, exist_ok=True)
    sources = sources_for(compiler)
    if not sources:
        raise CompileError(f"no C++ sources in {NATIVE_SOURCES}")

    def compile_one(source: Path) -> tuple[Path, str]:
        flags = flags_for(compiler, source)
        target = objects / f"{source.stem}-{digest_of(compiler, flags, source)}.o"
        if target.exists():
            return target, ""
        unfinished = target.with_name(f".{target.stem}.{os.getpid()}.o")
        made = run([*compiler.command, *flags, "-c", str(source), "-o", str(unfinished)])
        if made.returncode != 0:
            raise CompileError(f"{source.name} does not compile with {compiler}:\n{last_lines(made.stderr, 40)}")
        os.replace(unfinished, target)
        drop_old_objects(objects, source.stem)
        return target, made.stderr.strip()

    with ThreadPoolExecutor(jobs or os.cpu_count() or 1) as workers:
        finished = list(workers.map(compile_one, sources))
    unlinked = library.with_name(f".{library.name}.{os.getpid()}.tmp")
    linked = run([*compiler.command, *LINK_FLAGS, *(str(path) for path, _ in finished), "-o", str(unlinked)])
    if linked.returncode != 0:
        unlinked.unlink(missing_ok=True)
        raise CompileError(f"linking failed with {compiler}:\n{last_lines(linked.stderr, 40)}")
    check_loads(unlinked, run)
    os.replace(unlinked, library)
    return [text for _, text in finished if text]


def drop_old_objects(objects: Path, stem: str, keep: int = 3) -> None:
    """Keeps the newest few object files of one source; a build that runs beside this one may still link the others."""
    found = sorted(objects.glob(f"{stem}-*.o"), key=lambda path: path.stat().st_mtime, reverse=True)
    for old in found[keep:]:
        old.unlink(missing_ok=True)


def check_loads(library: Path, run: Run) -> None:
    """Loads the finished library in a fresh Python, so that a missing symbol is found now and not by the user."""
    loaded = run([sys.executable, "-c", f"import ctypes; ctypes.CDLL({str(library)!r}).mudg_abi_version()"])
    if loaded.returncode != 0:
        library.unlink(missing_ok=True)
        raise CompileError(f"the library was built but does not load:\n{last_lines(loaded.stderr)}")


def build(
    target: Path,
    objects: Path,
    environ: Mapping[str, str] = os.environ,
    *,
    candidates: Sequence[Compiler] | None = None,
    check: Probe = probe,
    compile_with: Callable[[Compiler, Path, Path], list[str]] = compile_library,
) -> Outcome:
    """Builds the library into the folder `target`, or says why there is none. Raises CompileError only when
    MUDG_NATIVE=require (or is no known word). A compiler that fails on the real sources hands over to the next.
    """
    mode = native_mode(environ)
    if mode == "off":
        return Outcome(None, "MUDG_NATIVE=off: compilation was skipped")
    if candidates is None:
        zig = zig_candidate()
        candidates = [*system_candidates(environ), *([zig] if zig else [])]
    remaining, notes, reason = (
        list(candidates),
        [],
        "no C++ compiler was found (tried $CXX, c++, g++, clang++ and the ziglang wheel)",
    )
    while remaining:
        compiler, tried = find_compiler(remaining, check)
        notes += tried
        if compiler is None:
            reason = "no C++ compiler works: " + "; ".join(notes)
            break
        remaining = remaining[[item.command for item in remaining].index(compiler.command) + 1 :]
        try:
            notes += compile_with(compiler, target / LIBRARY_NAME, objects)
            return Outcome(target / LIBRARY_NAME, "", compiler, tuple(notes))
        except CompileError as error:
            reason = str(error)
            notes.append(reason)
    if mode == "require":
        raise CompileError(f"MUDG_NATIVE=require, but {reason}")
    return Outcome(None, reason, None, tuple(notes))


def write_build_info(outcome: Outcome, folder: Path) -> Path:
    """Stores beside the library how it was built, or why it was not."""
    path = folder / BUILD_INFO_NAME
    path.write_text(json.dumps(outcome.as_json(), indent=1) + "\n", encoding="utf-8")
    return path


def report(outcome: Outcome) -> str:
    """The build log in words."""
    lines = [f"mudg native: {note}" for note in outcome.notes]
    if outcome.library is not None:
        lines.append(f"mudg native: built {outcome.library}")
    else:
        lines.append(f"mudg native: NOT built: {outcome.reason}")
        lines.append("mudg native: the package is installed as pure Python; rendering falls back to slow torch code.")
        lines.append("mudg native: install a C++17 compiler (or `pip install ziglang`) and install again to get it.")
    return "\n".join(lines)


def last_lines(text: str, count: int = 6) -> str:
    """The end of a compiler's output."""
    return "\n".join(text.strip().splitlines()[-count:])
