"""What a batch does: its steps, the command of each, and the content key of a step of a scene."""

from __future__ import annotations

import functools
import hashlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from mudg.base import store
from mudg.base.config import without_devices
from mudg.base.errors import UsageError
from mudg.base.versions import version
from mudg.stages.batches.lists import Entry

RULES_VERSION: Final = 2
"""Counts up when keys or commands change their meaning: results of older batches are then made again."""
OF_A_LINE: Final = ("format", "frames", "cameras", "sequence", "poses", "boxes", "seed")
"""Settings of ingest that a line of the list may give; seed is that of a generated city."""
REVISION: Final = "revision"
"""Setting of a line that only changes the key: another content at the same address."""


@dataclass(frozen=True)
class StageRule:
    """How a step is called.

    Args:
        words: words after ``mudg``; ``{source}`` and names of other steps in braces stand for folders. needs: steps it reads, each
            the first one of its group that is part of the batch; ``scene`` is the source itself, if it is none of them.
        group: settings it takes (empty: all of them).
    """

    words: tuple[str, ...]
    needs: tuple[tuple[str, ...], ...] = ()
    group: str = ""


_SCENE: Final = ("annotate", "ingest")
STAGE_RULES: Final[Mapping[str, StageRule]] = {
    "run": StageRule(("run", "{source}")),
    "ingest": StageRule(("ingest", "{source}"), (), "ingest"),
    "annotate": StageRule(("annotate", "{scene}"), (("ingest",),), "annotate"),
    "fuse": StageRule(("fuse", "{scene}"), (_SCENE,), "fuse"),
    "fit": StageRule(("fit", "{scene}", "--fused", "{fuse}", "--method", "street_gaussians"), (_SCENE, ("fuse",)), "fit"),
    "synthesize": StageRule(
        ("synthesize", "{scene}", "--fused", "{fuse}", "--fitted", "{fit}"), (_SCENE, ("fuse",), ("fit",)), "synthesize"
    ),
    "render": StageRule(("render", "{scene}", "--model", "{fit}"), (_SCENE, ("fit",)), "render"),
    "score": StageRule(("score", "{scene}", "--fused", "{fuse}", "--views", "fit={render}"), (_SCENE, ("fuse",), ("render",)), "score"),
}  # fmt: skip
COMMAND: Final = "command"
"""Name of the step that is a program of the user's own."""


@dataclass(frozen=True)
class BatchStage:
    """A step of a batch. words: its command, with names in braces; needs: steps whose results it reads; settings: what ``--config``
    holds for it; direct: whether results are made right below the output, by the scene's name alone."""

    name: str
    words: tuple[str, ...]
    needs: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    direct: bool = False

    @property
    def is_own(self) -> bool:
        """Whether it is a program of the user's own."""
        return self.name == COMMAND


@dataclass(frozen=True)
class Unit:
    """A step of a scene: what is claimed, done and recorded."""

    entry: Entry
    stage: BatchStage
    key: str
    needs: Mapping[str, str]
    """Step -> key of the results it reads."""

    @property
    def place(self) -> str:
        """Folder of its result below the output."""
        return self.entry.name if self.stage.direct else f"{self.entry.name}/{self.stage.name}/{self.key[:12]}"

    @property
    def title(self) -> str:
        """For messages."""
        return f"{self.entry.name} {self.stage.name}"


@dataclass(frozen=True)
class BatchPlan:
    """The steps of a batch, in order. The list is not part of it: it may grow."""

    stages: tuple[BatchStage, ...]

    def record(self) -> dict[str, Any]:
        """As JSON values: what must be the same for all who work on a batch."""
        stages = [{**asdict(stage), "settings": without_devices(stage.settings)} for stage in self.stages]
        return {"schema": 1, "version": version(), "rules": RULES_VERSION, "stages": stages}

    def units(self, entry: Entry) -> Iterator[Unit]:
        """The steps of a scene, in order."""
        keys: dict[str, str] = {}
        for stage in self.stages:
            needs = {name: keys[name] for name in stage.needs}
            unit = Unit(entry, stage, _key(stage, entry, needs), needs)
            keys[stage.name] = unit.key
            yield unit


@functools.cache
def _version() -> str:
    return version()


