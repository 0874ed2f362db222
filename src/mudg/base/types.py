"""The types of the package: frozen dataclasses, checked when they are made.

A constructor is the one place where a pose is proved rigid; what is refused names its owner and field, as in ``view of
'front': world_from_cam``. Facts about the world are numpy and live on disk; what is computed on is torch. This module
imports no torch, so that facts can be read without it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.errors import InputError, UsageError, short

if TYPE_CHECKING:
    import torch
    from torch import Tensor

Matrix = NDArray[np.float64]
Triple = tuple[float, float, float]
TrajectoryOrigin = Literal["recorded", "shifted"]
ObservationKind = Literal["recorded", "virtual"]
Shutter = Literal["global", "top_to_bottom", "left_to_right", "bottom_to_top", "right_to_left"]

# checks of the constructors; a refusal is an InputError whose place is ``OWNER: FIELD`` -------------------------------


def rigid(value: Any, where: str) -> Matrix:
    """A read-only copy f64[4, 4] of a rigid motion."""
    matrix = np.array(value, np.float64)
    problem = geometry.rigid_problem(matrix)
    if problem:
        expected = "f64[4, 4]: a right-handed rotation (orthonormal within 1e-4) and a translation in metres"
        remedy = "remove scale or mirroring from the matrix; check row against column order"
        raise InputError("pose is not a rigid motion", where=where, got=problem, expected=expected, remedy=remedy)
    matrix.setflags(write=False)
    return matrix


MAX_NAME_BYTES: Final = 200


def foreign_name(value: str, where: str) -> str:
    """An id, name or class from a file of others, at most 200 bytes long."""
    size = len(value) if len(value) > MAX_NAME_BYTES else len(value.encode("utf-8", "surrogatepass"))
    if size > MAX_NAME_BYTES:
        what = "name is too long"
        got, remedy = f"{size} bytes, beginning {value[:40]!r}", "is the file damaged, or of another format?"
        raise InputError(what, where=where, expected=f"at most {MAX_NAME_BYTES} bytes", got=got, remedy=remedy)
    return value


def finite(value: float, where: str) -> float:
    """A finite number as a float."""
    number = float(value)
    if not np.isfinite(number):
        raise InputError("a number is not finite", where=where, got=str(value))
    return number


def increasing_problem(times_s: NDArray[np.float64]) -> str | None:
    """Say where times f64[T] in seconds stop increasing, or return None."""
    stops = np.flatnonzero(~(np.diff(times_s) > 0))
    if len(stops) == 0:
        return None
    index = int(stops[0])
    return f"entry {index + 1} ({times_s[index + 1]:.6f} s) does not come after entry {index} ({times_s[index]:.6f} s)"


def pose_keys(times_s: Any, poses: Any, owner: str, name: str) -> tuple[NDArray[np.float64], Matrix]:
    """Check and freeze keys: increasing finite times f64[T], rigid poses f64[T, 4, 4] of the field ``name``."""
    times = np.array(times_s, np.float64).reshape(-1)
    matrices = np.array(poses, np.float64)
    if matrices.shape != (len(times), 4, 4):
        expected, got = f"({len(times)}, 4, 4) for {len(times)} times", str(matrices.shape)
        raise InputError("times and poses do not pair up", where=f"{owner}: {name}", expected=expected, got=got)
    problem = increasing_problem(times) if np.isfinite(times).all() else short(times)
    if problem is not None:
        what, where, remedy = "times do not increase", f"{owner}: times_s", "sort the poses by time and drop duplicates"
        raise InputError(what, where=where, expected="finite seconds, strictly increasing", got=problem, remedy=remedy)
    if not geometry.all_rigid(matrices):
        for index, matrix in enumerate(matrices):
            rigid(matrix, f"{owner}: {name}[{index}]")
    times.setflags(write=False)
    matrices.setflags(write=False)
    return times, matrices


def check_shape(value: Any, where: str, shape: tuple[int | None, ...], dtype: type[np.generic] | None = None) -> None:
    """Refuse what is no array or tensor of this shape, and, of an array, of this type; None stands for any size."""
    got = tuple(getattr(value, "shape", ()))
    fits = len(got) == len(shape) and all(wanted in (None, size) for size, wanted in zip(got, shape))
    if not fits or (dtype is not None and not np.issubdtype(value.dtype, dtype)):
        expected = f"{'' if dtype is None else np.dtype(dtype).name} {tuple(shape)}".replace("None", "N").strip()
        found = f"{getattr(value, 'dtype', type(value).__name__)} {got}"
        raise InputError("an array has the wrong shape or type", where=where, expected=expected, got=found)


def check_tensors(record: Any, **shapes: tuple[int | None, ...]) -> None:
    """Compare the shapes of tensor fields with the expected ones; None stands for any size."""
    for name, shape in shapes.items():
        check_shape(getattr(record, name), f"{type(record).__name__.lower()}.{name}", shape)


def check_given_tensors(record: Any, **shapes: tuple[int | None, ...]) -> None:
    """As ``check_tensors``, for fields that may be None."""
    check_tensors(record, **{name: shape for name, shape in shapes.items() if getattr(record, name) is not None})


def _complete(record: Any, **values: Any) -> None:
    """Set fields of a frozen record while it is made."""
    for name, value in values.items():
        object.__setattr__(record, name, value)


class _Brief:
    """``repr`` in one line: arrays and tensors by type and shape, containers by their number, without what is None."""

    __slots__ = ()

    def __repr__(self) -> str:
        texts = [f"{name}={_in_brief(value)}" for name, value in _given(self).items()]
        return f"{type(self).__name__}({', '.join(texts)})"


def _given(record: Any) -> dict[str, Any]:
    """Fields of a record by name, without those that are None."""
    values = ((field.name, getattr(record, field.name)) for field in fields(record))
    return {name: value for name, value in values if value is not None}


class _Tensors(_Brief):
    """What holds tensors, also in fields that are of this kind."""

    __slots__ = ()

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The same with ``change`` applied to each tensor, for example a crop or a mirror image."""
        given = _given(self)
        inner = {name: value.map(change) for name, value in given.items() if isinstance(value, _Tensors)}
        tensors = {name: change(value) for name, value in given.items() if hasattr(value, "device")}
        return replace(self, **inner, **tensors)  # type: ignore[type-var]

    def to(self, device: torch.device) -> Self:
        """The same with its tensors on a device."""
        return self.map(lambda x: x.to(device))


