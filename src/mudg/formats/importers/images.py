"""Recorded images -> images of a scene, whose cameras are pinhole cameras: lens distortion removed and size changed, in
one place for all formats. Rectified images of the recorded size are kept byte for byte.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg.base import geometry, store
from mudg.base.errors import InputError, UsageError
from mudg.base.types import Camera
from mudg.core.pictures import resize_nearest, shrink_exact
from mudg.formats.importers.common import ImportOptions, Resolution
from mudg.scene.read import decode_image

Floats = NDArray[np.float64]
Lens = Callable[[Floats], Floats]
"""Pinhole coordinates (x / z, y / z) f64[N, 2] -> the same for the distorted ray; pixels follow by fx, fy, cx, cy."""

MAX_FOCAL_GAIN: Final = 1.6
JPEG_QUALITY: Final = 95
_STRIP_ROWS: Final = 64
_BORDER_STEPS: Final = 64


# --- lenses ---------------------------------------------------------------------------------------


def brown_conrady(
    k1: float, k2: float = 0, p1: float = 0, p2: float = 0, k3: float = 0, k4: float = 0, k5: float = 0, k6: float = 0
) -> Lens:
    """Radial and tangential distortion in OpenCV's order: k1 k2 p1 p2 k3, and the rational model's k4 k5 k6.

    Source: D. C. Brown, Close-range camera calibration, 1971; the form of the OpenCV calibration module."""

    def distort(xy: Floats) -> Floats:
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return np.stack(
            [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y],
            1,
        )

    return distort


def equidistant(k1: float = 0, k2: float = 0, k3: float = 0, k4: float = 0) -> Lens:
    """Fisheye: the image radius is a polynomial of the ray's angle. Source: Kannala and Brandt, 2006 (OpenCV's
    fisheye)."""

    def distort(xy: Floats) -> Floats:
        radius = np.linalg.norm(xy, axis=1)
        angle = np.arctan(radius)
        a2 = angle * angle
        bent = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        return xy * np.where(radius > 1e-9, bent / np.maximum(radius, 1e-9), 1.0)[:, None]

    return distort


# --- what is done to the images of one camera -----------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ImageFit:
    """How the recorded images of one camera become images of the scene. Safe to use from several threads.

    ``camera``: the scene's: pinhole, rectified, of the scene's size; ``recorded``: of the size of the files. ``note``:
    what is done, for ``Source.notes``; empty if images are kept as they are. ``table``: where each pixel of the
    rectified image (recorded size) comes from; None if images are rectified already."""

    camera: Camera
    recorded: Camera
    note: str
    table: _Table | None

    def image(self, image: NDArray[np.uint8] | Path | bytes, where: str = "") -> NDArray[np.uint8] | Path | bytes:
        """One recorded image, u8[H, W, 3], or path or bytes of a PNG or JPEG, as ``SceneWriter.add_frame`` wants it:
        itself if it is kept; else an array for an array, and a file of the same kind (JPEG of quality 95 for a JPEG,
        PNG for a PNG, grey for grey) for a file. Raises InputError: damaged, or not of the recorded size."""
        if not self.note:
            return image
        if isinstance(image, np.ndarray):
            return self.pixels(image)
        content = store.read_bytes(image) if isinstance(image, Path) else image
        rgb = decode_image(content, where or str(image)[:200], self.recorded)
        fitted = Image.fromarray(self.pixels(rgb))
        with Image.open(io.BytesIO(content)) as recorded:
            if recorded.mode == "L":
                fitted = fitted.getchannel(0)
        buffer = io.BytesIO()
        if content[:4] == b"\x89PNG":
            fitted.save(buffer, "PNG", compress_level=1)
        else:
            fitted.save(buffer, "JPEG", quality=JPEG_QUALITY, subsampling=0)
        return buffer.getvalue()

    def pixels(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """u8[H, W, 3] of the recorded size -> u8[h, w, 3] of the scene's: rectified (bilinear), then shrunk (area)."""
        if self.table is not None:
            rgb = self.table.bilinear(rgb)
        size = (self.camera.height, self.camera.width)
        return rgb if rgb.shape[:2] == size else shrink_exact(rgb, *size)

    def ids(self, ids: NDArray[Any]) -> NDArray[Any]:
        """Labels [H, W] of the recorded size -> [h, w] of the scene's: each pixel takes the nearest recorded one, none
        are mixed."""
        height, width = self.recorded.height, self.recorded.width
        if ids.shape != (height, width):
            what, where = "label does not have its camera's size", f"camera {self.camera.name}"
            raise InputError(what, where=where, expected=f"[{height}, {width}]", got=str(list(ids.shape)))
        if self.table is not None:
            ids = self.table.nearest(ids)
        return resize_nearest(ids, self.camera.height, self.camera.width)


