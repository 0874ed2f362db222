"""PEP 517 build back-end: setuptools, plus the native library when a compiler can be found.

`pip install .` and `pip wheel .` compile into a temporary folder and put the library into the wheel, which is then
tagged `py3-none-<platform>`; without a library the wheel is `py3-none-any`. `pip install -e .` compiles next to the
sources. For development: ``python build_backend/mudg_build.py --inplace`` (see `mudg_compile` for the choice of a
compiler).
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import mudg_compile
from setuptools import build_meta
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build import build
from setuptools.command.build_py import build_py

prepare_metadata_for_build_wheel = build_meta.prepare_metadata_for_build_wheel
prepare_metadata_for_build_editable = build_meta.prepare_metadata_for_build_editable
get_requires_for_build_sdist = build_meta.get_requires_for_build_sdist
build_sdist = build_meta.build_sdist

# What the running build_wheel made; the setuptools commands below read it.
_outcome: mudg_compile.Outcome | None = None


def get_requires_for_build_wheel(config_settings: dict[str, Any] | None = None) -> list[str]:
    """Asks for the ziglang wheel only where no system compiler works and a library is wanted."""
    requires = list(build_meta.get_requires_for_build_wheel(config_settings))
    return requires + extra_requirements()


def get_requires_for_build_editable(config_settings: dict[str, Any] | None = None) -> list[str]:
    """As for a wheel."""
    requires = list(build_meta.get_requires_for_build_editable(config_settings))
    return requires + extra_requirements()


def extra_requirements() -> list[str]:
    """["ziglang"] where this machine has no working system compiler but could have that one, else []."""
    if mudg_compile.native_mode(os.environ) == "off":
        return []
    compiler, notes = mudg_compile.find_compiler(mudg_compile.system_candidates(os.environ))
    if compiler is not None:
        return []
    offered = mudg_compile.zig_is_offered()
    answer = "asking for the ziglang wheel" if offered else "and there is no ziglang wheel for this platform"
    print("mudg native: no system compiler works", *notes, answer, sep="\nmudg native: ")
    return ["ziglang"] if offered else []


def build_wheel(
    wheel_directory: str, config_settings: dict[str, Any] | None = None, metadata_directory: str | None = None
) -> str:
    """Builds the wheel, with the native library if one could be compiled."""
    global _outcome
    with tempfile.TemporaryDirectory(prefix="mudg-build-") as folder:
        target = Path(folder, "library")
        target.mkdir()
        _outcome = mudg_compile.build(target, Path(folder, "objects"))
        print(mudg_compile.report(_outcome), flush=True)
        return build_meta.build_wheel(wheel_directory, config_settings, metadata_directory)


def build_editable(
    wheel_directory: str, config_settings: dict[str, Any] | None = None, metadata_directory: str | None = None
) -> str:
    """Compiles in place, then makes the editable wheel."""
    build_in_place()
    return build_meta.build_editable(wheel_directory, config_settings, metadata_directory)


def build_in_place() -> mudg_compile.Outcome:
    """Compiles into `src/mudg/native`. A failed build leaves an older library as it was."""
    outcome = mudg_compile.build(mudg_compile.NATIVE_SOURCES, mudg_compile.REPOSITORY / "build" / "native")
    print(mudg_compile.report(outcome), flush=True)
    if outcome.library is not None or not (mudg_compile.NATIVE_SOURCES / mudg_compile.LIBRARY_NAME).exists():
        mudg_compile.write_build_info(outcome, mudg_compile.NATIVE_SOURCES)
    return outcome


class Build(build):
    """Builds in a fresh temporary folder: leftovers of an earlier build never reach a wheel."""

    def initialize_options(self) -> None:
        super().initialize_options()
        self._scratch = tempfile.TemporaryDirectory(prefix="mudg-setuptools-")
        self.build_base = self._scratch.name


class BuildPy(build_py):
    """Adds the library and its build report to the package."""

    def run(self) -> None:
        super().run()
        if _outcome is None or getattr(self, "editable_mode", False):
            return
        folder = Path(self.build_lib, "mudg", "native")
        folder.mkdir(parents=True, exist_ok=True)
        mudg_compile.write_build_info(_outcome, folder)
        if _outcome.library is not None:
            shutil.copy2(_outcome.library, folder / mudg_compile.LIBRARY_NAME)


class BdistWheel(bdist_wheel):
    """A wheel with a C library runs on any Python 3, but on one platform only."""

    def finalize_options(self) -> None:
        if _outcome is not None and _outcome.library is not None:
            self.distribution.has_ext_modules = lambda: True
        super().finalize_options()

    def get_tag(self) -> tuple[str, str, str]:
        if self.root_is_pure:
            return super().get_tag()
        return "py3", "none", super().get_tag()[2]


def main() -> int:
    """Command line for developers."""
    parser = argparse.ArgumentParser(description="Compile the native library of mudg.")
    parser.add_argument("--inplace", action="store_true", required=True, help="compile into src/mudg/native")
    parser.parse_args()
    try:
        outcome = build_in_place()
    except mudg_compile.CompileError as error:
        print(error, file=sys.stderr)
        return 5
    return 0 if outcome.library is not None else 5


if __name__ == "__main__":
    sys.exit(main())
