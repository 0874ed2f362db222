"""``mudg report``: one page over many finished runs. A run that cannot be read is listed with its reason; the others go on."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mudg.base import log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.result_file import ResultFile
from mudg.pages.gallery import GalleryEntry, Unread, page, read_shown


def run(runs: Sequence[Path], out: Path, *, overwrite: bool = False) -> dict[str, Any]:
    """Write the page of finished runs, scores and benchmarks.

    Args:
        runs: folders of ``mudg run``, ``mudg score`` or ``mudg bench``; of any other folder, those directly in it.
        out: the file to write. overwrite: replace it if it exists.

    Returns:
        ``page``: the file; ``shown``: how many folders are on it; ``text``.

    Raises:
        UsageError: another page is there, or the output is no HTML file. InputError: nothing can be shown.
    """
    out = Path(out)
    if out.suffix != ".html":
        raise UsageError("the page is an HTML file", where="--out", expected="a name that ends in .html", got=str(out))
    shown: list[GalleryEntry] = []
    unread: list[Unread] = []
    for folder in _folders(runs):
        try:
            shown.append(read_shown(folder))
        except InputError as error:
            log.warn(f"{folder}: {error.what}")
            unread.append(Unread(folder, error.what if not error.got else f"{error.what}: {error.got}"))
        except PermissionError as error:
            log.warn(f"{folder}: access was refused")
            unread.append(Unread(folder, f"access was refused: {error.filename}"))
    if not shown:
        raise InputError(
            "no finished run to show", where=", ".join(str(one.folder) for one in unread[:4]),
            got="; ".join(dict.fromkeys(one.reason for one in unread[:4])), expected="folders of mudg run, score or bench",
        )  # fmt: skip
    content = page(shown, unread, out.resolve()).encode()
    with ResultFile.open(out, "report", {}, {"page": hashlib.sha256(content).hexdigest()}, overwrite=overwrite) as file:
        if file.complete:
            file.reused()
        else:
            store.atomic_write(file.staged(), content)
            file.finish({"runs": len(shown)})
    left = f", {len(unread)} not shown" if unread else ""
    text = f"page: {out.resolve()} ({len(shown)} runs{left}, {len(content) / 1e6:.1f} MB)"
    return {"page": out, "shown": len(shown), "text": text}


def _folders(runs: Sequence[Path]) -> list[Path]:
    """The folders asked for, each once; a folder that is no run stands for the folders in it."""
    found: list[Path] = []
    for given in map(Path, runs):
        own = any((given / name).is_file() for name in (store.RUN_STATE, "bench.json"))
        below = [] if own or not given.is_dir() else sorted(given.iterdir())
        inside = [one for one in below if one.is_dir() and not one.name.startswith((".", "_"))]
        found += [one for one in (inside or [given]) if one.resolve() not in {known.resolve() for known in found}]
    return found