def fit_images(camera: Camera, options: ImportOptions, lens: Lens | None = None) -> ImageFit:
    """Plan what happens to the images of a camera as recorded: size and intrinsics of the files; with a ``lens``, its
    coefficients in ``distortion``; None = images are rectified. A lens' pinhole camera keeps the optical centre, and
    has its focal length, longer just as far as needed for every pixel to show something. Raises InputError: the lens
    cannot be rectified like this. UsageError: ``options.resolution`` is larger than the images."""
    changes = []
    table = None
    out = camera
    if lens is not None:
        out = covering_camera(camera, lens)
        table = _Table.of(out, camera, lens)
        changes.append(f"rectified, focal length times {out.fx / camera.fx:.3f}")
    size = resized(out.width, out.height, options.resolution, f"camera {camera.name}")
    if size != (out.width, out.height):
        changes.append(f"resized from {out.width}x{out.height} to {size[0]}x{size[1]}")
        out = out.resized(*size)
    note = f"camera {camera.name}: images {'; '.join(changes)}" if changes else ""
    return ImageFit(out, camera, note, table)


def image_notes(fits: Mapping[str, ImageFit]) -> list[str]:
    """What is done to the images of the cameras, for ``Source.notes``; nothing where they are kept as they are."""
    return [fit.note for fit in fits.values() if fit.note]


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, which is decoded to prove that it is one."""
    height, width = decode_image(store.read_bytes(path), str(path)).shape[:2]
    return width, height


def resized(width: int, height: int, resolution: Resolution | None, where: str = "") -> tuple[int, int]:
    """The size asked for. A longest side above the recorded one keeps the image; a larger WxH is refused."""
    if resolution is None:
        return width, height
    if isinstance(resolution, int):
        scale = min(1.0, resolution / max(width, height))
        return max(1, round(width * scale)), max(1, round(height * scale))
    if resolution[0] > width or resolution[1] > height:
        what, expected = "images are never enlarged", f"at most {width}x{height}"
        raise UsageError(what, where=where or "--resolution", expected=expected, got=f"{resolution[0]}x{resolution[1]}")
    return resolution


# --- rectifying -----------------------------------------------------------------------------------


def covering_camera(camera: Camera, lens: Lens) -> Camera:
    """The pinhole camera of the recorded size with the shortest focal length, not below the lens', that sees no border.
    Raises InputError: that is more than ``MAX_FOCAL_GAIN`` times the lens', or the polynomial turns back inside it."""
    low, high = 1.0, MAX_FOCAL_GAIN

    def at(gain: float) -> Camera:
        return replace(camera, fx=camera.fx * gain, fy=camera.fy * gain)

    if _border_problem(at(1.0), camera, lens) is None:
        return camera
    problem = _border_problem(at(high), camera, lens)
    if problem is not None:
        what = "lens cannot be rectified to a pinhole camera of its own size"
        expected = f"rays that cover the image with at most {MAX_FOCAL_GAIN:g} times the focal length"
        remedy = "check the order of the coefficients; for a very wide lens choose a narrower pinhole camera"
        raise InputError(what, where=f"camera {camera.name}", got=problem, expected=expected, remedy=remedy)
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (middle, high) if _border_problem(at(middle), camera, lens) else (low, middle)
    return at(high)


