"""What a user may choose when importing a log; every importer reads the same options and says which it cannot honour."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mudg.base.errors import UsageError

Resolution = int | tuple[int, int]
"""Longest side in pixels, or width and height."""


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """Options of an import.

    Args:
        frames: source frame numbers ``(first, end)``, end not included; None takes all.
        cameras: the dataset's camera names; empty takes the importer's default.
        sequence: which sequence or frame of a folder that holds many.
        poses, boxes: files to use instead of those found by looking.
        skip_missing: leave out frames of which an image, scan or vehicle pose is missing, instead of refusing.
        bridge_gaps: lay curves through gaps between vehicle poses, instead of refusing the frames in them.
        untwist: undo the distortion of scans by the vehicle's motion; auto decides by what the dataset documents.
        test_every: hold out every n-th frame of all cameras (n, 2n, ...); 0 holds out none.
        resolution: size of the scene's images; None keeps the recorded one. See ``images.ImageFit``.
        workers: threads that convert frames; 0 = as many as there are processors to use. Results do not depend on it.
    """

    frames: tuple[int, int] | None = None
    cameras: tuple[str, ...] = ()
    sequence: str = ""
    poses: Path | None = None
    boxes: Path | None = None
    skip_missing: bool = False
    bridge_gaps: bool = False
    untwist: Literal["auto", "yes", "no"] = "auto"
    test_every: int = 4
    resolution: Resolution | None = None
    workers: int = 1


def parse_frame_range(text: str) -> tuple[int, int] | None:
    """``"10:26"`` -> (10, 26); an empty text -> None.

    Raises:
        UsageError: not of this form, or empty.
    """
    if not text:
        return None
    match = re.fullmatch(r"(\d{1,9}):(\d{1,9})", text.strip())
    if match is None or int(match[1]) >= int(match[2]):
        raise UsageError("frame range makes no sense", where="--frames",
            expected="FIRST:END with FIRST < END, e.g. 0:16", got=text)  # fmt: skip
    return int(match[1]), int(match[2])


def parse_resolution(text: str) -> Resolution | None:
    """``"960"`` -> 960 (longest side), ``"960x640"`` -> (960, 640); an empty text -> None.

    Raises:
        UsageError: not of this form, or below 16 pixels.
    """
    if not text:
        return None
    match = re.fullmatch(r"(\d{2,5})(?:x(\d{2,5}))?", text.strip().lower())
    sides = [int(side) for side in match.groups() if side] if match is not None else []
    if not sides or min(sides) < 16:
        raise UsageError("image size makes no sense", where="--resolution",
            expected="the longest side, e.g. 960, or WIDTHxHEIGHT, e.g. 960x640; at least 16 pixels", got=text)  # fmt: skip
    return sides[0] if len(sides) == 1 else (sides[0], sides[1])


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
