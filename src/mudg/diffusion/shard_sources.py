"""Training on thousands of scenes: what a list says, which clip is drawn, and scenes that cannot be used.

A list is a file in YAML or JSON; nothing of a scene is read before it is drawn.

    data_sets: {nuscenes: 3.0, kitti: 1.0}              shares of the clips (left out: by the number of scenes)
    scenes:
      - s3://bucket/clips/0001                          a folder of clips, or
      - {path: runs/0002, data_set: kitti, weight: 2, held_out: true}
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Final, NamedTuple

import numpy as np
from pydantic import BeforeValidator, Field

from mudg.base import log, plain_yaml, seeds, store
from mudg.base.errors import InputError, IntegrityError, UsageError
from mudg.base.location import Location
from mudg.base.records import StrictRecord, parse_record
from mudg.base.types import Clip
from mudg.diffusion import log_clips
from mudg.diffusion.city_clips import HELD_OUT
from mudg.diffusion.clips import Result, Shards, TrainingClips, shard_path
from mudg.diffusion.log_clips import LogClipRules
from mudg.scene.read import read_scene

SUFFIXES: Final = (".yaml", ".yml", ".json")
LARGEST_LIST: Final = 4_000_000
"""Bytes of a list in YAML; one in JSON may be larger."""
SPAN: Final = 100_000_000
"""Shard k of the list's n-th scene has the number n * SPAN + k + 1."""


class ListedScene(StrictRecord):
    """One scene of a list."""

    path: str = Field(min_length=1)
    """A folder of clips, the output of `mudg run`, or SCENE=FUSED; on this machine or at an address."""
    data_set: str = "scenes"
    weight: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0
    """How often it is drawn, compared with others of its data set."""
    held_out: bool = False
    """Whether it is for scoring only."""


class _Listed(StrictRecord):
    data_sets: dict[str, Annotated[float, Field(ge=0, allow_inf_nan=False)]] = {}
    scenes: list[
        Annotated[ListedScene, BeforeValidator(lambda value: {"path": value} if isinstance(value, str) else value)]
    ] = Field(min_length=1)


class SceneList:
    """The scenes of a list and how they are drawn. scenes: in the list's order, which numbers them. weights: of data
    sets; each left out counts as its scenes' weights together. held_out: if no scene is marked for scoring, so many are
    set apart, chosen by their paths alone."""

    def __init__(self, scenes: Sequence[ListedScene], weights: dict[str, float], held_out: int, where: str) -> None:
        self.scenes, self.where = scenes, where
        self.scored = [n for n, scene in enumerate(scenes) if scene.held_out]
        if not self.scored and held_out:
            by_name = sorted(range(len(scenes)), key=lambda n: seeds.key(0, 0, f"held out {scenes[n].path}"))
            self.scored = sorted(by_name[: min(held_out, len(scenes) - 1)])
        kept = set(self.scored)
        self.members: dict[str, list[int]] = {}
        for n, scene in enumerate(scenes):
            if n not in kept and scene.weight > 0:
                self.members.setdefault(scene.data_set, []).append(n)
        unknown = sorted(set(weights) - {scene.data_set for scene in scenes})
        if unknown:
            what, got = "a weight is given for a data set without scenes", ", ".join(unknown[:8])
            raise InputError(what, where=where, got=got, expected=f"one of {', '.join(list(self.members)[:20])}")
        self._sums = {name: np.cumsum([scenes[n].weight for n in of]) for name, of in self.members.items()}
        shares = np.array([weights.get(name, float(self._sums[name][-1])) for name in self.members], np.float64)
        if not len(shares) or shares.sum() <= 0:
            raise InputError("no scene of the list is left to train on", where=where, remedy="give positive weights")
        self.shares = dict(zip(self.members, (shares / shares.sum()).tolist(), strict=True))
        self._cuts = np.cumsum(shares / shares.sum())

    def draw(self, rng: np.random.Generator) -> int:
        """The number of a scene: a data set by its share, then a scene of it by its weight."""
        chosen = min(int(np.searchsorted(self._cuts, rng.random(), side="right")), len(self._cuts) - 1)
        name = list(self.members)[chosen]
        sums = self._sums[name]
        place = min(int(np.searchsorted(sums, rng.random() * sums[-1], side="right")), len(sums) - 1)
        return self.members[name][place]

    def summary(self) -> str:
        """Data sets with their scenes and shares, a line each."""
        lines = [f"{len(self.scenes)} scenes, {len(self.scored)} of them held out"]
        lines += [
            f"  {name}: {len(of)} scenes, {100 * self.shares[name]:.3g} % of the clips"
            for name, of in self.members.items()
        ]
        return "\n".join(lines)