def _in_brief(value: Any) -> str:
    if hasattr(value, "shape"):
        return f"{str(value.dtype).removeprefix('torch.')}{list(value.shape)}"
    if isinstance(value, Mapping | tuple):
        return f"<{len(value)}>"
    return repr(value.name) if isinstance(value, Camera) else short(repr(value))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class RenderPlanes(_Tensors):
    """What a fitted scene shows at T views (or at one view, without the leading dimension).

    Args:
        color: f32[T, 3, H, W] in [0, 1], sky included.
        depth: f32[T, 1, H, W] metres; meaningless where ``alpha`` is small.
        alpha: f32[T, 1, H, W] in [0, 1]: coverage by Gaussians.
        certainty: f32[T, 1, H, W] in [0, 1]: how far the photographs determined what is shown; never above ``alpha``.
        semantics: u8[T, 1, H, W] class ids; 255 = unknown.
    """

    color: Tensor
    depth: Tensor
    alpha: Tensor
    certainty: Tensor
    semantics: Tensor

    def __post_init__(self) -> None:
        lead, (h, w) = tuple(self.color.shape[:-3]), tuple(self.color.shape[-2:])
        one = (*lead, 1, h, w)
        check_tensors(self, color=(*lead, 3, h, w), depth=one, alpha=one, certainty=one, semantics=one)


def _freeze(mapping: Mapping[str, Any]) -> Mapping[str, Any]:
    return MappingProxyType(dict(mapping))