def _border_problem(target: Camera, camera: Camera, lens: Lens) -> str | None:
    """Why ``target`` cannot be filled from ``camera``, or None: a border pixel outside, or a ray whose radius turns
    back."""
    u, v = (np.linspace(0.5, side - 0.5, _BORDER_STEPS) for side in (target.width, target.height))
    lines = [*((u, np.full_like(u, y)) for y in v[[0, -1]]), *((np.full_like(v, x), v) for x in u[[0, -1]])]
    border = np.concatenate([np.stack(line, 1) for line in lines])
    xy = (border - [target.cx, target.cy]) / [target.fx, target.fy]
    steps = np.linspace(0, 1, _BORDER_STEPS)[1:]
    along = lens((xy[:, None] * steps[:, None]).reshape(-1, 2)).reshape(len(xy), len(steps), 2)
    if not np.isfinite(along).all():
        return "the distortion is not finite inside the image"
    radius = np.linalg.norm(along, axis=2)
    if (np.diff(radius, axis=1) <= 0).any():
        return "the distortion polynomial turns back inside the image"
    place = along[:, -1] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    outside = np.maximum(0.5 - place, place - [camera.width - 0.5, camera.height - 0.5]).max()
    return f"rays at the border fall {outside:.0f} px outside the image" if outside > 1e-3 else None


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """Source of each target pixel: ``corner`` i32[h, w] index of the upper left of four pixels, ``right`` and ``down``
    u8[h, w] its weights in 1/256 px. 6 bytes a pixel, so that five cameras of 2 Mpx fit into 70 MB."""

    corner: NDArray[np.int32]
    right: NDArray[np.uint8]
    down: NDArray[np.uint8]
    size: tuple[int, int]

    @classmethod
    def of(cls, target: Camera, camera: Camera, lens: Lens) -> _Table:
        size = (target.height, target.width)
        corner, right, down = np.empty(size, np.int32), np.empty(size, np.uint8), np.empty(size, np.uint8)
        u, rays_v = geometry.pixel_rays(target)
        for top in range(0, target.height, _STRIP_ROWS):
            rows = slice(top, min(top + _STRIP_ROWS, target.height))
            xy = np.stack(np.broadcast_arrays(u[None], rays_v[rows, None]), -1).reshape(-1, 2)
            place = lens(xy) * [camera.fx, camera.fy] + [camera.cx, camera.cy] - 0.5
            outside = (place < -0.51) | (place > np.array([camera.width, camera.height]) - 0.49)
            if not np.isfinite(place).all() or outside.any():
                what, remedy = "rectified camera looks beyond the recorded image", "choose a narrower pinhole camera"
                raise InputError(what, where=f"camera {camera.name}", got=f"row {rows.start} on", remedy=remedy)
            place = place.clip(0, np.array([camera.width, camera.height]) - 1.0)
            whole = np.minimum(place.astype(np.int64), [max(camera.width - 2, 0), max(camera.height - 2, 0)])
            part = np.minimum(np.round((place - whole) * 256), 255).astype(np.uint8)
            shape = (rows.stop - rows.start, target.width)
            corner[rows] = (whole[:, 1] * camera.width + whole[:, 0]).reshape(shape)
            right[rows], down[rows] = part[:, 0].reshape(shape), part[:, 1].reshape(shape)
        return cls(corner, right, down, (camera.height, camera.width))

    def bilinear(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Each target pixel as the blend of its four source pixels."""
        flat = np.ascontiguousarray(rgb).reshape(-1, 3)
        width = self.size[1]
        out = np.empty((*self.corner.shape, 3), np.uint8)
        for top in range(0, len(self.corner), _STRIP_ROWS):
            rows = slice(top, top + _STRIP_ROWS)
            corner = self.corner[rows]
            right, down = self.right[rows, :, None].astype(np.int32), self.down[rows, :, None].astype(np.int32)
            upper = flat.take(corner, 0) * (256 - right) + flat.take(corner + 1, 0) * right
            lower = flat.take(corner + width, 0) * (256 - right) + flat.take(corner + width + 1, 0) * right
            out[rows] = (upper * (256 - down) + lower * down + (1 << 15)) >> 16
        return out

    def nearest(self, ids: NDArray[Any]) -> NDArray[Any]:
        """Each target pixel as its nearest source pixel."""
        place = self.corner + (self.right >= 128) + (self.down >= 128).astype(np.int32) * self.size[1]
        return np.ascontiguousarray(ids).reshape(-1).take(place)