def is_list(scenes: Sequence[str]) -> bool:
    """Whether the setting `scenes` names a list."""
    return len(scenes) == 1 and PurePosixPath(scenes[0]).suffix.lower() in SUFFIXES


def read_list(text: str, held_out: int = 0) -> SceneList:
    """Read a list. Relative paths are relative to the working directory. InputError: it is not there, or no list; names
    the record and the field."""
    suffix = PurePosixPath(text).suffix.lower()
    content = Location.of(text).load()
    value = store.parse_json(content, text) if suffix == ".json" else plain_yaml.parse_yaml(content, text, LARGEST_LIST)
    listed = parse_record(_Listed, {"scenes": value} if isinstance(value, list) else value, f"{text}: ")
    return SceneList(listed.scenes, listed.data_sets, held_out, text)


# clips from elsewhere -----------------------------------------------------------------------------


class ShardCache:
    """A folder of shards of at most `limit` bytes, which several processes may share. Those used longest ago, by the
    time of their last change, are removed first; the newest one always stays."""

    def __init__(self, folder: Path, limit: int) -> None:
        self.folder, self.limit = folder, limit
        self._locks: dict[str, threading.Lock] = {}
        self._own = threading.Lock()

    def get(self, name: str, make: Callable[[Path], None]) -> Path:
        """The file `name` below the folder; `make` brings it if it is not there. Threads wait for each other's."""
        path = self.folder / name
        with self._own:
            lock = self._locks.setdefault(name, threading.Lock())
        with lock:
            if not path.is_file():
                make(path)
                with self._own:
                    self._evict(path)
        with contextlib.suppress(OSError):
            os.utime(path)
        return path

    def _evict(self, newest: Path) -> None:
        found: list[tuple[int, int, Path]] = []
        for path in self.folder.rglob("*.safetensors"):
            with contextlib.suppress(OSError):  # another process removed it
                facts = path.stat()
                found.append((facts.st_mtime_ns, facts.st_size, path))
        total = sum(size for _, size, _ in found)
        for _, size, path in sorted(found):
            if total > self.limit and path != newest:
                store.remove(path)
                total -= size


class FolderOfShards:
    """A folder of shards at an address: their `numbers`, sorted, and the sums that its upload recorded, or that of a
    folder around it such as the output of a training (none: they are not known)."""

    def __init__(self, place: Location) -> None:
        self.place, self.sums = place, dict[str, str]()
        head = place.text.rpartition("/")[0]
        parent = [(Location.of(head), f"{place.name}/")] if head and not head.endswith("/") else []
        for above, prefix in () if place.local is not None else ((place, ""), *parent):
            upload = above.uploaded()
            if upload is not None:
                files = upload.files.items()
                self.sums = {n[len(prefix) :]: one.sha256 for n, one in files if n.startswith(prefix)}
                break
        names = sorted(self.sums) or place.names()
        found = (n[5:-12] for n in names if n.startswith("city_") and n.endswith(".safetensors"))
        self.numbers = sorted(int(n) for n in found if n.isdecimal())
        said = store.json_text([place.text, sorted(self.sums.items())], indent=None)
        self.key = hashlib.sha256(said.encode()).hexdigest()[:24]
        """A name for the folder in a cache, by its address and content."""

    def find(self, cache: ShardCache, number: int) -> Path:
        """A shard's file, on this machine."""
        if self.place.local is not None:
            return shard_path(self.place.local, number)
        return cache.get(f"{self.key}/{number:07d}.safetensors", functools.partial(self.bring, number))

    def bring(self, number: int, path: Path) -> None:
        """Write a shard to `path`; IntegrityError: it is not what was uploaded."""
        name = shard_path(Path(), number).name
        content = (self.place / name).load()
        got = hashlib.sha256(content).hexdigest()
        wanted = self.sums.get(name, got)
        if got != wanted:
            raise IntegrityError(
                "what came is not what was uploaded",
                where=f"{self.place}/{name}",
                expected=f"sha256 {wanted[:16]}...",
                got=f"sha256 {got[:16]}...",
                remedy="upload the clips again",
            )
        store.atomic_write(path, content)