# colours of cameras: each has an exposure and a white balance of its own, the world has not ---------------------------
# Fused points and fitted scenes have *common* colours, those of one camera of the log; images on disk, recorded and
# generated, have those of their camera. The maps between them are found by `core/calibration.py`, and travel with the
# fused cloud.


@dataclass(frozen=True, slots=True)
class ColorMap:
    """wanted = gain * given + offset for each channel of colours in [0, 1]; ``pairs``: of colours it was fitted to."""

    gain: Triple = (1.0, 1.0, 1.0)
    offset: Triple = (0.0, 0.0, 0.0)
    pairs: int = 0

    def inverse(self) -> ColorMap:
        """The map back."""
        back = tuple(1 / g for g in self.gain), tuple(-o / g for g, o in zip(self.gain, self.offset))
        return ColorMap(*back, self.pairs)  # type: ignore[arg-type]

    def then(self, other: ColorMap) -> ColorMap:
        """This map, and after it another one."""
        gain = tuple(a * b for a, b in zip(other.gain, self.gain))
        offset = tuple(a * o + p for a, o, p in zip(other.gain, self.offset, other.offset))
        return ColorMap(gain, offset, min(self.pairs, other.pairs))  # type: ignore[arg-type]

    def of_image(self, rgb: Tensor) -> Tensor:
        """An image [3, H, W] mapped, differentiable, not clamped."""
        gain, offset = (_per_channel(values, rgb.dtype, rgb.device) for values in (self.gain, self.offset))
        return rgb * gain + offset

    def of_bytes(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Colours u8[..., 3] mapped, rounded and clamped."""
        levels = np.arange(256) / 255.0
        values = [np.rint((g * levels + o) * 255) for g, o in zip(self.gain, self.offset)]
        tables = np.clip(values, 0, 255).astype(np.uint8)
        return np.stack([table[rgb[..., channel]] for channel, table in enumerate(tables)], -1)


@dataclass(frozen=True, slots=True)
class CameraColors:
    """Which camera's colours are the common ones ("" = all cameras have the same), and for the others the maps to them.
    A camera that is not named has common colours."""

    reference: str = ""
    to_common: Mapping[str, ColorMap] = field(default_factory=dict)

    def image_to_common(self, camera: str, rgb: Tensor) -> Tensor:
        """An image [3, H, W] of a camera in common colours, not clamped."""
        found = self.to_common.get(camera)
        return rgb if found is None else found.of_image(rgb)

    def image_of(self, camera: str, rgb: Tensor) -> Tensor:
        """An image [3, H, W] in common colours as a camera shows it, not clamped."""
        found = self.to_common.get(camera)
        return rgb if found is None else found.inverse().of_image(rgb)

    def bytes_to_common(self, camera: str, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Colours u8[..., 3] of a camera as common ones."""
        found = self.to_common.get(camera)
        return rgb if found is None else found.of_bytes(rgb)

    def record(self) -> dict[str, Any]:
        """As JSON values; inverse of ``of_record``."""
        values = lambda m: {"gain": list(m.gain), "offset": list(m.offset), "pairs": m.pairs}
        return {"reference": self.reference, "to_common": {name: values(m) for name, m in self.to_common.items()}}

    @classmethod
    def of_record(cls, values: Mapping[str, Any]) -> CameraColors:
        """From JSON values. KeyError, TypeError or ValueError if they are malformed."""
        map_of = lambda m: ColorMap(_triple(m["gain"]), _triple(m["offset"]), int(m["pairs"]))
        maps = {str(name): map_of(m) for name, m in values["to_common"].items()}
        if any(min(m.gain) <= 0 for m in maps.values()):
            raise ValueError("a gain is not positive")
        return cls(str(values["reference"]), maps)


SAME_COLORS = CameraColors()
"""All cameras have the same colours."""


@functools.lru_cache(maxsize=256)
def _per_channel(values: Triple, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Three numbers as [3, 1, 1], sent to a device once."""
    import torch

    return torch.tensor(values, dtype=dtype).to(device).view(3, 1, 1)


def _triple(values: Any) -> Triple:
    red, green, blue = (float(value) for value in values)
    return red, green, blue


# facts --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera.

    Args:
        name: sensor name, unique in a scene.
        width, height: image size in pixels.
        fx, fy, cx, cy: intrinsics in pixels; the centre of the top-left pixel is (0.5, 0.5).
        distortion: coefficients of the original lens, kept for the record; images in a scene are rectified.
        readout_s: duration of the rolling shutter, 0 for a global shutter.
        shutter: the direction in which a rolling shutter reads the image; "global" also where it is not known.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    readout_s: float = 0.0
    shutter: Shutter = "global"

    def __post_init__(self) -> None:
        owner = f"camera {self.name!r}"
        if self.width < 1 or self.height < 1:
            raise InputError("image size must be positive", where=owner, got=f"{self.width}x{self.height}")
        for name in ("fx", "fy", "cx", "cy", "readout_s"):
            finite(getattr(self, name), f"{owner}.{name}")
        if self.fx <= 0 or self.fy <= 0:
            raise InputError("focal lengths must be positive", where=owner, got=f"fx={self.fx}, fy={self.fy}")
        if self.readout_s < 0:
            raise InputError("readout time cannot be negative", where=owner, got=f"{self.readout_s} s")
        off_x, off_y = self.width + self.fx, self.height + self.fy  # parts of an image leave it by less
        if not (-off_x <= self.cx <= self.width + off_x and -off_y <= self.cy <= self.height + off_y):
            raise InputError("principal point is far outside the image", where=owner, got=f"cx={self.cx}, cy={self.cy}")

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy, as ``geometry.pinhole`` takes them."""
        return self.fx, self.fy, self.cx, self.cy

    @property
    def matrix(self) -> Matrix:
        """Intrinsics f64[3, 3]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @classmethod
    def from_fov(cls, name: str, width: int, height: int, horizontal_deg: float) -> Camera:
        """A pinhole camera of this size in pixels with square pixels and this field of view from left to right
        (degrees, above 0 and below 180, else UsageError), which looks through the middle of its image."""
        if not 0 < horizontal_deg < 180:
            raise UsageError("no field of view", expected="0 to 180 degrees", got=str(horizontal_deg))
        focal = width / 2 / math.tan(math.radians(horizontal_deg) / 2)
        return cls(name, width, height, focal, focal, width / 2, height / 2)

    def resized(self, width: int, height: int) -> Camera:
        """The same optics sampled on another pixel grid (anisotropic if the aspect ratio differs)."""
        sx, sy = width / self.width, height / self.height
        intrinsics = {"fx": self.fx * sx, "fy": self.fy * sy, "cx": self.cx * sx, "cy": self.cy * sy}
        return replace(self, width=width, height=height, **intrinsics)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class View(_Brief):
    """A camera at a place and time: ``world_from_cam`` f64[4, 4], rigid, metres, copied and read-only; ``time_s`` in
    seconds on the scene's clock."""

    camera: Camera
    world_from_cam: Matrix
    time_s: float

    def __post_init__(self) -> None:
        owner = f"view of {self.camera.name!r}"
        pose = rigid(self.world_from_cam, f"{owner}: world_from_cam")
        _complete(self, world_from_cam=pose, time_s=finite(self.time_s, f"{owner}: time_s"))

    @property
    def cam_from_world(self) -> Matrix:
        """f64[4, 4]."""
        return geometry.invert(self.world_from_cam)

    @property
    def center_world(self) -> Matrix:
        """Optical centre f64[3], metres."""
        return self.world_from_cam[:3, 3]

    def resized(self, width: int, height: int) -> View:
        """The same view on another pixel grid."""
        return View(self.camera.resized(width, height), self.world_from_cam, self.time_s)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Trajectory(_Brief):
    """An ordered path of views of one camera, recorded or shifted from a recorded one. name: e.g. ``left_2m``."""

    name: str
    views: tuple[View, ...]
    origin: TrajectoryOrigin

    def __len__(self) -> int:
        return len(self.views)


@dataclass(frozen=True, slots=True)
class Ref:
    """A file inside a scene: a relative POSIX path. Whether it stays inside is checked by the scene reader."""

    path: str


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Frame(_Brief):
    """One recorded image, 8-bit RGB of the camera's size. id: ``<camera>/<digits>``, unique in the scene. labels: name
    (depth, semantics, sky, ego, dynamic, instance, ...) -> file."""

    id: str
    view: View
    image: Ref
    labels: Mapping[str, Ref] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _complete(self, labels=_freeze(self.labels))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Photo(_Brief):
    """A recorded image in memory: ``rgb`` u8[H, W, 3] of ``view``, ``semantics`` u8[H, W] train ids (255 = unknown) or
    None, ``usable`` bool[H, W]: pixels that show what is asked for (None = all). The image may have another size than
    the view's camera."""

    view: View
    rgb: NDArray[np.uint8]
    semantics: NDArray[np.uint8] | None = None
    usable: NDArray[np.bool_] | None = None


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Sweep(_Brief):
    """One turn of a LiDAR. id: ``<sensor>/<digits>``, unique in the scene. time_s: on the scene's clock; the points
    (``SweepPoints``) are motion-compensated to it. world_from_lidar: rigid f64[4, 4], metres; copied and read-only."""

    id: str
    sensor: str
    time_s: float
    world_from_lidar: Matrix
    points: Ref

    def __post_init__(self) -> None:
        pose = rigid(self.world_from_lidar, f"sweep {self.id!r}: world_from_lidar")
        _complete(self, world_from_lidar=pose, time_s=finite(self.time_s, f"sweep {self.id!r}: time_s"))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SweepPoints(_Brief):
    """Points of a sweep: ``xyz`` f32[N, 3] metres in the LiDAR frame, ``intensity`` f32[N] in [0, 1], ``dt_s`` f32[N]
    seconds relative to the sweep's time. classes: u8[N] train ids that people gave the points (255 = unlabelled), or
    None. no_returns: rows of the source that mark a beam without a return; they are not among the points."""

    xyz: NDArray[np.float32]
    intensity: NDArray[np.float32]
    dt_s: NDArray[np.float32]
    classes: NDArray[np.uint8] | None = None
    no_returns: int = 0

    def __post_init__(self) -> None:
        check_shape(self.xyz, "sweep points: xyz", (None, 3), np.float32)
        check_shape(self.intensity, "sweep points: intensity", (len(self.xyz),), np.float32)
        check_shape(self.dt_s, "sweep points: dt_s", (len(self.xyz),), np.float32)
        if self.classes is not None:
            check_shape(self.classes, "sweep points: classes", (len(self.xyz),), np.uint8)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Track(_Brief):
    """A tracked box. id: unique in the scene. label: free class name (``car``, ``pedestrian``, ...). size_m: f64[3]
    length (x), width (y), height (z); the object frame sits in the centre of the box. times_s: f64[T], strictly
    increasing. world_from_object: f64[T, 4, 4], rigid, metres."""

    id: str
    label: str
    size_m: NDArray[np.float64]
    times_s: NDArray[np.float64]
    world_from_object: Matrix

    def __post_init__(self) -> None:
        owner = f"track {self.id[:40]!r}"
        for name in ("id", "label"):
            foreign_name(getattr(self, name), f"{owner}: {name}")
        size = np.array(self.size_m, np.float64).reshape(-1)
        if size.shape != (3,) or not np.isfinite(size).all() or (size <= 0).any():
            what = "a box needs a positive length, width and height"
            raise InputError(what, where=f"{owner}: size_m", got=short(size))
        size.setflags(write=False)
        times, poses = pose_keys(self.times_s, self.world_from_object, owner, "world_from_object")
        if len(times) == 0:
            raise InputError("a track needs at least one box", where=f"{owner}: times_s")
        _complete(self, size_m=size, times_s=times, world_from_object=poses)

    def pose_at(self, time_s: float) -> Matrix | None:
        """World-from-object f64[4, 4] at ``time_s``, interpolated between neighbouring keys; None outside the span."""
        return geometry.pose_at(self.times_s, self.world_from_object, time_s)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class EgoPath(_Brief):
    """The path of the vehicle: times f64[T], seconds, strictly increasing; rigid poses f64[T, 4, 4], metres."""

    times_s: NDArray[np.float64]
    world_from_ego: Matrix

    def __post_init__(self) -> None:
        times, poses = pose_keys(self.times_s, self.world_from_ego, "ego path", "world_from_ego")
        _complete(self, times_s=times, world_from_ego=poses)

    def pose_at(self, time_s: float) -> Matrix | None:
        """World-from-ego f64[4, 4] at ``time_s``; None outside the recording."""
        return geometry.pose_at(self.times_s, self.world_from_ego, time_s)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Source(_Brief):
    """Where a scene comes from, and under which licence. recipe: what a generated scene needs to rebuild its exact
    truth; None for recordings. notes: what a reader of results should know (assumed timestamps, derived poses)."""

    dataset: str
    licence: str
    recipe: Mapping[str, Any] | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PointCloud(_Brief):
    """Coloured points: ``xyz`` f32[N, 3] metres in ``frame`` (the world's, or a tracked box's own), ``rgb`` u8[N, 3],
    ``semantics`` u8[N] train ids (255 = unlabelled) or None."""

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    frame: Literal["world", "object"]
    semantics: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        check_shape(self.xyz, "point cloud: xyz", (None, 3), np.float32)
        check_shape(self.rgb, "point cloud: rgb", (len(self.xyz), 3), np.uint8)
        if self.semantics is not None:
            check_shape(self.semantics, "point cloud: semantics", (len(self.xyz),), np.uint8)

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FusedCloud(_Brief):
    """The static world, and one cloud per dynamic object: track id -> cloud in its box frame. The points' colours are
    common ones; ``colors`` says how the cameras of the log show them."""

    static: PointCloud
    objects: Mapping[str, PointCloud]
    colors: CameraColors = SAME_COLORS

    def __post_init__(self) -> None:
        _complete(self, objects=_freeze(self.objects))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Scene(_Brief):
    """A prepared driving log. Files are referenced, relative to the folder ``root``, and not loaded. Frames are in time
    order per camera, sweeps per sensor. split: frame id -> ``train`` or ``test``; frames not named are for training."""

    id: str
    root: str
    cameras: Mapping[str, Camera]
    frames: tuple[Frame, ...]
    sweeps: tuple[Sweep, ...]
    tracks: tuple[Track, ...]
    ego: EgoPath
    split: Mapping[str, Literal["train", "test"]]
    source: Source

    def __post_init__(self) -> None:
        _complete(self, cameras=_freeze(self.cameras), split=_freeze(self.split))

    def __repr__(self) -> str:
        counts = f"{len(self.frames)} frames, {len(self.cameras)} cameras, {len(self.tracks)} objects"
        return f"Scene({short(repr(self.id))}, {counts}, {np.diff(self.ego.times_s).sum():.1f} s)"

    def frames_of(self, camera: str) -> tuple[Frame, ...]:
        """Frames of one camera in time order. An unknown camera raises InputError with the names there are."""
        if camera not in self.cameras:
            names = ", ".join(self.cameras)
            raise InputError("the scene has no such camera", where=self.root, expected=names, got=camera)
        return tuple(f for f in self.frames if f.view.camera.name == camera)

    def frames_in(self, split: Literal["train", "test"]) -> tuple[Frame, ...]:
        """Frames of one split; frames not named in ``split`` are training frames."""
        return tuple(f for f in self.frames if self.split.get(f.id, "train") == split)

    def track(self, track_id: str) -> Track:
        """The track with this id."""
        for track in self.tracks:
            if track.id == track_id:
                return track
        raise InputError("the scene has no such track", where=self.root, got=track_id)


# tensors ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SparseDepth(_Tensors):
    """Measured depth f32[T, 1, H, W] in metres, known where ``valid`` bool[T, 1, H, W] and meaningless elsewhere."""

    depth: Tensor
    valid: Tensor

    def __post_init__(self) -> None:
        check_tensors(self, depth=(None, 1, None, None), valid=tuple(self.depth.shape))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Condition(_Tensors):
    """What the diffusion model is given for T views.

    Args:
        views: T views, all of one size H x W.
        color: f32[T, 3, H, W] in [0, 1]; meaningless where not valid.
        depth: f32[T, 1, H, W] metres; meaningless where not valid.
        valid: bool[T, 1, H, W]: a fused point was seen here.
        reference: f32[3, H, W], the dense recorded image near views[0].
        reference_in: where a published-type model is shown it: in the image tokens and in frame 0 of the colour (as
            released), in that frame alone, or nowhere.
        warped: bool[T, 1, H, W] or None: the colour here was warped from a recorded image near in time.
        backdrop: f32[T, 3, H, W] in [0, 1] or None: a recorded image carried over as if all of it were far away.
        semantics: u8[T, 1, H, W] or None: class ids that came with `color` from labelled points and images; 255 =
            unknown.
        backdrop_semantics: u8[T, 1, H, W] or None: the same for `backdrop`.
        renders: what a fitted scene shows at the views, or None.
        measured: what the points measured, where ``depth`` is something else: the published system's network is given
            depth that was resized with its gaps, as 0 m, mixed in. None: ``depth`` where ``valid``.
    """

    views: tuple[View, ...]
    color: Tensor
    depth: Tensor
    valid: Tensor
    reference: Tensor
    warped: Tensor | None = None
    backdrop: Tensor | None = None
    semantics: Tensor | None = None
    backdrop_semantics: Tensor | None = None
    renders: RenderPlanes | None = None
    measured: SparseDepth | None = None
    reference_in: Literal["tokens_and_frame", "frame", "nowhere"] = "tokens_and_frame"

    def __post_init__(self) -> None:
        t, (h, w) = len(self.views), tuple(self.color.shape[-2:])
        one = (t, 1, h, w)
        check_tensors(self, color=(t, 3, h, w), depth=one, valid=one, reference=(3, h, w))
        check_given_tensors(self, warped=one, backdrop=(t, 3, h, w), semantics=one, backdrop_semantics=one)
        if self.renders is not None:
            check_tensors(self.renders, color=(t, 3, h, w))
        if self.measured is not None:
            check_tensors(self.measured, depth=one)

    def cropped(self, rows: slice, columns: slice) -> Self:
        """A rectangle of pixels of all views. Its cameras only say how large it is: they look straight ahead."""
        width, height = columns.stop - columns.start, rows.stop - rows.start
        lens = {"width": width, "height": height, "cx": width / 2, "cy": height / 2}
        views = tuple(replace(view, camera=replace(view.camera, **lens)) for view in self.views)
        return replace(self.map(lambda x: x[..., rows, columns].contiguous()), views=views)

    @property
    def measurement(self) -> SparseDepth:
        """Depth to hold generated depth against."""
        return SparseDepth(self.depth, self.valid) if self.measured is None else self.measured


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FinePatch(_Tensors):
    """A rectangle of a training clip at a higher resolution. row, column: the upper left pixel, in the clip, of the
    part that it covers; its sides are ``scale`` times those of that part."""

    clip: Clip
    row: int
    column: int
    scale: int


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Clip(_Tensors):
    """A training example: a condition and the truth for its T views.

    Args:
        rgb: f32[T, 3, H, W] in [0, 1].
        depth: f32[T, 1, H, W] metres where ``depth_valid`` bool[T, 1, H, W]; elsewhere it only fills a gap.
        semantics: i64[T, H, W] train ids, 255 = unlabelled.
        shift_m: lateral shift from the recorded path, metres, positive to the left.
        fine: a rectangle at a higher resolution, or None.
        depth_confidence: f32[T, 1, H, W] in [0, 1] or None: how far valid depth is to be believed (1 = measured); None:
            wholly.
    """

    condition: Condition
    rgb: Tensor
    depth: Tensor
    depth_valid: Tensor
    semantics: Tensor
    shift_m: float = 0.0
    fine: FinePatch | None = None
    depth_confidence: Tensor | None = None

    def __post_init__(self) -> None:
        t, _, h, w = self.condition.color.shape
        one = (t, 1, h, w)
        check_tensors(self, rgb=(t, 3, h, w), depth=one, depth_valid=one, semantics=(t, h, w))
        check_given_tensors(self, depth_confidence=one)

    @property
    def depth_weight(self) -> Tensor:
        """What depth counts in a loss, f32[T, 1, H, W]: its confidence, 0 where it is not valid."""
        known = self.depth_valid.float()
        return known if self.depth_confidence is None else known * self.depth_confidence


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Observation(_Brief):
    """What is known, or believed, about one view. Recorded and generated frames are this same type.

    Args:
        view: camera, pose and time; H x W is the camera's size.
        rgb: f32[3, H, W] in [0, 1].
        depth: f32[1, H, W] metres, or None if not produced; not finite or <= 0 = no depth (sky).
        semantics: i64[H, W] train ids (255 = unlabelled), or None if not produced.
        confidence: f32[1, H, W] in [0, 1].
        mask: bool[1, H, W]: pixels that may be used at all.
        kind: recorded by a sensor, or virtual (generated or rendered).
        source: who made it, e.g. ``camera`` or ``mudg_r``.
    """

    view: View
    rgb: Tensor
    depth: Tensor | None
    semantics: Tensor | None
    confidence: Tensor
    mask: Tensor
    kind: ObservationKind
    source: str

    def __post_init__(self) -> None:
        h, w = self.view.camera.height, self.view.camera.width
        check_tensors(self, rgb=(3, h, w), confidence=(1, h, w), mask=(1, h, w))
        check_given_tensors(self, depth=(1, h, w), semantics=(h, w))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Gaussians(_Brief):
    """Gaussians in the world, activated (scales in metres, never their logarithm; opacity in [0, 1]).

    Args:
        means: f32[N, 3] metres.
        quats: f32[N, 4] (w, x, y, z), need not be normalised.
        scales: f32[N, 3] metres.
        opacity: f32[N] in [0, 1].
        sh: f32[N, K, 3] spherical harmonics, K = (degree + 1)^2.
        sh_rest: harmonics from degree 1 on, f32[N, K - 1, 3], where they are kept in a tensor of their own (``sh`` is
            then f32[N, 1, 3]); None: ``sh`` holds all. The CPU rasteriser draws both forms without a copy.
        extra: f32[N, C] feature channels rendered like colours, or None.
        node: i32[N] index of the scene node.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacity: Tensor
    sh: Tensor
    extra: Tensor | None
    node: Tensor
    sh_rest: Tensor | None = None

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        sh = (n, None if self.sh_rest is None else 1, 3)
        check_tensors(self, means=(n, 3), quats=(n, 4), scales=(n, 3), opacity=(n,), sh=sh, node=(n,))
        check_given_tensors(self, sh_rest=(n, None, 3), extra=(n, None))

    def __len__(self) -> int:
        return int(self.means.shape[0])


@dataclass(slots=True, eq=False, repr=False)
class RasterTrace(_Brief):
    """What densification needs to know about a render. means2d: f32[N, 2] pixels; its gradient is kept after backward.
    radii: i32[N, 2] half extent in pixels, 0 = not drawn. visible: bool[N]. abs_grad2d: f32[N, 2], sum over pixels of
    absolute gradients; filled by backward if asked for."""

    means2d: Tensor
    radii: Tensor
    visible: Tensor
    abs_grad2d: Tensor | None = None


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Render(_Brief):
    """A rendered view. rgb: f32[3, H, W]. depth: f32[1, H, W] metres: expected camera z (accumulated / alpha). alpha:
    f32[1, H, W] in [0, 1]. extra: f32[C, H, W] or None: accumulated, not divided by alpha."""

    rgb: Tensor
    depth: Tensor
    alpha: Tensor
    extra: Tensor | None
    trace: RasterTrace
