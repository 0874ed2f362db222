"""Thin ctypes layer over the city's ray caster in the native library."""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mudg import native
from mudg.base.errors import ResourceError
from mudg.base.types import Camera
from mudg.city.layout import StreetPlan

_P, _I, _L, _U = ctypes.c_void_p, ctypes.c_int, ctypes.c_int64, ctypes.c_uint32


@functools.cache
def library() -> ctypes.CDLL:
    """The native library with the city's signatures set. ResourceError when there is none."""
    lib = native.require("rendering the city")
    lib.mudg_city_number_counts.argtypes = [_I]
    lib.mudg_city_number_counts.restype = _I
    lib.mudg_city_create.argtypes = [_P, _L, _P, _L, _P, _L, _P, _L, _P, _P, _I]
    lib.mudg_city_create.restype = _P
    lib.mudg_city_destroy.argtypes = [_P]
    lib.mudg_city_destroy.restype = None
    lib.mudg_city_set_texture.argtypes = [_P, _I, _P, _I, _I, ctypes.c_float]
    lib.mudg_city_set_texture.restype = _I
    lib.mudg_city_set_weather.argtypes = [_P, _P, _P, _L]
    lib.mudg_city_set_weather.restype = _I
    lib.mudg_city_planes.argtypes = [_P, _P, _P, _P, _I, _I, _P, _P]
    lib.mudg_city_planes.restype = _I
    lib.mudg_city_shape_count.argtypes = [_P]
    lib.mudg_city_shape_count.restype = _L
    lib.mudg_city_render.argtypes = [_P, _P, _P, _P, _I, _I, _P, _I, _U, _P, _P, _P, _P]
    lib.mudg_city_render.restype = _I
    lib.mudg_city_sweep.argtypes = [_P, _P, _I, _P, _P, _I, _P, _I, _P, _P, _P, _U, _P, _P, _P, _P]
    lib.mudg_city_sweep.restype = _I
    lib.mudg_city_street.argtypes = [_P, _P, _L, _P]
    lib.mudg_city_street.restype = None
    return lib


def _f64(array: Any) -> NDArray[np.float64]:
    return np.ascontiguousarray(array, np.float64)


