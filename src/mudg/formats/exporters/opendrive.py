"""The driven corridor as a minimal OpenDRIVE 1.6 map: one road along the recorded path, with lanes of one width.

Its reference line is the path in pieces of cubic polynomials, its elevation likewise. The lane that was driven is
centred on the path; further lanes are as many as the road's surface is wide, in the direction of travel to the right of
it and against it to the left. Nothing recorded says where lanes are painted or which way traffic goes there.
"""

from __future__ import annotations

import math
from typing import Final
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from mudg.scene.road import Road

LANE_M: Final = 3.5
PIECE_M: Final = 5.0
"""Length of the pieces of the reference line."""
WIDEST_M: Final = 15.0
"""Surface farther from the path belongs to other roads."""
STRIP_M: Final = 4.0
"""Length of the strips whose widths are compared: their median is that of the road."""
FEWEST: Final = 20
"""Points in a strip that tell a width."""


def opendrive(road: Road, surface: NDArray[np.floating], name: str) -> bytes:
    """The map as XML.

    Args:
        road: the path, metres, z up. surface: f[N, 3] points of the road's surface in the same frame; none: one lane.
        name: of the map.
    """
    count = max(1, round(road.length_m / PIECE_M))
    stations = np.linspace(0.0, road.length_m, count + 1)
    poses = np.stack([road.recorded(float(station)) for station in stations])
    pieces = [_piece(before, after) for before, after in zip(poses[:-1], poses[1:], strict=True)]
    starts = np.concatenate([[0.0], np.cumsum([length for length, _ in pieces])])
    root = ElementTree.Element("OpenDRIVE")
    low, high = poses[:, :2, 3].min(0) - WIDEST_M, poses[:, :2, 3].max(0) + WIDEST_M
    header = {"revMajor": "1", "revMinor": "6", "name": name, "version": "1.00", "date": "1970-01-01T00:00:00"}
    edges = {"north": high[1], "south": low[1], "east": high[0], "west": low[0]}
    header |= {key: _number(value) for key, value in edges.items()}
    ElementTree.SubElement(root, "header", {**header, "vendor": "mudg"})
    whole = {"name": name, "length": _number(starts[-1]), "id": "1", "junction": "-1", "rule": "RHT"}
    element = ElementTree.SubElement(root, "road", whole)
    kind = ElementTree.SubElement(element, "type", {"s": "0", "type": "town"})
    ElementTree.SubElement(kind, "speed", {"max": "50", "unit": "km/h"})
    line, heights = ElementTree.SubElement(element, "planView"), ElementTree.SubElement(element, "elevationProfile")
    for start, pose, after, (length, numbers) in zip(starts, poses, poses[1:], pieces, strict=False):
        heading = math.atan2(pose[1, 0], pose[0, 0])
        at = {"s": start, "x": pose[0, 3], "y": pose[1, 3], "hdg": heading, "length": length}
        piece = ElementTree.SubElement(line, "geometry", {key: _number(value) for key, value in at.items()})
        ElementTree.SubElement(piece, "paramPoly3", {**numbers, "pRange": "normalized"})
        rise = [one[2, 0] / math.hypot(one[0, 0], one[1, 0]) * length for one in (pose, after)]
        climb = after[2, 3] - pose[2, 3]
        a, b = pose[2, 3], rise[0] / length
        c, d = (3 * climb - 2 * rise[0] - rise[1]) / length**2, (rise[0] + rise[1] - 2 * climb) / length**3
        terms = {"s": start, "a": a, "b": b, "c": c, "d": d}
        ElementTree.SubElement(heights, "elevation", {key: _number(value) for key, value in terms.items()})
    _lanes(element, *lanes_beside(road, surface))
    ElementTree.indent(root, " ")
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root) + b"\n"


def _piece(before: NDArray[np.float64], after: NDArray[np.float64]) -> tuple[float, dict[str, str]]:
    """Length and coefficients of the cubic from pose to pose f64[4, 4], which keeps both headings."""
    heading = math.atan2(before[1, 0], before[0, 0])
    turn = math.atan2(after[1, 0], after[0, 0]) - heading
    dx, dy = after[:2, 3] - before[:2, 3]
    u, v = math.cos(heading) * dx + math.sin(heading) * dy, math.cos(heading) * dy - math.sin(heading) * dx
    chord = math.hypot(u, v)
    end = chord * np.array([math.cos(turn), math.sin(turn)])
    c = 3 * np.array([u, v]) - np.array([2 * chord, 0.0]) - end
    d = np.array([chord, 0.0]) + end - 2 * np.array([u, v])
    p = np.linspace(0, 1, 201)[:, None]
    speed = np.linalg.norm(np.array([chord, 0.0]) + 2 * c * p + 3 * d * p**2, axis=1)
    names = {"aU": 0.0, "bU": chord, "cU": c[0], "dU": d[0], "aV": 0.0, "bV": 0.0, "cV": c[1], "dV": d[1]}
    return float(np.trapezoid(speed, p[:, 0])), {key: _number(value) for key, value in names.items()}


def lanes_beside(road: Road, surface: NDArray[np.floating]) -> tuple[int, int]:
    """Number of lanes to the left and to the right of the driven one, by the width of the road's surface."""
    near = np.array([road.locate(point) for point in surface[:: max(1, len(surface) // 20_000), :2]]).reshape(-1, 2)
    near = near[(abs(near[:, 1]) < WIDEST_M) & (near[:, 0] >= 0) & (near[:, 0] <= road.length_m)]
    strips = [near[(near[:, 0] // STRIP_M) == n, 1] for n in range(int(road.length_m // STRIP_M) + 1)]
    wide = [np.quantile(strip, (0.98, 0.02)) for strip in strips if len(strip) >= FEWEST]
    left, right = np.median(wide, axis=0) if wide else (0.0, 0.0)
    beside = lambda reach: max(0, math.floor((reach - LANE_M / 2) / LANE_M + 0.25))
    return beside(float(left)), beside(-float(right))


def _lanes(element: ElementTree.Element, left: int, right: int) -> None:
    lanes = ElementTree.SubElement(element, "lanes")
    zero = {"a": "0", "b": "0", "c": "0", "d": "0"}
    ElementTree.SubElement(lanes, "laneOffset", {"s": "0", **zero, "a": _number(LANE_M / 2)})
    section = ElementTree.SubElement(lanes, "laneSection", {"s": "0"})
    sides = {"left": range(left, 0, -1), "center": (0,), "right": range(-1, -right - 2, -1)}
    for side, ids in sides.items():
        if not ids:
            continue
        group = ElementTree.SubElement(section, side)
        for number in ids:
            kind = "driving" if number else "none"
            lane = ElementTree.SubElement(group, "lane", {"id": str(number), "type": kind, "level": "false"})
            if number:
                ElementTree.SubElement(lane, "width", {"sOffset": "0", **zero, "a": _number(LANE_M)})


def _number(value: float) -> str:
    return f"{value:.9g}" if abs(value) > 1e-12 else "0"
