"""Networks of ``mudg annotate``: where they compute, what tells them apart in a scene's notes, and their depth in place of the filled.

A frame whose LiDAR returns are too few, or do not fit the network's depth, keeps the depth that was filled from them; it is marked by
a small file beside its labels, warned of, and counted in the notes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from mudg.base import log, store
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.base.errors import ResourceError, UsageError
from mudg.core.visible import RULES as HIDING_RULES
from mudg.core.visible import visible_depth
from mudg.models.depth.inputs import DepthInput, DepthNetwork, DepthOptions
from mudg.models.depth.networks import align_to_lidar, enough_returns, kind_of, load_depth_network
from mudg.models.folders import Place, find, title
from mudg.models.labels import street_net
from mudg.models.labels.by_geometry import RULES
from mudg.models.labels.inputs import LabelInput, Labels
from mudg.stages.config import AnnotateConfig

_FILLED: Final = ".filled.json"


def place(config: AnnotateConfig) -> Place:
    """Where the networks of a configuration compute."""
    device = choose_device(config.device, "networks of annotate", NETWORK_KINDS)
    return Place(str(device), config.precision == "bfloat16")


def placed(config: AnnotateConfig) -> AnnotateConfig:
    """The configuration with its device chosen; of one without networks, only if it names a device.

    Raises:
        UsageError: not a device for networks. ResourceError: it is not on this machine.
    """
    if config.device == "auto" and config.labeller == "geometry" and not config.depth_network:
        return replace(config, device="cpu")
    return replace(config, device=place(config).device)


def folders(config: AnnotateConfig) -> dict[str, Path]:
    """Flag that names a network's folder -> that folder, where one is named and lies on this machine."""
    found: dict[str, Path] = {}
    for name, text in (("weights", config.weights), ("depth-network", config.depth_network)):
        with contextlib.suppress(ResourceError):  # said when it is read, if it is
            found |= {name: find(text)} if text else {}
    return found


def digests(config: AnnotateConfig) -> dict[str, str]:
    """Field of the configuration that names a network's folder -> digest of the folder, for the networks that are used.

    Raises:
        UsageError: a depth network, but no depth. ResourceError: its folder is missing. InputError: it holds another kind.
    """
    found: dict[str, str] = {}
    if config.labeller == "network" and config.weights and (weights := find(config.weights)).is_dir():
        found["weights"] = store.digest(weights)
    if config.labeller == "embedded":
        found["weights"] = street_net.digest(config.weights or street_net.EMBEDDED)
    if config.depth_network:
        if not config.depth:
            raise UsageError("--depth-network contradicts --no-depth", where="--depth-network",
                             remedy="leave out one of them")  # fmt: skip
        kind_of(config.depth_network)
        found["depth_network"] = store.digest(find(config.depth_network))
    return found


def load(config: AnnotateConfig) -> DepthNetwork | None:
    """The depth network of a configuration, None if it names none.

    Raises:
        ResourceError, InputError: see ``load_depth_network``.
    """
    if not config.depth_network:
        return None
    return load_depth_network(
        config.depth_network, place(config), DepthOptions(config.depth_guided, config.depth_steps)
    )


def with_network(network: DepthNetwork, given: LabelInput, labels: Labels, frame_id: str, staging: Path) -> Labels:
    """Labels with the network's depth, aligned to the frame's LiDAR, or as they are if it cannot be."""
    measured = visible_depth(given.view, given.xyz_world, HIDING_RULES["sweep"], gap_deg=given.beam_gap_deg)
    asked = DepthInput(given.rgb, measured, labels.depth, labels.sky)
    reason = "too few LiDAR returns"
    if enough_returns(asked):
        found = align_to_lidar(network(asked), asked, RULES)
        if found.dense is not None:
            return replace(labels, depth=found.dense.depth, depth_confidence=found.dense.confidence)
        reason = f"the network's depth does not fit the LiDAR (half of the returns off by more than {found.fit.residual:.0%})"
        if not np.isfinite(found.fit.residual):
            reason = "the network's depth does not increase with the LiDAR's"
    log.warn(f"frame {frame_id}: {reason}; its depth is filled from LiDAR instead")
    store.write_json(_mark(staging, frame_id), {"reason": reason})
    return labels


def origin(config: AnnotateConfig, networks: Mapping[str, str], made: Sequence[str], staging: Path) -> str:
    """Where the depth of these frames comes from, in words for the scene's notes."""
    filled = f"points of {config.sweeps} sweeps, filled along the image, sky at a fixed distance"
    if "depth_network" not in networks:
        return filled
    without = sum(_mark(staging, frame_id).is_file() for frame_id in made)
    words = (
        f"network '{kind_of(config.depth_network)}'{describe_folder(config.depth_network, networks['depth_network'])}, aligned to "
        f"points of {config.sweeps} sweeps, sky at a fixed distance"
    )
    return words + (f"; {without} of them, where it did not fit: {filled}" if without else "")


def describe_folder(folder: str, digest: str) -> str:
    """Name (of one that did not come with the package) and digest of a network's folder, in words for the scene's notes."""
    where = f" in folder '{title(find(folder))}'" if folder else ""
    return f"{where} (sha256 {digest[:16]})"


def _mark(staging: Path, frame_id: str) -> Path:
    """File that says that a frame kept its filled depth."""
    return staging / f"{frame_id}{_FILLED}"
