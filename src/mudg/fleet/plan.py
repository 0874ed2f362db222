"""What a batch does: the scenes of its list, its steps, the command of each, and the content key of a step of a scene.

A list has one source a line, ``SOURCE [name=NAME] [setting=value ...]``, quoted as in a shell; ``#`` starts a comment.
"""

from __future__ import annotations

import hashlib
import os
import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from mudg.base import store
from mudg.base.config import without_devices
from mudg.base.errors import InputError, UsageError
from mudg.base.versions import version
from mudg.scene.schema import NAME_PATTERN

CITY: Final = "city"
BOOKKEEPING: Final = "_batch"
"""Folder of a batch's own records, in its output."""
_LEFT_OUT: Final = re.compile(rf"{BOOKKEEPING}|\..*")
SHARD_VARIABLES: Final[tuple[tuple[str, str, str], ...]] = (
    ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_COUNT", "SLURM_ARRAY_TASK_MIN"),
    ("JOB_COMPLETION_INDEX", "", ""),
    ("SKYPILOT_NODE_RANK", "SKYPILOT_NUM_NODES", ""),
    ("AWS_BATCH_JOB_ARRAY_INDEX", "AWS_BATCH_JOB_ARRAY_SIZE", ""),
)
"""Variables with which schedulers number their tasks: the index, the count and the lowest index (empty: 0)."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of a list: the source, the name of its output folder, and its own settings (``sequence``, ...)."""

    name: str
    source: str
    settings: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of_line(cls, line: str, where: str, folder: Path, settings: Sequence[str]) -> Entry | None:
        """What a line says; None if it says nothing. where: its place, for messages. folder: that of the list.
        settings: those that a line may give. InputError: malformed. UsageError: an address."""
        try:
            words = shlex.split(line, comments=True)
        except ValueError as error:
            raise InputError("cannot parse the line", where=where, got=line[:80]) from error
        if not words:
            return None
        given: dict[str, str] = {}
        for word in words[1:]:
            key, separator, value = word.partition("=")
            if not separator or key not in ("name", *settings):
                got, expected = word[:80], ", ".join(f"{key}=..." for key in ("name", *settings))
                remedy = "put quotes around a path with spaces"
                raise InputError("unknown setting in the line", where=where, got=got, expected=expected, remedy=remedy)
            given[key] = os.path.abspath(value) if key in ("poses", "boxes") and os.path.exists(value) else value
        refuse_address(words[0], where)
        source = CITY if words[0] == CITY else os.path.abspath(folder / Path(words[0]).expanduser())
        name = given.pop("name", "") or Path(source).name
        if not NAME_PATTERN.fullmatch(name) or name == BOOKKEEPING:
            what, remedy = "name cannot be a folder name", "add name=NAME to the line"
            raise InputError(what, where=where, got=name[:80], remedy=remedy)
        return cls(name, source, given)


def read_list(listed: Path, settings: Sequence[str] = ()) -> list[Entry]:
    """Entries of a list file, or one for each entry of a folder (but for what an earlier run over a list wrote there).
    Relative sources count from the list's folder. settings: those that a line may give. InputError: missing, empty,
    malformed, or two lines that would write one folder."""
    if listed.is_dir():
        names = sorted(path.name for path in listed.iterdir() if not _LEFT_OUT.fullmatch(path.name))
        lines, folder = [(str(listed / name), shlex.quote(name)) for name in names], listed
    else:
        text = store.read_bytes(listed).decode("utf-8", "replace")
        lines = [(f"{listed}: line {number}", line) for number, line in enumerate(text.splitlines(), 1)]
        folder = listed.parent
    entries: dict[str, Entry] = {}
    for where, line in lines:
        entry = Entry.of_line(line, where, folder, settings)
        if entry is not None and (other := entries.setdefault(entry.name, entry)) is not entry:
            what = "two entries would write the same folder"
            remedy = f"give one of them another name: SOURCE name={entry.name}-2"
            raise InputError(what, where=str(listed), got=f"{other.source} and {entry.source}", remedy=remedy)
    if not entries:
        raise InputError("the list is empty", where=str(listed), expected="one source per line")
    return list(entries.values())


def refuse_address(text: str, where: str) -> None:
    """UsageError for an address: many machines work in the folders of a batch at the same time."""
    if "://" in text:
        what, remedy = "a batch works on folders", "mount the store as one, or give the address to mudg run"
        raise UsageError(what, where=where, got=text.partition("://")[0] + "://...", remedy=remedy)


def shard_of(name: str, count: int) -> int:
    """Which of ``count`` shards a scene belongs to: a hash of its name, so that it stays there when the list grows."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8]) % count


def parse_shard(text: str, environment: Mapping[str, str] = os.environ) -> tuple[int, int]:
    """(i, n) of ``"i/n"``; of ``"env"`` and ``"env/n"``, where the environment of a scheduler says i; (0, 1) of an
    empty text. UsageError: not of this form, or the environment does not say it."""
    if not text:
        return 0, 1
    index, _, count = text.partition("/")
    if index == "env":
        named = next((names for names in SHARD_VARIABLES if environment.get(names[0])), None)
        if named is None:
            expected = f"one of {', '.join(names[0] for names in SHARD_VARIABLES)} in the environment"
            raise UsageError("no scheduler has numbered this task", where="--shard env", expected=expected)
        index, total, lowest = (environment.get(name, "") for name in named)
        count = count or total
        if index.isdecimal() and lowest.isdecimal():
            index = str(int(index) - int(lowest))
    if not index.isdecimal() or not count.isdecimal() or not int(index) < int(count):
        what, got = "invalid shard", f"{text}: {index or '?'}/{count or '?'}"
        raise UsageError(what, where="--shard", expected="i/n with i from 0 to n-1, e.g. 0/4; or env, env/n", got=got)
    return int(index), int(count)


# steps --------------------------------------------------------------------------------------------

RULES_VERSION: Final = 2
"""Counts up when keys or commands change their meaning: results of older batches are then made again."""
OF_A_LINE: Final = ("format", "frames", "cameras", "sequence", "poses", "boxes", "seed")
"""Settings of ingest that a line of the list may give; seed is that of a generated city."""
_PLACEHOLDER: Final = re.compile(r"\{(\w+)\}")
COMMAND: Final = "command"
"""Name of the step that is a program of the user's own."""