def _key(stage: BatchStage, entry: Entry, needs: Mapping[str, str]) -> str:
    """Content key: of the log's identity, settings, version and the keys of what is read."""
    values = [
        RULES_VERSION, _version(), stage.name, list(stage.words), without_devices(stage.settings), entry.name, entry.source,
        dict(entry.settings), dict(needs),
    ]  # fmt: skip
    return hashlib.sha256(store.json_text(values, indent=None).encode()).hexdigest()[:32]


def plan_of(names: Sequence[str], settings: Mapping[str, Any], command: Sequence[str] = ()) -> BatchPlan:
    """The plan of these steps.

    Args:
        settings: those of ``mudg run``, as JSON values. command: a program of the user's own, as the step ``command``.

    Raises:
        UsageError: an unknown step, one twice, or one whose inputs no step makes.
    """
    if command:
        if COMMAND not in names:
            names = (*names, COMMAND)
        if "{out}" not in " ".join(command):
            raise UsageError("a command must be told where to write", where="--command", expected="{out} among its words")
    known = {*STAGE_RULES, *([COMMAND] if command else [])}
    for name in names:
        if name not in known:
            raise UsageError("there is no such step", where="--stages", got=name, expected=", ".join(STAGE_RULES))
    if len(set(names)) < len(names) or not names:
        raise UsageError("each step at most once, and at least one", where="--stages", got=" ".join(names))
    stages: list[BatchStage] = []
    for name in names:
        made = [stage.name for stage in stages]
        if name == COMMAND:
            words = tuple(command)
            stages.append(BatchStage(name, words, tuple(one for one in made if "{" + one + "}" in " ".join(words))))
            continue
        rule = STAGE_RULES[name]
        own = dict(settings[rule.group] if rule.group else settings)
        stages.append(BatchStage(name, _words(rule, made, name), _needs(rule, made, name), own))
    return BatchPlan(tuple(stages))


def listed_plan(verb: str, settings: Mapping[str, Any], overwrite: bool) -> BatchPlan:
    """The plan of one verb over a list, whose results lie right below the output."""
    words = (verb, "{source}", *(["--overwrite"] if overwrite else []))
    return BatchPlan((BatchStage(verb, words, (), settings, direct=True),))


def _needs(rule: StageRule, made: Sequence[str], name: str) -> tuple[str, ...]:
    found = []
    for group in rule.needs:
        first = next((one for one in group if one in made), None)
        if first is not None:
            found.append(first)
        elif not set(group) & set(_SCENE):
            raise UsageError(f"the step {name} needs {' or '.join(group)} before it", where="--stages", got=" ".join((*made, name)))
    return tuple(found)


def _words(rule: StageRule, made: Sequence[str], name: str) -> tuple[str, ...]:
    """The step's command, ``{scene}`` replaced by the step that makes the scene, or by the source."""
    candidates = _SCENE if name != "annotate" else ("ingest",)
    scene = next((one for one in candidates if one in made), "source")
    return tuple(word.replace("{scene}", "{" + scene + "}") for word in rule.words)


def command_of(unit: Unit, places: Mapping[str, str], out: str, config: str) -> list[str]:
    """The command line of a step of a scene.

    Args:
        places: ``source`` and steps -> where they lie. out: folder to write. config: file of its settings, if it has any.
    """
    filled = {**places, "out": out, "name": unit.entry.name}
    words = [_filled(word, filled) for word in unit.stage.words]
    if unit.stage.is_own:
        return words
    groups = {"ingest": "", "run": "ingest."}
    own = list(line_words(unit.entry.settings, groups[unit.stage.name])) if unit.stage.name in groups else []
    return [sys.executable, "-m", "mudg", *words, "--out", out, "--quiet", *(["--config", config] if config else []), *own]


def line_words(settings: Mapping[str, str], group: str = "") -> Iterator[str]:
    """Flags for the settings of a line of the list. group: what their names begin with: ``ingest.`` in the chain."""
    for name, value in settings.items():
        if name == "cameras":
            yield from (f"--{group}cameras", *value.split(","))
        elif name == "seed":
            yield f"--{group}city.seed={value}"
        elif name in OF_A_LINE:
            yield f"--{group}{name}={value}"


def _filled(word: str, values: Mapping[str, str]) -> str:
    for name, value in values.items():
        word = word.replace("{" + name + "}", value)
    return word
