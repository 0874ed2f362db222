"""Which Gaussians a page keeps, and how they are cut into chunks, so that the first one alone is a coarse picture of the whole scene.

The Gaussians are ranked by what they cover in the recorded views. Chunk 0 holds the first `CHUNK` of them, from everywhere in the scene,
the two chunks after it the next 2 `CHUNK`, then 4, 8, ...: one level of detail after another, each as large as all before it and one
chunk more. Within a level the rows are ordered by node, within a node along a Morton curve, and cut into chunks: each is a region,
and a page fetches those near its camera first. Every chunk is full except for the last. A scene of at most `SMALL` chunks is cut into
halves of chunks, because its first picture, of one chunk, comes sooner that way.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import UsageError

CHUNK: Final = 65_536
"""Gaussians per chunk."""
SMALL: Final = 2
"""Chunks of a scene whose chunks are half as large."""
MOST_CHUNKS: Final = 256
"""A chunk is a layer of a texture array; WebGL2 promises this many."""
ALPHA_MIN: Final = 1 / 255
"""The rasterizer draws no Gaussian below it."""
MOVING_M: Final = 10.0
"""What moves counts as this far from the cameras."""
_SLICE: Final = 1 << 18
"""Rows that are worked on at once; bounds what is held beside the scene."""


@dataclass(frozen=True, slots=True)
class Layout:
    """The rows of a page.

    Args:
        rows: of the scene, in the order of the page, intp[n]. size: rows per chunk.
        given: rows of the scene. visible: of these, rows that can be drawn.
        lost: what was left out for the budget covers this share of what all of them cover, 0 to 1.
    """

    rows: NDArray[np.intp]
    size: int
    given: int
    visible: int
    lost: float

    def __len__(self) -> int:
        return -(-len(self.rows) // self.size)

    def chunk(self, index: int) -> NDArray[np.intp]:
        """Rows of a chunk."""
        return self.rows[index * self.size : (index + 1) * self.size]


def level_of(chunk: int) -> int:
    """Level of detail of a chunk: 0, 1, 1, 2, 2, 2, 2, 3, ..."""
    return (chunk + 1).bit_length() - 1


def lay_out(
    columns: Mapping[str, NDArray[Any]], node: NDArray[np.integer], path: NDArray[np.floating] | None, most: int = 0, size: int = CHUNK
) -> Layout:  # fmt: skip
    """Choose and order rows.

    Args:
        columns: of the scene's table. node: of each row.
        path: positions of the cameras f64[m, 3]. most: rows to keep (0 = all that can be drawn). size: rows per chunk
            of a scene that is not small.

    Raises:
        UsageError: more rows than a page can hold.
    """
    rows = np.flatnonzero(opacity_of(columns["logits"]) >= ALPHA_MIN)
    visible, lost = len(rows), 0.0
    worth = coverage(columns, node, path)[rows]
    ranks = np.argsort(-worth, kind="stable")
    if most and visible > most:
        lost = float(worth[ranks[most:]].sum() / max(worth.sum(), 1e-300))
        ranks = ranks[:most]
    if len(ranks) > MOST_CHUNKS * size:
        raise UsageError("more Gaussians than a page can hold", where="--budget", got=f"{len(ranks):,}",
                         expected=f"at most {MOST_CHUNKS * size:,}", remedy="set --budget to keep those that cover most")  # fmt: skip
    rows, size = rows[ranks], chunk_rows(len(ranks), size)
    level = np.repeat([np.int8(level_of(k)) for k in range(-(-len(rows) // size))], size)[: len(rows)]
    order = np.lexsort((morton_codes(columns["means"], node, rows), node[rows], level))
    return Layout(rows[order], size, len(node), visible, lost)


def chunk_rows(rows: int, size: int = CHUNK) -> int:
    """Rows per chunk of a scene with so many: half of ``size`` in a small scene."""
    return max(1, size // 2) if rows <= SMALL * size else size


def opacity_of(logits: NDArray[np.floating]) -> NDArray[np.float64]:
    """Opacities between 0 and 1."""
    return 1 / (1 + np.exp(-logits.astype(np.float64)))


def _slices(count: int) -> Iterator[slice]:
    for start in range(0, count, _SLICE):
        yield slice(start, min(count, start + _SLICE))


def coverage(
    columns: Mapping[str, NDArray[Any]], node: NDArray[np.integer], path: NDArray[np.floating] | None
) -> NDArray[np.float64]:
    """Opacity times the area that each Gaussian covers in an image taken where the path is nearest: f64[n], square radians."""
    from scipy.spatial import cKDTree

    tree = cKDTree(path) if path is not None and len(path) else None
    found = np.empty(len(node))
    for part in _slices(len(node)):
        two = np.sort(columns["log_scales"][part], 1)[:, 1:].sum(1).astype(np.float64)
        distance2 = np.full(len(two), MOVING_M**2)
        still = node[part] == 0
        if tree is not None and still.any():
            distance2[still] = tree.query(columns["means"][part][still])[0] ** 2
        found[part] = opacity_of(columns["logits"][part]) * np.exp(two) / np.maximum(distance2, 1.0)
    return found


def morton_codes(
    means: NDArray[np.floating], node: NDArray[np.integer], rows: NDArray[np.integer]
) -> NDArray[np.uint64]:
    """Places of rows along a space-filling curve through each node's own box: u64[rows], 16 bits per axis."""
    codes = np.zeros(len(rows), np.uint64)
    for one in np.unique(node[rows]):
        own = np.flatnonzero(node[rows] == one)
        low, high = means[rows[own]].min(0), means[rows[own]].max(0)
        for part in _slices(len(own)):
            here = own[part]
            cell = ((means[rows[here]] - low) / np.maximum(high - low, 1e-9) * 65535).astype(np.uint64)
            mixed = np.zeros(len(cell), np.uint64)
            for bit in range(16):
                for axis in range(3):
                    mixed |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
            codes[here] = mixed
    return codes