@dataclass(frozen=True)
class BatchStage:
    """A step of a batch. words: its command, with names in braces; needs: steps whose results it reads; settings: what
    ``--config`` holds for it."""

    name: str
    words: tuple[str, ...]
    needs: tuple[str, ...]
    settings: Mapping[str, Any]

    def record(self) -> dict[str, Any]:
        """As JSON values, without devices: results do not depend on them."""
        return {**asdict(self), "settings": without_devices(self.settings)}


@dataclass(frozen=True)
class Unit:
    """A step of a scene: what is done and recorded."""

    entry: Entry
    stage: BatchStage
    key: str
    """Content key: of the log's identity, settings, version and the keys of what is read."""
    needs: Mapping[str, str]
    """Step -> folder below the output, of the results it reads."""

    @property
    def place(self) -> str:
        """Folder of its result below the output."""
        return f"{self.entry.name}/{self.stage.name}/{self.key[:12]}"

    @property
    def title(self) -> str:
        """For messages."""
        return f"{self.entry.name} {self.stage.name}"

    def command(self, places: Mapping[str, str], out: str, config: str) -> list[str]:
        """The command line. places: ``source`` and steps -> where they lie. out: folder to write. config: file of the
        step's settings, if it has any."""
        filled, name = {**places, "out": out, "name": self.entry.name}, self.stage.name
        words = [_PLACEHOLDER.sub(lambda match: filled.get(match[1], match[0]), word) for word in self.stage.words]
        if name == COMMAND:
            return words
        settings = ["--config", config] if config else []
        words = [sys.executable, "-m", "mudg", *words, "--out", out, "--quiet", *settings]
        if name not in ("ingest", "run"):
            return words
        group = "ingest." if name == "run" else ""
        for setting, value in self.entry.settings.items():
            if setting == "cameras":
                words += [f"--{group}cameras", *value.split(",")]
            else:
                words.append(f"--{group}{'city.' if setting == 'seed' else ''}{setting}={value}")
        return words


@dataclass(frozen=True)
class BatchPlan:
    """The steps of a batch, in order. The list is not part of it: it may grow."""

    stages: tuple[BatchStage, ...]

    def record(self) -> dict[str, Any]:
        """As JSON values: what must be the same for all who work on a batch."""
        stages = [stage.record() for stage in self.stages]
        return {"schema": 1, "version": version(), "rules": RULES_VERSION, "stages": stages}

    def units(self, entry: Entry) -> Iterator[Unit]:
        """The steps of a scene, in order."""
        made: dict[str, Unit] = {}
        for stage in self.stages:
            needs = {name: made[name] for name in stage.needs}
            values = [RULES_VERSION, version(), stage.name, list(stage.words), without_devices(stage.settings)]
            values += [entry.name, entry.source, dict(entry.settings), {name: one.key for name, one in needs.items()}]
            key = hashlib.sha256(store.json_text(values, indent=None).encode()).hexdigest()[:32]
            made[stage.name] = Unit(entry, stage, key, {name: one.place for name, one in needs.items()})
            yield made[stage.name]


def plan_of(
    names: Sequence[str], lines: Mapping[str, Sequence[str]], settings: Mapping[str, Any], command: Sequence[str] = ()
) -> BatchPlan:
    """The plan of these steps. UsageError: an unknown step, one twice, or one whose inputs no step makes.

    lines: words after ``mudg`` of every step; names of other steps in braces stand for their results, ``{scene}`` for
    that of annotate or ingest, or for the source. settings: those of ``mudg run``, as JSON values. command: a program
    of the user's own, as the step ``command``.
    """
    if command:
        if COMMAND not in names:
            names = (*names, COMMAND)
        if "{out}" not in " ".join(command):
            expected = "{out} among its words"
            raise UsageError("a command must be told where to write", where="--command", expected=expected)
    known = {**lines, **({COMMAND: command} if command else {})}
    stages: list[BatchStage] = []
    for name in names:
        if name not in known:
            raise UsageError("there is no such step", where="--stages", got=name, expected=", ".join(lines))
        made = [stage.name for stage in stages]
        scene = next((one for one in ("annotate", "ingest") if one in made), "source")
        words = tuple(word if name == COMMAND else word.replace("{scene}", "{" + scene + "}") for word in known[name])
        read = set(_PLACEHOLDER.findall(" ".join(words)))
        missing = (read & set(lines)) - set(made)
        if missing and name != COMMAND:
            where, got = "--stages", " ".join(names)
            raise UsageError(f"the step {name} needs {' and '.join(sorted(missing))} before it", where=where, got=got)
        own = {} if name == COMMAND else dict(settings if name == "run" else settings[name])
        stages.append(BatchStage(name, words, tuple(one for one in made if one in read), own))
    if len(set(names)) < len(names) or not names:
        raise UsageError("each step at most once, and at least one", where="--stages", got=" ".join(names))
    return BatchPlan(tuple(stages))
