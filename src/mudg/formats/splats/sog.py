"""SOG (PlayCanvas), version 2: a stored zip of lossless WebP pictures, one pixel a Gaussian, and ``meta.json``. The
smallest of all here.

means_l, means_u   low and high byte of 16 bits of sign(x) ln(|x| + 1), between ``mins`` and ``maxs``
quats              r g b: the three smallest of (w, x, y, z) times sqrt 2, as (v + 1) / 2; alpha: 252 + index of the
                   largest
scales, sh0        index into a table of 256 values: natural logarithms of sizes; f_dc, with the opacity in alpha
shN_labels         16 bits (red, green): which row of ``shN_centroids``; these hold indices into another table of 256
                   values
meta.json          besides: ``antialias``, or in newer files ``model``: default, antialiased, 2dgs
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable
from typing import Annotated, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from pydantic import Field
from scipy.spatial import cKDTree

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.records import ForeignRecord, Number, parse_record
from mudg.formats.splats import binary
from mudg.formats.splats.cloud import SplatCloud, SplatFile, checked, logit, refuse_rows
from mudg.formats.unknown_fields import listed, sentence

CODES: Final = 256
MAX_PALETTE: Final = 65536
ROUNDS: Final = 8
_MOST_META: Final = 1 << 20
_MODELS: Final = (None, "default", "3dgs", "antialiased", "2dgs")
_WIDTH: Final = 64
"""Centroids beside each other in their picture."""

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Three = Annotated[list[Number], Field(min_length=3, max_length=3)]
Codebook = Annotated[list[Number], Field(min_length=CODES, max_length=CODES)]
One = Annotated[list[str], Field(min_length=1, max_length=1)]
Two = Annotated[list[str], Field(min_length=2, max_length=2)]


class SogMeans(ForeignRecord):
    """Bounds of the transformed places, and their pictures."""

    mins: Three
    maxs: Three
    files: Two


class SogTable(ForeignRecord):
    """A table of values, and the picture of indices."""

    codebook: Codebook
    files: One


class SogRotations(ForeignRecord):
    """The picture of rotations."""

    files: One


class SogHarmonics(ForeignRecord):
    """The palette of harmonics from degree 1 on."""

    count: Annotated[int, Field(gt=0, le=MAX_PALETTE)]
    bands: Literal[1, 2, 3]
    codebook: Codebook
    files: Two


class SogMeta(ForeignRecord):
    """``meta.json``."""

    version: Literal[2]
    count: Annotated[int, Field(gt=0)]
    means: SogMeans
    scales: SogTable
    quats: SogRotations
    sh0: SogTable
    shN: SogHarmonics | None = None
    asset: Any = None
    antialias: Any = None
    model: Any = None


# -- writing ---------------------------------------------------------------------------------------


def to_bytes(cloud: SplatCloud, antialias: bool = False) -> bytes:
    """A cloud as a SOG file, rows in Morton order; ``antialias``: it was fitted with an antialiased rasteriser."""
    cloud = cloud.take(binary.morton_order(cloud.means))
    means = np.sign(cloud.means) * np.log1p(np.abs(cloud.means.astype(np.float64)))
    low, high = means.min(0), means.max(0)
    place = np.round((means - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    largest, three = binary.smallest_three(cloud.quats)
    turn = np.column_stack([np.round((three * np.sqrt(2) + 1) / 2 * 255).clip(0, 255), 252 + largest])
    sizes, size_index = codebook(cloud.log_scales)
    colors, color_index = codebook(cloud.sh[:, 0])
    opacity = np.round(cloud.opacity * 255.0)
    solid = np.full(len(cloud), 255)
    parts = {"means_l": (place & 255, solid), "means_u": (place >> 8, solid), "quats": (turn,)}
    parts |= {"scales": (size_index, solid), "sh0": (color_index, opacity)}
    pictures = {f"{name}.webp": _webp(_laid_out(np.column_stack(columns))) for name, columns in parts.items()}
    meta: dict[str, Any] = {
        "version": 2,
        "count": len(cloud),
        "asset": {"generator": "mudg"},
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": sizes.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colors.tolist(), "files": ["sh0.webp"]},
    }
    if antialias:
        meta |= {"antialias": True, "model": "antialiased"}  # for programs before and since splat-transform 3.2
    if cloud.degree:
        palette, labels = _palette(cloud.sh[:, 1:].reshape(len(cloud), -1))
        table, index = codebook(palette.reshape(len(palette), -1, 3))
        pictures["shN_centroids.webp"] = _webp(_centroid_picture(index))
        columns = np.column_stack([labels & 255, labels >> 8, np.zeros_like(labels), solid])
        pictures["shN_labels.webp"] = _webp(_laid_out(columns))
        meta["shN"] = {
            "count": len(palette),
            "bands": cloud.degree,
            "codebook": table.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    return binary.stored_zip({"meta.json": json.dumps(meta, allow_nan=False).encode(), **pictures})


def codebook(values: NDArray[np.floating]) -> tuple[Array, NDArray[np.intp]]:
    """256 values, rising, and for each of ``values`` the index of the nearest: k-means of numbers, begun at
    quantiles."""
    flat = np.asarray(values, np.float64).reshape(-1)
    ordered = np.sort(flat)
    distinct = np.unique(ordered)
    if len(distinct) <= CODES:
        codes = np.concatenate([distinct, np.full(CODES - len(distinct), distinct[-1])])
        return codes, np.searchsorted(distinct, flat).reshape(values.shape)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    spread = lambda values: values[np.linspace(0, len(values) - 1, CODES).round().astype(int)]
    codes = spread(distinct) / 2 + spread(ordered) / 2  # between even steps and even shares
    for _ in range(4 * ROUNDS):
        edges = np.concatenate([[0], np.searchsorted(ordered, (codes[1:] + codes[:-1]) / 2), [len(ordered)]])
        count = np.diff(edges)
        codes = np.where(count > 0, np.diff(sums[edges]) / np.maximum(count, 1), codes)
    return codes, np.searchsorted((codes[1:] + codes[:-1]) / 2, flat).reshape(values.shape)


def _palette(rows: NDArray[np.float32]) -> tuple[Array, NDArray[np.int64]]:
    """Up to 65536 representative rows, and for each row the index of its own: k-means, begun at rows spread over the
    file."""
    count = len(rows) if len(rows) <= 1024 else min(64, 1 << (len(rows) // 1024).bit_length() - 1) * 1024
    palette = rows[np.linspace(0, len(rows) - 1, count).round().astype(int)].astype(np.float64)
    labels = np.arange(len(rows))
    if count < len(rows):
        for _ in range(ROUNDS):
            labels = cKDTree(palette).query(rows, workers=1)[1]
            sums = np.zeros_like(palette)
            np.add.at(sums, labels, rows)
            members = np.bincount(labels, minlength=count)[:, None]
            palette = np.where(members > 0, sums / np.maximum(members, 1), palette)
        labels = cKDTree(palette).query(rows, workers=1)[1]
    return palette, labels.astype(np.int64)


def _laid_out(rgba: NDArray[Any]) -> Picture:
    """Rows [n, 4] of whole numbers as a picture nearly as wide as high, in steps of 4 pixels; the rest is 0."""
    width = 4 * math.ceil(math.sqrt(len(rgba)) / 4)
    height = 4 * math.ceil(len(rgba) / width / 4)
    picture = np.zeros((height * width, 4), np.uint8)
    picture[: len(rgba)] = rgba
    return picture.reshape(height, width, 4)


def _centroid_picture(index: NDArray[np.intp]) -> Picture:
    """Indices [count, coefficients, 3] as a picture: 64 centroids beside each other, one pixel per coefficient."""
    count, coefficients = index.shape[:2]
    picture = np.zeros((-(-count // _WIDTH) * _WIDTH, coefficients, 4), np.uint8)
    picture[..., 3] = 255
    picture[:count, :, :3] = index
    return picture.reshape(-1, _WIDTH * coefficients, 4)


def _webp(picture: Picture) -> bytes:
    target = io.BytesIO()
    Image.fromarray(picture, "RGBA").save(target, "WEBP", lossless=True, exact=True, quality=50, method=2)
    return target.getvalue()


# -- reading ---------------------------------------------------------------------------------------


def from_bytes(content: bytes, where: str) -> SplatFile:
    """The Gaussians of a SOG file; fields that it does not know are passed over. Raises InputError: no SOG file of
    version 2, or a damaged one."""
    archive = binary.opened_zip(content, where)
    names = [name for name in archive.namelist() if name.rpartition("/")[2] == "meta.json"]
    if not names:
        got = listed(archive.namelist()) or "an empty zip"
        raise InputError("the zip is no SOG file", where=where, expected="meta.json", got=got)
    folder = names[0].removesuffix("meta.json")
    stated = store.parse_json(binary.zip_member(archive, names[0], _MOST_META, where), f"{where}: {names[0]}")
    if isinstance(stated, dict) and stated.get("version") != 2:
        got, remedy = str(stated.get("version", "1 (none stated)"))[:20], "convert it, for example with splat-transform"
        raise InputError("this version of SOG is not read", where=where, expected="2", got=got, remedy=remedy)
    meta = parse_record(SogMeta, stated, f"{where}: {names[0]}: ")
    binary.refuse_count(meta.count, where)
    binary.refuse_bomb(meta.count, content, where)
    pixels = _Pictures(archive, folder, meta.count, where)
    low, high = np.array(meta.means.mins), np.array(meta.means.maxs)
    bits = pixels.rows(meta.means.files[0])[:, :3] + 256.0 * pixels.rows(meta.means.files[1])[:, :3]
    place = low + bits / 65535 * (high - low)
    with np.errstate(over="ignore"):
        means = np.sign(place) * np.expm1(np.abs(place))
    turn = pixels.rows(meta.quats.files[0])
    largest = turn[:, 3].astype(np.int64) - 252
    at = f"{where}: {meta.quats.files[0]}"
    refuse_rows(largest < 0, "a rotation names no component", at, turn, "alpha from 252 to 255")
    quats = binary.from_smallest_three(largest, (turn[:, :3] / 255.0 * 2 - 1) / np.sqrt(2))
    scales = np.array(meta.scales.codebook)[pixels.rows(meta.scales.files[0])[:, :3]]
    first = pixels.rows(meta.sh0.files[0])
    sh = np.array(meta.sh0.codebook)[first[:, :3]][:, None]
    if meta.shN is not None:
        sh = np.concatenate([sh, _harmonics(meta.shN, pixels, where)], 1)
    quats, logs, logits, sh = (values.astype(np.float32) for values in (quats, scales, logit(first[:, 3] / 255.0), sh))
    antialias = meta.model == "antialiased" if meta.model is not None else bool(meta.antialias)
    cloud = checked(SplatCloud(means, quats, logs, logits, sh, antialias=antialias), where)
    notes = [sentence(unknown, "meta.json")] if (unknown := meta.unknown()) else []
    warnings = [] if meta.model in _MODELS else [f"its model {str(meta.model)[:40]!r} is not known: drawn as usual"]
    if pixels.lossy:
        warnings.append("its pictures are compressed with loss, so that values are wrong: write them without")
    return SplatFile(cloud, notes=notes, warnings=warnings)


def _harmonics(stated: SogHarmonics, pixels: _Pictures, where: str) -> Array:
    """Harmonics from degree 1 on, f64[count, K - 1, 3]."""
    coefficients = (stated.bands + 1) ** 2 - 1
    across, down = _WIDTH * coefficients, -(-stated.count // _WIDTH)
    fits = lambda width, height: width == across and down <= height <= down + _WIDTH
    picture = pixels.picture(stated.files[0], fits, f"{across}x{down}")
    palette = picture.reshape(-1, coefficients, 4)[: stated.count, :, :3]
    labels = pixels.rows(stated.files[1])[:, :2] @ np.array([1, 256])
    if len(labels) and int(labels.max()) >= stated.count:
        what, where = "a Gaussian names harmonics that the palette does not have", f"{where}: {stated.files[1]}"
        raise InputError(what, where=where, expected=f"below {stated.count}", got=str(int(labels.max())))
    return np.array(stated.codebook)[palette][labels]


class _Pictures:
    """The pictures of one file, checked for size before they are unpacked."""

    def __init__(self, archive: zipfile.ZipFile, folder: str, count: int, where: str) -> None:
        self._archive, self._folder, self._count, self._where = archive, folder, count, where
        self.lossy = False

    def rows(self, name: str) -> Picture:
        """The pixels of the Gaussians, u8[count, 4]."""
        fits = lambda width, height: self._count <= width * height <= 2 * self._count + (1 << 16)
        return self.picture(name, fits, f"about {self._count} pixels").reshape(-1, 4)[: self._count]

    def picture(self, name: str, fits: Callable[[int, int], bool], wanted: str) -> Picture:
        """A picture u8[H, W, 4] whose width and height fit."""
        where, most = f"{self._where}: {name}", 16 * max(self._count, MAX_PALETTE) + (1 << 20)
        content = binary.zip_member(self._archive, self._folder + name, most, self._where)
        try:
            with Image.open(io.BytesIO(content), formats=["WEBP", "PNG"]) as image:
                if not fits(*image.size):
                    what, got = "a picture of the SOG file has an impossible size", f"{image.size[0]}x{image.size[1]}"
                    raise InputError(what, where=where, expected=wanted, got=got)
                self.lossy |= _lossy(content)
                return np.asarray(image.convert("RGBA"))
        except (UnidentifiedImageError, OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise InputError("a picture of the SOG file is damaged", where=where, got=str(error)[:120]) from error


def _lossy(content: bytes) -> bool:
    """Whether a picture is a WebP of the kind that loses values: a chunk ``VP8 `` in place of ``VP8L``."""
    place = 12
    while content[:4] == b"RIFF" and place + 8 <= len(content):
        kind, size = content[place : place + 4], int.from_bytes(content[place + 4 : place + 8], "little")
        if kind in (b"VP8 ", b"VP8L"):
            return kind == b"VP8 "
        place += 8 + size + size % 2
    return False
