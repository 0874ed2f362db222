"""What a user may choose when importing a log; every importer reads the same options and says which it cannot honour."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mudg.base.errors import UsageError


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """Options of an import.

    Args:
        frames: source frame numbers ``(first, end)``, end not included; None takes all.
        cameras: the dataset's camera names; empty takes the importer's default.
        sequence: which sequence or frame of a folder that holds many.
        poses, boxes: files to use instead of those found by looking.
        skip_missing: leave out frames of which an image or scan is missing, instead of refusing.
        untwist: undo the distortion of scans by the vehicle's motion; auto decides by what the dataset documents.
        test_every: hold out every n-th frame of all cameras (n, 2n, ...); 0 holds out none.
    """

    frames: tuple[int, int] | None = None
    cameras: tuple[str, ...] = ()
    sequence: str = ""
    poses: Path | None = None
    boxes: Path | None = None
    skip_missing: bool = False
    untwist: Literal["auto", "yes", "no"] = "auto"
    test_every: int = 4


def parse_frame_range(text: str) -> tuple[int, int] | None:
    """``"10:26"`` -> (10, 26); an empty text -> None.

    Raises:
        UsageError: not of this form, or empty.
    """
    if not text:
        return None
    match = re.fullmatch(r"(\d{1,9}):(\d{1,9})", text.strip())
    if match is None or int(match[1]) >= int(match[2]):
        raise UsageError(
            "frame range makes no sense", where="--frames", expected="FIRST:END with FIRST < END, e.g. 0:16", got=text
        )
    return int(match[1]), int(match[2])


def holdout_split(frame_ids_by_time: list[list[str]], test_every: int) -> dict[str, Literal["train", "test"]]:
    """Every ``test_every``-th moment (4, 8, 12, ... for 4; never the first) is held out, all cameras together.

    Args:
        frame_ids_by_time: ids of the frames of each moment, in time order.
        test_every: 0 holds out none.
    """
    return {
        frame_id: "test" if test_every > 0 and index > 0 and index % test_every == 0 else "train"
        for index, frame_ids in enumerate(frame_ids_by_time)
        for frame_id in frame_ids
    }
