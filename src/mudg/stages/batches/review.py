"""Results that people look at: those outside the bounds, with pictures, until somebody accepts or rejects them.

    OUT/_review/<scene>.<step>/review.json      what is wrong, and where the result lies
                               1.jpg ...        small pictures of it
    OUT/_review/index.html                      all of them on one page

An accepted result gets its commit record, and the next ``mudg batch run`` goes on with the steps behind it. A rejected one stays so.
"""

from __future__ import annotations

import base64
import fnmatch
import io
import os
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from mudg.base import log, store
from mudg.base.errors import InputError, MudgError, UsageError, plain_lines
from mudg.base.location import Location
from mudg.stages.batches.folders import BatchFolder, EventLog
from mudg.stages.batches.lists import REVIEW
from mudg.stages.batches.told import ReviewTold, checked

PICTURES: Final = 4
"""Most pictures of a result."""
_WIDTH_PX: Final = 480
_SHOWN: Final = 200
"""Most results on the page."""
_RECORD: Final = "review.json"
_PAGE: Final = "index.html"
_KINDS: Final = (".png", ".jpg", ".jpeg", ".webp")
_TELLING: Final = ("contact_sheet", "errors/", "overview", "preview/", "top", "after", "/rgb/")
"""Parts of names of pictures that show most of a result, the best first."""


@dataclass(frozen=True)
class Candidate:
    """A result that waits for somebody to look at it. problems: the bounds it fails, each with its number; report: its page, if any."""

    scene: str
    stage: str
    key: str
    problems: tuple[str, ...]
    place: str
    pictures: tuple[str, ...]
    report: str = ""

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.scene}.{self.stage}"


def reviews_of(folder: BatchFolder) -> Location:
    """Where the results lie that wait."""
    return folder.out / REVIEW


def put(folder: BatchFolder, record: Mapping[str, Any], result: Path, inputs: Path) -> None:
    """Put a rejected result up for review. A picture that cannot be read is left out; so is everything if the store fails.

    Args:
        record: as for its commit. result: folder or file of it on this machine. inputs: folder with what it was made of; where the
            result holds few pictures, one of each is shown.
    """
    at = reviews_of(folder) / f"{record['scene']}.{record['stage']}"
    try:
        at.remove()
        names = []
        pictures = pictures_of(result)
        for made in sorted(inputs.iterdir()) if inputs.is_dir() else []:
            pictures += pictures_of(made.resolve())[:1]
        for number, picture in enumerate(pictures[:PICTURES]):
            content = small_picture(picture)
            if content:
                names.append(f"{number + 1}.jpg")
                (at / names[-1]).save(content)
        report = next((name for name in ("report.html", "index.html") if (result / name).is_file()), "")
        told = {name: record[name] for name in ("scene", "stage", "key", "problems", "place")}
        (at / _RECORD).save(store.json_text({"schema": 1, **told, "pictures": names, "report": report}).encode())
    except MudgError as error:
        log.warn(f"{record['scene']} {record['stage']} cannot be put up for review: {error.what}")


