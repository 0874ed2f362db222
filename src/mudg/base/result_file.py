"""The output of a verb that is one file: one writer at a time, a description beside it, verified when the command is repeated.

    OUT         the file; a verb may have a second form of it, such as the folder of a large page
    OUT.json    its description: verb, key of settings and inputs, SHA-256, and what else the verb says

Whoever finds a file finds the description of just this file: an older file leaves before the new description gets its name, and the
new file gets its name last. What a stop leaves in between is completed, or undone, by the next command that writes there.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mudg.base import log, store
from mudg.base.errors import InputError, IntegrityError, ResourceError, UsageError
from mudg.base.run_folder import locked


def description_path(out: Path) -> Path:
    """The file beside an output that says what it is."""
    return out.with_name(f"{out.name}.json")


class ResultFile:
    """The output file of one verb, for this process alone. Make it at ``staged(form)``, then call ``finish``.

    ``complete`` is True where the same command has finished before and the file is as it was written.
    """

    def __init__(self, out: Path, verb: str, key: str, forms: Sequence[Path]) -> None:
        self.out, self.verb, self.key = out, verb, key
        self.complete = False
        self._forms = tuple(forms) or (out,)
        self._unknown = False
        """Whether a file without a description is there: it may be this very result, and is compared with it."""

    @classmethod
    @contextlib.contextmanager
    def open(
        cls, out: Path, verb: str, settings: Mapping[str, Any], inputs: Mapping[str, str], *,
        forms: Sequence[Path] = (), overwrite: bool = False,
    ) -> Iterator[ResultFile]:  # fmt: skip
        """Hold the output of a verb. Call ``refuse_overlap`` first.

        Args:
            inputs: name -> digest of what is read. forms: where the result may lie (none: at ``out``). overwrite: replace what is there.

        Raises:
            UsageError: another result, or somebody else's file, is there. IntegrityError: the finished result was altered.
            ResourceError: it cannot be written, or another live process is writing it.
        """
        key = hashlib.sha256(store.json_text([verb, dict(settings), dict(inputs)], indent=None).encode()).hexdigest()
        result = cls(Path(out), verb, key, forms)
        with locked(_lock_path(out), out):
            try:
                result._recover()
                result._examine(overwrite)
                yield result
            finally:
                result._tidy()

    @property
    def path(self) -> Path:
        """Where the file is made."""
        return self.staged()

    def staged(self, form: Path | None = None) -> Path:
        """Where the content of a form is made."""
        form = form or self.out
        return form.with_name(f".{form.name}.new.part{form.suffix}")

    def finish(self, about: Mapping[str, Any], form: Path | None = None) -> Path:
        """Give what was made its name, and its description; returns where it lies.

        Raises:
            UsageError: a file that nothing describes is there, and it is another.
        """
        form = form or self.out
        old = [one for one in self._forms if os.path.lexists(one)]
        values = {
            "schema": 1, "verb": self.verb, "key": self.key, "file": form.name, "sha256": store.digest(self.staged(form)), **about
        }  # fmt: skip
        if self._unknown and (old != [form] or store.digest(form) != values["sha256"]):
            raise UsageError("the file exists", where=str(old[0]), remedy="choose another --out, or add --overwrite")
        with store.disk_errors("the result cannot get its name", form):
            if self._unknown:
                store.write_json(description_path(self.out), values)
                log.info(f"{self.verb}: {form} was there, and is the same")
                return form
            for one in old:
                one.rename(self._retired(one))
            store.write_json(description_path(self.out), values)
            self.staged(form).rename(form)
            store.fsync_directory(form.parent)
        return form

    def reused(self) -> Path:
        """Say that an earlier result is used again, and return where it lies."""
        form = next(one for one in self._forms if os.path.lexists(one))
        log.info(f"{self.verb}: reused {form} (verified)")
        return form

    def _retired(self, form: Path) -> Path:
        return form.with_name(f".{form.name}.old.part{form.suffix}")

    def description(self) -> dict[str, Any]:
        """What ``OUT.json`` says; empty where it is missing or somebody else's."""
        try:
            found = store.read_json(description_path(self.out))
        except InputError:
            return {}
        known = isinstance(found, dict) and all(isinstance(found.get(name), str) for name in ("verb", "key", "file", "sha256"))
        return found if known else {}

    def _examine(self, overwrite: bool) -> None:
        about, file = self.description(), description_path(self.out)
        if os.path.lexists(self.out) and not self.out.is_file():
            raise ResourceError("cannot write here", where=str(self.out), got="not a regular file", remedy="choose another --out")
        there = [one for one in self._forms if os.path.lexists(one)]
        if about.get("key") == self.key and [one.name for one in there] == [about["file"]]:
            self.complete = store.digest(there[0]) == about["sha256"]
            if not (self.complete or overwrite):
                raise IntegrityError("a file was altered after it was written", where=str(there[0]), expected=f"sha256 {about['sha256']}",
                    remedy="add --overwrite to make it again, or choose another --out")  # fmt: skip
        elif not overwrite:
            self._unknown = bool(there) and not os.path.lexists(file)
            blocked = (not there and not about and os.path.lexists(file)) or (there and not self._unknown)
            if blocked:
                got = "a result of other settings or inputs" if about else "a file of something else"
                raise UsageError("the file exists", where=str(there[0] if there else file), got=got,
                    remedy="choose another --out, or add --overwrite")  # fmt: skip

    def _recover(self) -> None:
        """Complete a ``finish`` that was cut off after its description was written, undo one that was before."""
        if any(os.path.lexists(one) for one in self._forms):
            return
        wanted = self.description().get("sha256")
        for one in self._forms:
            if self.staged(one).exists() and store.digest(self.staged(one)) == wanted:
                self.staged(one).rename(one)
                return
        for one in self._forms:
            if os.path.lexists(self._retired(one)):
                self._retired(one).rename(one)

    def _tidy(self) -> None:
        """Remove what this and earlier, killed commands left: no other is at work here."""
        ends = [(one, r"[a-z0-9_]{8}\.part") for one in (*self._forms, description_path(self.out), _lock_path(self.out))]
        names = [re.escape(f".{one.stem}.") + end + re.escape(one.suffix) for one, end in ends]
        for one in self._forms:
            names += [re.escape(self._retired(one).name), rf"\.?{re.escape(self.staged(one).name.removesuffix(one.suffix))}.*"]
        left = re.compile("|".join(names))
        with contextlib.suppress(OSError):  # an error may have brought us here, and that one is to be told
            for one in [one for one in self.out.parent.iterdir() if left.fullmatch(one.name)]:
                shutil.rmtree(one) if one.is_dir() and not one.is_symlink() else one.unlink()


def _lock_path(out: Path) -> Path:
    return out.with_name(f".{out.name}.lock")
