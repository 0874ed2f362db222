"""Commands on addresses: fetched, worked on in a scratch folder, uploaded; stopped at any moment they go on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from refusals import refused
from test_location import _empty_memory, fsspec  # noqa: F401

from mudg import app
from mudg.base import staging, store
from mudg.base.errors import ResourceError
from mudg.base.location import Location
from mudg.editing.settings import ScoreConfig
from mudg.steps.render import Report, Score

CITY = "--city.n-frames 2 --city.width 48 --city.height 32 --city.cameras front --no-contact-sheet".split()


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("scenes") / "city"
    assert app.main(["ingest", "city", str(out), *CITY, "--quiet"]) == 0
    return out


@pytest.fixture
def scratch(tmp_path: Path) -> Path:
    return tmp_path / "scratch"


@pytest.fixture
def command(scratch: Path, capfd: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    def run(*words: str) -> tuple[int, str, str]:
        code = app.main([*words, "--scratch", str(scratch), "--quiet"])
        said = capfd.readouterr()
        return code, said.out, said.err

    return run


def at(address: str) -> Location:
    return Location.of(address)


def test_two_steps_from_store_to_store(command: Callable[..., Any], scratch: Path, scene: Path, tmp_path: Path) -> None:
    assert command("ingest", "city", "memory://bucket/city", *CITY)[0] == 0  # the output may stand after the log
    code, said, _ = command("fuse", "memory://bucket/city", "--out", "memory://bucket/runs/fused", "--json")
    assert code == 0 and json.loads(said) == {"fused": "memory://bucket/runs/fused"}
    assert not any(scratch.iterdir()), "nothing is left behind"
    at("memory://bucket/runs/fused").fetch(tmp_path / "fused")
    assert app.main(["fuse", str(scene), "--out", str(tmp_path / "here"), "--quiet"]) == 0
    assert store.digest(tmp_path / "fused") == store.digest(tmp_path / "here")
    record = (tmp_path / "fused/run.json").read_text()
    assert json.loads(record)["key"] == json.loads((tmp_path / "here/run.json").read_text())["key"]


@pytest.mark.parametrize("fails", ["put_file", "pipe_file", "get_file"])
def test_stopped_in_a_transfer_the_same_command_goes_on(
    fails: str, command: Callable[..., Any], scratch: Path, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    at("memory://bucket/city").push(scene)
    files, calls, computed = fsspec.filesystem("memory"), [], []
    found = getattr(type(files), fails)

    def failing(self: Any, *args: Any, **options: Any) -> Any:
        calls.append(args[0])
        if len(calls) == 3:
            raise PermissionError("refused")
        return found(self, *args, **options)

    from mudg.steps.ingest import Fuse

    act = Fuse.act
    monkeypatch.setattr(Fuse, "act", lambda step: computed.append(1) or act(step))
    with monkeypatch.context() as patch:
        patch.setattr(type(files), fails, failing)
        code, _, said = command("fuse", "memory://bucket/city", "--out", "memory://bucket/fused")
    assert code == 5 and "refused access" in said and not at("memory://bucket/fused/manifest.json").exists()
    assert any(scratch.iterdir()) and command("fuse", "memory://bucket/city", "--out", "memory://bucket/fused")[0] == 0
    assert at("memory://bucket/fused/manifest.json").exists() and not any(scratch.iterdir())


def test_a_file_goes_to_an_address_too(command: Callable[..., Any], scene: Path) -> None:
    """What several verbs write is one file, and some put a folder beside it."""

    def write(args: Any) -> dict[str, Any]:
        args.out.write_text("page")
        (args.out.parent / "page_more").mkdir()
        (args.out.parent / "page_more/x.bin").write_bytes(b"x")
        return {"page": args.out, "text": f"see {args.out}"}

    args = Report(runs=(scene,), out=Path("memory://bucket/pages/page.html"))
    said = staging.run_staged("report", args, write)
    assert said == {"page": "memory://bucket/pages/page.html", "text": "see memory://bucket/pages/page.html"}
    assert at("memory://bucket/pages/page.html").load() == b"page"
    assert at("memory://bucket/pages/page_more/x.bin").load() == b"x"


def test_every_kind_of_flag_is_staged(scratch: Path) -> None:
    at("memory://bucket/a/views").save(b"views")
    at("memory://bucket/scene").save(b"scene")
    seen = {}

    def look(args: Any) -> dict[str, Any]:
        views = [path.read_bytes() for path in args.views.values()]
        seen.update(scene=args.scene.read_bytes(), views=views, out=args.out)
        return {}

    views = {"mine": Path("memory://bucket/a/views"), "theirs": scratch / "x"}
    scratch.mkdir()
    (scratch / "x").write_bytes(b"local")
    args = Score(scene=Path("memory://bucket/scene"), views=views, out=scratch / "out", settings=ScoreConfig())
    staging.run_staged("score", args, look, scratch)
    assert seen == {"scene": b"scene", "views": [b"views", b"local"], "out": scratch / "out"}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("fuse memory://bucket/a --out memory://bucket/a", "touches an input"),
        ("fuse memory://bucket/a --out memory://bucket/a/fused", "touches an input"),
        ("fuse memory://bucket/none --out memory://bucket/fused", "nothing is at"),
        ("fuse https://host/a --out memory://bucket/fused", "no storage of this kind"),
        ("fuse memory://bucket/a --out memory://bucket", "in a bucket"),
        ("fuse memory://bucket/a --out memory://bucket/theirs", "something else"),
        ("synthesize memory://bucket/a --fused x --model s3://bucket/m --out y", "--model"),
        ("fuse s3://me:hunter2@bucket/a --out x", "password"),
        ("fuse a --out=s3://me:hunter2@bucket/a", "password"),
        ("score a --views m=s3://me:hunter2@bucket/a --out x", "password"),
        ("fuse https://me:hunter2@host/a --nonsense --out x", "password"),
    ],
)
def test_what_cannot_be_is_refused(words: str, said: str, command: Callable[..., Any]) -> None:
    at("memory://bucket/theirs/x").save(b"somebody else's")
    at("memory://bucket/a/x").save(b"1")
    code, out, err = command(*words.split())
    assert code in (2, 3) and said in err and "hunter2" not in out + err


def test_two_commands_do_not_share_a_scratch_folder(scratch: Path, scene: Path) -> None:
    """Not at the same time, and not that of another user."""
    args, seen = Report(runs=(scene,), out=Path("memory://bucket/page.html")), list[Path]()

    def write(inner: Any) -> dict[str, Any]:
        (folder,) = scratch.iterdir()
        seen.append(folder)
        store.write_json(folder / "lock", {"pid": 1, "host": __import__("socket").gethostname()})
        refused("another process", staging.run_staged, "report", args, write, scratch, raises=ResourceError)
        inner.out.write_text("page")
        return {}

    staging.run_staged("report", args, write, scratch)
    (scratch / "elsewhere").mkdir()
    seen[0].symlink_to(scratch / "elsewhere")
    refused("somebody else", staging.run_staged, "report", args, write, scratch, raises=ResourceError)