def pictures_of(result: Path) -> list[Path]:
    """Pictures that show a result: of each telling kind one from the middle, then others, evenly."""
    names = [name for name in store.list_files(result) if name.lower().endswith(_KINDS)] if result.is_dir() else []
    chosen: list[str] = []
    for part in _TELLING:
        some = [name for name in names if part in f"/{name}"]
        if some and some[len(some) // 2] not in chosen:
            chosen.append(some[len(some) // 2])
    others = [name for name in names if not any(part in f"/{name}" for part in _TELLING)]
    missing = max(0, PICTURES - len(chosen))
    chosen += [others[index * len(others) // missing] for index in range(min(missing, len(others)))] if missing else []
    return [result / name for name in dict.fromkeys(chosen[:PICTURES])]


def small_picture(path: Path) -> bytes:
    """A picture as a small JPEG; empty if it cannot be read."""
    from PIL import Image, UnidentifiedImageError

    try:
        image = Image.open(io.BytesIO(store.read_bytes(path))).convert("RGB")
        image.thumbnail((_WIDTH_PX, _WIDTH_PX))
    except (InputError, UnidentifiedImageError, OSError, ValueError, Image.DecompressionBombError):
        return b""
    content = io.BytesIO()
    image.save(content, "JPEG", quality=80)
    return content.getvalue()


def waiting(folder: BatchFolder) -> list[Candidate]:
    """What waits for somebody to look at it, by name.

    Raises:
        InputError: a record cannot be read.
    """
    found = []
    for name in reviews_of(folder).names():
        file = reviews_of(folder) / name / _RECORD
        if name == _PAGE or not file.exists():  # the record comes last
            continue
        record = checked(ReviewTold, store.parse_json(file.load(), str(file)), str(file), "remove its folder")
        found.append(Candidate(
            record["scene"], record["stage"], record["key"], tuple(record["problems"]), record["place"],
            tuple(one for one in record["pictures"] if "/" not in one), record.get("report", ""),
        ))  # fmt: skip
    return found


def count(folder: BatchFolder) -> int:
    """How many results wait, from one listing."""
    return sum(name != _PAGE for name in reviews_of(folder).names())


def forget(folder: BatchFolder, scene: str, stage: str) -> None:
    """Take a result off the list: it is tried again."""
    (reviews_of(folder) / f"{scene}.{stage}").remove()


def judge(folder: BatchFolder, names: Sequence[str], accepted: bool) -> list[Candidate]:
    """Accept or reject results that wait.

    Args:
        names: of scenes; ``*`` and ``?`` stand for others.

    Returns:
        What was judged.

    Raises:
        UsageError: no names. InputError: none of these wait.
    """
    if not names:
        raise UsageError(
            "name the scenes", where="--scenes", expected="names as mudg batch review shows them; '*' is all of them"
        )
    everyone = waiting(folder)
    chosen = [one for one in everyone if any(fnmatch.fnmatchcase(one.scene, name) for name in names)]
    if not chosen:
        raise InputError("no such scene waits for review", where=str(reviews_of(folder)), got=" ".join(names)[:200],
            expected=", ".join(one.scene for one in everyone[:8]) or "nothing waits")  # fmt: skip
    events = EventLog(folder, f"review-{socket.gethostname()}-{os.getpid()}-{time.time_ns():x}")
    for one in chosen:
        if folder.failed(one.key).exists():  # else somebody had it tried again meanwhile
            _decide(folder, one, accepted, events)
        forget(folder, one.scene, one.stage)
    events.flush()
    return chosen


def _decide(folder: BatchFolder, one: Candidate, accepted: bool, events: EventLog) -> None:
    file = folder.failed(one.key)
    record = dict(folder.ended(file))
    if not accepted:
        file.save(store.json_text({**record, "reviewed": True}, indent=None).encode())
        return
    for name in ("state", "code", "reason", "words"):
        record.pop(name, None)
    record["accepted"] = True
    folder.done(one.key).save(store.json_text(record, indent=None).encode(), only_if_absent=True)
    events.add(
        "done",
        **{
            name: value
            for name, value in record.items()
            if name not in ("schema", "source", "place", "host", "problems")
        },
    )
    file.remove()


def text_of(found: Sequence[Candidate], out: str) -> str:
    """What waits, for a terminal."""
    lines = [f"{one.scene} {one.stage}: {'; '.join(one.problems)}" for one in found]
    ways = f"mudg batch accept {out} --scenes NAME ..., reject likewise, or mudg batch retry {out} --reason quality"
    return plain_lines([*lines, f"{len(found)} results wait for review", *([ways] if found else [])])


def write_page(folder: BatchFolder, found: Sequence[Candidate]) -> Location:
    """All that waits on one page, with the pictures inside; returns where it lies."""
    from mudg.report import html

    cards = [
        {
            "scene": one.scene, "stage": one.stage, "problems": one.problems, "place": one.place,
            "link": f"../{one.place}/{one.report}" if one.report else "",
            "pictures": [_address_of(reviews_of(folder) / one.name / name) for name in one.pictures],
        }
        for one in found[:_SHOWN]
    ]  # fmt: skip
    page = reviews_of(folder) / _PAGE
    text = html.render(
        "review.html.j2", title="Review", kicker="mudg batch", heading=str(folder.out), cards=cards, more=max(0, len(found) - _SHOWN),
        lead=f"{len(found)} results are outside the bounds and wait for somebody to look at them.", out=str(folder.out),
        at=time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
    )  # fmt: skip
    page.save(text.encode())
    return page


def _address_of(file: Location) -> str:
    try:
        return f"data:image/jpeg;base64,{base64.b64encode(file.load()).decode('ascii')}"
    except InputError:
        return ""
