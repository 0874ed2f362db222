"""The Dockerfiles without docker: what they copy exists, what they install is the lock, and the lock fits the
package."""

from __future__ import annotations

import re
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDER = REPOSITORY / "docker"
LOCK = FOLDER / "requirements.lock"
FILES = ["Dockerfile.cpu", "Dockerfile.cuda"]


def instructions(name: str) -> list[tuple[str, str]]:
    """Instruction and arguments, comments dropped and continued lines joined."""
    lines = [line for line in (FOLDER / name).read_text().splitlines() if not line.startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ").splitlines()
    return [(line.split()[0], " ".join(line.split()[1:])) for line in joined if line.strip()]


def locked() -> dict[str, Version]:
    found = {}
    for line in LOCK.read_text().splitlines():
        if line and not line.startswith("#"):
            match = re.fullmatch(r"([A-Za-z0-9_.-]+)==([0-9.]+)", line)
            assert match, f"neither a name nor an exact version: {line}"
            found[canonicalize_name(match[1])] = Version(match[2])
    return found


@pytest.mark.parametrize("name", FILES)
def test_everything_that_is_copied_exists_and_is_not_ignored(name: str) -> None:
    lines = (REPOSITORY / ".dockerignore").read_text().splitlines()
    ignored = [line for line in lines if line and not line.startswith("#")]
    patterns = [line.replace("**", "*") for line in ignored if line[0] == "*" and len(line) > 1]
    assert ignored[0] == "*"
    copied = [rest.split()[:-1] for word, rest in instructions(name) if word == "COPY" and "--from" not in rest]
    for source in [one for sources in copied for one in sources]:
        assert (REPOSITORY / source).exists(), source
        assert f"!{source.split('/')[0]}" in ignored, f"{source} does not reach docker"
        assert not any(fnmatch(f"/{source}", pattern) for pattern in patterns)


@pytest.mark.parametrize("name", FILES)
def test_pip_installs_the_lock_and_then_the_package_without_anything_else(name: str) -> None:
    installs = [rest for word, rest in instructions(name) if word == "RUN" and "pip install" in rest]
    first, last = installs[0], installs[-1]
    assert "--requirement /src/docker/requirements.lock" in first
    assert "--no-deps" in last and "--no-build-isolation" in last and "pip check" in last
    for between in installs[1:-1]:
        assert "--constraint /src/docker/requirements.lock" in between
        assert re.search(r" [a-z]+==[0-9.]+$", between)


@pytest.mark.parametrize("name", FILES)
def test_the_image_runs_mudg_as_a_plain_user_and_asks_no_network(name: str) -> None:
    last = dict(instructions(name))
    assert last["USER"] == "mudg"
    assert last["ENTRYPOINT"] == '["mudg"]'
    words = [word for word, _ in instructions(name)]
    assert words.index("USER") > max(i for i, word in enumerate(words) if word in ("RUN", "COPY"))
    assert any("HF_HUB_OFFLINE=1" in rest for word, rest in instructions(name) if word == "ENV")


def test_the_lock_has_exact_versions_that_fit_the_package_and_names_no_host_and_no_path() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    found = locked()
    for text in [*project["project"]["dependencies"], *project["build-system"]["requires"]]:
        requirement = Requirement(text)
        version = found.get(canonicalize_name(requirement.name))
        assert version is not None, f"{requirement.name} is not locked"
        assert version in requirement.specifier, f"{requirement.name} {version} is not in {requirement.specifier}"
    text = LOCK.read_text()
    assert "://" not in text
    assert not re.search(r"^(-|.*@)", text, re.MULTILINE)