# shards of listed scenes --------------------------------------------------------------------------


class _OpenScene(NamedTuple):
    """What is known of a scene once it was drawn: the numbers of its shards, and how each is found."""

    shards: Sequence[int]
    find: Callable[[int], Path]


class ListedShards(Shards):
    """Clips of the scenes of a list, fetched or made when they are drawn. Scenes and shards that are missing or damaged
    are named once and left out; others are drawn in their place. rules: how clips are cut from scenes that are logs.
    limit: share of the scenes that may be left out."""

    def __init__(self, scenes: SceneList, cache: ShardCache, rules: LogClipRules, limit: float) -> None:
        self.scenes, self._cache, self._limit = scenes, cache, limit
        self._rules = replace(rules, held_out_every=0)
        self.opened = functools.lru_cache(maxsize=512)(self._opened)
        """The facts of a scene, by its number. Raises InputError or IntegrityError: it is missing or damaged, or there
        is no clip in it."""
        self.bad: dict[int, str] = {}
        """What is left out, and why, by number of the shard; n * SPAN is the whole n-th scene."""
        self._lock = threading.Lock()

    def draw(self, rng: np.random.Generator, take: Callable[[int], Result]) -> Result:
        """What `take` makes of a shard drawn with `rng`: a function of `rng` and of what the scenes hold. UsageError:
        too many scenes are missing or damaged."""
        while True:
            scene, place = self.scenes.draw(rng), rng.random()
            number = scene * SPAN
            if number in self.bad:
                continue
            try:
                shards = self.opened(scene).shards
                number += shards[min(int(place * len(shards)), len(shards) - 1)] + 1
                if number not in self.bad:
                    return take(number)
            except (InputError, IntegrityError) as error:
                self._leave_out(number, error)

    def _leave_out(self, number: int, error: InputError | IntegrityError) -> None:
        """A scene that cannot be opened, or one of its shards. Others of a scene are drawn on: what is left out must
        not depend on what this process happened to read before."""
        scenes = self.scenes.scenes
        with self._lock:
            if number not in self.bad:
                self.bad[number] = str(error)
                what = "a scene is" if number % SPAN == 0 else "clips of a scene are"
                log.warn(f"learn: {what} left out: {scenes[number // SPAN].path}", *str(error).splitlines())
            count = len({bad // SPAN for bad in self.bad})
        most = int(self._limit * len(scenes))
        if count > most or count == len(scenes):
            raise UsageError(
                "too many scenes of the list are missing or damaged",
                where=f"{self.scenes.where}, --data.bad-scenes",
                expected=f"at most {most} of {len(scenes)}",
                got=f"{count}, the last: {str(error).splitlines()[0]}",
                remedy="repair the scenes named above or take them off the list",
            ) from error

    def scored(self) -> list[int]:
        """The first shard of every held-out scene, or of one trained on where none is. Those that cannot be used are
        left out; InputError where none can."""
        found = []
        for scene in self.scenes.scored or [next(iter(self.scenes.members.values()))[0]]:
            try:
                number = scene * SPAN + self.opened(scene).shards[0] + 1
                self.clips_in(number)
                found.append(number)
            except (InputError, IntegrityError) as error:
                self._leave_out(scene * SPAN, error)
        if not found:
            raise InputError("no held-out scene of the list can be used", where=self.scenes.where)
        return found

    def path(self, number: int) -> Path:
        """A shard's file, on this machine."""
        scene, shard = divmod(number, SPAN)
        return self.opened(scene).find(shard - 1)

    def reading(self, number: int, read: Callable[[Path], Result]) -> Result:
        """What `read` makes of a shard's file; once more if another process removed the file in between."""
        path = self.path(number)
        try:
            return read(path)
        except InputError:
            if path.is_file():
                raise
        return read(self.path(number))

    def _opened(self, scene: int) -> _OpenScene:
        text = self.scenes.scenes[scene].path
        folder = None if "=" in text else FolderOfShards(Location.of(text))
        if folder is None or not (folder.numbers or folder.place.local is None):
            found = self._of_log(text, scene in self.scenes.scored)
        else:
            numbers = [n for n in folder.numbers if n < HELD_OUT] or folder.numbers
            found = _OpenScene(numbers, functools.partial(folder.find, self._cache))
        if not found.shards or found.shards[-1] >= SPAN - 1:
            raise InputError("no training clips in a scene", where=text)
        return found

    def _of_log(self, text: str, scored: bool) -> _OpenScene:
        """A log's clips, all made when the first one is wanted, and kept in the cache by the log's content."""
        source, rules = log_clips.log_source(text), self._rules
        windows = [window._replace(held_out=scored) for window in rules.windows(read_scene(source.scene))]
        said = store.json_text([store.digest(source.scene), store.digest(source.fused), asdict(rules), scored])
        folder = hashlib.sha256(said.encode()).hexdigest()[:24]

        def bring(path: Path) -> None:
            try:
                log_clips.write_log(source, rules, list(enumerate(windows)), path.parent)
            except (InputError, IntegrityError):
                if not path.is_file():  # else another clip of the log is at fault
                    raise

        return _OpenScene(
            range(len(windows)), lambda n: self._cache.get(f"{folder}/{shard_path(Path(), n).name}", bring)
        )


class ListedClips(TrainingClips):
    """Clips of the scenes of a list. A scene of another size than `size` is a bad one."""

    shards: ListedShards

    def reader(self, step: int, count: int, frames: int, purpose: str) -> Callable[[int], Clip]:
        """What reads the clip of a place in the batch."""
        del count
        return lambda place: self._drawn(step, place, frames, purpose)

    def _drawn(self, step: int, place: int, frames: int, purpose: str) -> Clip:
        seed = self.config.seed
        chosen, start = seeds.numpy_rng(seed, step, f"{purpose}, frames {place}").random(2).tolist()

        def take(shard: int) -> Clip:
            clip = int(chosen * self.shards.clips_in(shard))
            first = int(start * (self.config.data.window - frames + 1))
            return self.read(shard, clip, range(first, first + frames), self.size)

        return self.shards.draw(seeds.numpy_rng(seed, step, f"{purpose}, scene {place}"), take)

    def have_patches(self) -> bool:
        """Whether the clips have patches at a higher resolution."""
        return self._drawn(0, 0, 1, "patches").fine is not None

    def weighed(self) -> Sequence[int]:
        """Some shards that are drawn from the list, where classes are balanced."""

        def usable(number: int) -> int:
            self.shards.clips_in(number)
            return number

        count = 20 if self.config.loss.class_balance else 0
        return [self.shards.draw(seeds.numpy_rng(self.config.seed, n, "class weights"), usable) for n in range(count)]

    def to_score(self) -> Sequence[int]:
        """The first shard of every held-out scene."""
        return self.shards.scored()