class CityHandle:
    """Owns one native world."""

    def __init__(
        self,
        records: NDArray[np.float64],
        plan: StreetPlan,
        road: NDArray[np.float64],
        light: NDArray[np.float64],
        seed: int,
    ) -> None:
        self._lib = library()
        line = _f64(np.stack([plan.line.s, plan.line.x, plan.line.y, plan.line.heading], 1))
        records, marks, walks = _f64(records), _f64(plan.marks), _f64(plan.crosswalks)
        road, light = _f64(road), _f64(light)
        got = (len(road), len(light), records.shape[1])
        expected = tuple(self._lib.mudg_city_number_counts(which) for which in range(3))
        if got != expected:
            what = "the native library belongs to another version of the city"
            raise ResourceError(what, expected=str(got), got=str(expected), remedy="build it again")
        self._handle = self._lib.mudg_city_create(
            records.ctypes.data,
            len(records),
            line.ctypes.data,
            len(line),
            marks.ctypes.data,
            len(marks),
            walks.ctypes.data,
            len(walks),
            road.ctypes.data,
            light.ctypes.data,
            seed & 0x7FFFFFFF,
        )
        if not self._handle:
            raise ResourceError("not enough memory to build the city")
        self.shape_count = int(self._lib.mudg_city_shape_count(self._handle))

    def set_texture(self, slot: int, rgb: NDArray[np.float32], metres: float) -> None:
        """Give a surface or the sky a photograph f32[H, W, 3]; before anything is rendered."""
        pixels = np.ascontiguousarray(rgb, np.float32)
        if self._lib.mudg_city_set_texture(
            self._handle, slot, pixels.ctypes.data, pixels.shape[1], pixels.shape[0], metres
        ):
            raise ResourceError("not enough memory for a texture of the city")

    def set_weather(self, numbers: NDArray[np.float64], lamps: NDArray[np.float64]) -> None:
        """Wet ground, snow and lamps f64[N, 3]; before anything is rendered. Numbers as in native/city_weather.cpp."""
        values, places = _f64(numbers), _f64(lamps).reshape(-1, 3)
        if self._lib.mudg_city_set_weather(self._handle, values.ctypes.data, places.ctypes.data, len(places)):
            raise ResourceError("not enough memory for the lamps of the city")

    def planes(
        self,
        poses: NDArray[np.float64],
        phases: NDArray[np.float64],
        camera: Camera,
        world_from_cam: NDArray[np.float64],
    ) -> NDArray[np.float32]:
        """Normal, albedo, open sky, sun, snow and water f32[H, W, 10] of what the rays through pixel centres meet."""
        out = np.empty((camera.height, camera.width, 10), np.float32)
        poses, phases, numbers, pose = _f64(poses), _f64(phases), _f64(camera.intrinsics), _f64(world_from_cam)
        if self._lib.mudg_city_planes(
            self._handle,
            poses.ctypes.data,
            phases.ctypes.data,
            numbers.ctypes.data,
            camera.width,
            camera.height,
            pose.ctypes.data,
            out.ctypes.data,
        ):
            raise ResourceError("not enough memory to render the city")
        return out

    def __del__(self) -> None:
        if getattr(self, "_handle", None):
            self._lib.mudg_city_destroy(self._handle)
            self._handle = None

    def render(
        self,
        poses: NDArray[np.float64],
        phases: NDArray[np.float64],
        intrinsics: tuple[float, float, float, float],
        width: int,
        height: int,
        world_from_cam: NDArray[np.float64],
        supersample: int,
        noise_key: int,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8], NDArray[np.int32]]:
        """rgb f32[H, W, 3] in [0, 1], depth f32[H, W] (+inf in the sky), semantics u8[H, W], instance i32[H, W]."""
        rgb, depth = np.empty((height, width, 3), np.float32), np.empty((height, width), np.float32)
        semantics, instance = np.empty((height, width), np.uint8), np.empty((height, width), np.int32)
        poses, phases, camera, pose = _f64(poses), _f64(phases), _f64(intrinsics), _f64(world_from_cam)
        code = self._lib.mudg_city_render(
            self._handle,
            poses.ctypes.data,
            phases.ctypes.data,
            camera.ctypes.data,
            width,
            height,
            pose.ctypes.data,
            supersample,
            noise_key & 0xFFFFFFFF,
            rgb.ctypes.data,
            depth.ctypes.data,
            semantics.ctypes.data,
            instance.ctypes.data,
        )
        if code:
            raise ResourceError("not enough memory to render the city")
        return rgb, depth, semantics, instance

    def sweep(
        self,
        poses: NDArray[np.float64],
        phases: NDArray[np.float64],
        elevations: NDArray[np.float64],
        azimuths: NDArray[np.float64],
        world_from_lidar: NDArray[np.float64],
        fractions: NDArray[np.float64],
        settings: tuple[float, float, float, float],
        key: int,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8], NDArray[np.int32]]:
        """World points f32[C, B, 3], intensity f32[C, B] (negative: no return), semantics u8[C, B], instance i32[C, B]
        for C columns and B beams; ``poses`` f64[knots, objects, 4], ``world_from_lidar`` f64[C, 3, 4]."""
        columns, beams = len(azimuths), len(elevations)
        xyz, intensity = np.empty((columns, beams, 3), np.float32), np.empty((columns, beams), np.float32)
        semantics, instance = np.empty((columns, beams), np.uint8), np.empty((columns, beams), np.int32)
        poses, phases, elevations, azimuths = _f64(poses), _f64(phases), _f64(elevations), _f64(azimuths)
        rows, fractions, numbers = _f64(world_from_lidar), _f64(fractions), _f64(settings)
        code = self._lib.mudg_city_sweep(
            self._handle,
            poses.ctypes.data,
            len(poses),
            phases.ctypes.data,
            elevations.ctypes.data,
            beams,
            azimuths.ctypes.data,
            columns,
            rows.ctypes.data,
            fractions.ctypes.data,
            numbers.ctypes.data,
            key & 0xFFFFFFFF,
            xyz.ctypes.data,
            intensity.ctypes.data,
            semantics.ctypes.data,
            instance.ctypes.data,
        )
        if code:
            raise ResourceError("not enough memory to scan the city")
        return xyz, intensity, semantics, instance

    def street(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Per world point [N, 2]: street coordinates s, u and signed distance to the kerb (negative on the road)."""
        xy = _f64(xy).reshape(-1, 2)
        out = np.empty((len(xy), 3), np.float64)
        self._lib.mudg_city_street(self._handle, xy.ctypes.data, len(xy), out.ctypes.data)
        return out
