"""Dense depth by a pretrained network from a folder (PromptDepthAnything, Depth Anything V1 and V2, DepthLab), aligned
to the visible LiDAR returns with one robust scale and shift per frame. There is no result where too few returns are
visible, or where the network's depth does not fit them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from mudg.base.errors import InputError, ResourceError
from mudg.core.depth import FAR_M, NEAR_M, SKY_M, AffineFit, DenseDepth, Space, fit_affine
from mudg.core.pictures import resize_bicubic
from mudg.labels.depthlab import DepthLab
from mudg.labels.inputs import DepthInput, DepthNetwork, Prediction
from mudg.networks import folders
from mudg.networks.folders import CPU

CUE_PX: Final = 256
"""Longest side of the small depth map that PromptDepthAnything is given (its training had 256x192)."""
_ERROR_SCALE: Final = 0.05
_SKY_CONFIDENCE: Final = 0.8

# --- networks of transformers ---------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Preparation:
    """Preparation of images: size in pixels, the multiple of both sides, mean and deviation of colours in 0..1."""

    height: int
    width: int
    multiple: int
    keep_aspect: bool
    mean: tuple[float, ...]
    deviation: tuple[float, ...]

    @classmethod
    def read(cls, folder: Path, side_px: int, multiple: int) -> Preparation:
        """From ``preprocessor_config.json``; side and multiple where it is silent."""
        file = folder / "preprocessor_config.json"
        settings = folders.read_settings(file) if file.is_file() else {}
        size = settings.get("size") or {}
        if not isinstance(size, dict):
            size = {"height": size, "width": size}
        height, width = (int(size.get(side, side_px)) for side in ("height", "width"))
        multiple = int(settings.get("ensure_multiple_of") or multiple)
        mean, deviation = settings.get("image_mean") or folders.MEAN, settings.get("image_std") or folders.DEVIATION
        keep_aspect = bool(settings.get("keep_aspect_ratio", True))
        return cls(height, width, multiple, keep_aspect, tuple(mean), tuple(deviation))

    def size_for(self, height: int, width: int) -> tuple[int, int]:
        """Height and width the network reads: with the aspect kept, the side that changes less gets its size."""
        by = [self.height / height, self.width / width]
        if self.keep_aspect:
            by = [min(by, key=lambda factor: abs(1 - factor))] * 2
        step = self.multiple
        high, wide = (max(1, round(f * side / step)) * step for f, side in zip(by, (height, width)))
        return high, wide

    def pixels(self, rgb: NDArray[np.uint8]) -> Tensor:
        """Image u8[H, W, 3] -> f32[1, 3, h, w] as the network wants it."""
        height, width = self.size_for(*rgb.shape[:2])
        return folders.normalized(resize_bicubic(rgb, width, height), self.mean, self.deviation)


class TransformersDepth:
    """A depth network of transformers, ready for use; ``with_lidar``: it reads a small depth map beside the image."""

    def __init__(
        self, network: Any, preparation: Preparation, space: Space, *, with_lidar: bool, device: torch.device = CPU
    ) -> None:
        self._network, self._preparation, self._space = network, preparation, space
        self._with_lidar, self._device = with_lidar, device

    def __call__(self, inputs: DepthInput) -> Prediction:
        """Depth of one image at the image's size."""
        tensors = {"pixel_values": self._preparation.pixels(inputs.rgb)}
        if self._with_lidar:
            tensors["prompt_depth"] = lidar_cue(inputs)
        with torch.inference_mode():
            output = self._network(**{name: value.to(self._device) for name, value in tensors.items()})
        return Prediction.resized(output.predicted_depth.float()[:, None], inputs, self._space)


def lidar_cue(inputs: DepthInput, longest_px: int = CUE_PX) -> Tensor:
    """Small depth map f32[1, 1, h, w] metres without holes: returns filled along the image, the sky as far as the
    farthest. The network scales the map to 0..1 by its least and greatest value; the sky at its own distance would
    squeeze all the rest. InputError: nothing was measured."""
    ground = np.isfinite(inputs.filled) & ~inputs.sky
    if not ground.any():
        raise InputError("no LiDAR return in the image", where="depth network", expected="at least one")
    far_m, near_m = (float(np.quantile(inputs.filled[ground], share)) for share in (0.995, 0.005))
    dense = np.where(ground, inputs.filled, np.float32(far_m)).clip(near_m, max(far_m, near_m * 1.01))
    height, width = dense.shape
    scale = min(1.0, longest_px / max(height, width))
    size = (max(1, round(height * scale)), max(1, round(width * scale)))
    whole = torch.from_numpy(dense.astype(np.float32))[None, None]
    small = functional.interpolate(whole, size=size, mode="nearest-exact")
    if float(small.max() - small.min()) <= 0:
        small[..., 0, 0] *= 1.01  # the network divides by the range
    return small


def _load_transformers(folder: Path, device: torch.device, *, with_lidar: bool) -> TransformersDepth:
    class_name = "PromptDepthAnythingForDepthEstimation" if with_lidar else "DepthAnythingForDepthEstimation"
    network_class = folders.member(folders.package("transformers"), class_name)
    network: Any = folders.load_network(network_class, folder, device)
    preparation = Preparation.read(folder, 756 if with_lidar else 518, int(network.config.patch_size))
    space: Space = "depth" if with_lidar or network.config.depth_estimation_type == "metric" else "disparity"
    return TransformersDepth(network, preparation, space, with_lidar=with_lidar, device=device)


# --- folders --------------------------------------------------------------------------------------

KINDS: Final[Mapping[str, Callable[[Path, torch.device, int], DepthNetwork]]] = {
    "prompt_depth_anything": lambda folder, place, _: _load_transformers(folder, place, with_lidar=True),
    "depth_anything": lambda folder, place, _: _load_transformers(folder, place, with_lidar=False),
    "depthlab": DepthLab,
}
"""``model_type`` of a folder's ``config.json``, or ``kind`` of the ``model.json`` that ``mudg convert`` writes -> what
reads the folder, given a place to compute and the denoising steps."""


def kind_of(folder: str | Path) -> str:
    """Kind of network according to a folder's description; nothing else of it is read. ResourceError: no such folder,
    or it has no description. InputError: another kind of network."""
    path = Path(folder)
    for name, key in (("config.json", "model_type"), ("model.json", "kind")):
        if folder and (path / name).is_file():
            kind = str(folders.read_settings(path / name).get(key))
            if kind not in KINDS:
                what = "the folder holds another kind of network"
                raise InputError(what, where=str(path / name), expected=", ".join(KINDS), got=kind)
            return kind
    where = str(folder) or "--depth-network"
    expected = "a folder with config.json (transformers) or model.json (mudg convert)"
    remedy = "give the folder of such a network as --depth-network, or leave the flag out"
    raise ResourceError("the depth network's weights are missing", where=where, expected=expected, remedy=remedy)


def load_depth_network(folder: str | Path, device: torch.device = CPU, steps: int = 0) -> DepthNetwork:
    """A depth network of the table, read from its folder; ``steps``: of denoising, 0 = as the folder says.
    ResourceError: folder or package is missing. InputError: another kind of network, or not all of it."""
    return KINDS[kind_of(folder)](Path(folder), device, steps)


# --- alignment to LiDAR, for every network --------------------------------------------------------


def align_to_lidar(prediction: Prediction, inputs: DepthInput) -> tuple[DenseDepth | None, AffineFit]:
    """A network's depth brought to the frame's LiDAR: one scale and shift, the sky at ``SKY_M``, a confidence; and the
    fit. None where the fit is not to be believed. InputError: prediction and image differ in size."""
    if prediction.values.shape != inputs.measured.shape:
        what, where = "a network's depth and its image differ in size", "depth network"
        raise InputError(what, where=where, expected=str(inputs.measured.shape), got=str(prediction.values.shape))
    known = inputs.known
    values, measured = prediction.values[known], inputs.measured[known]
    fit = fit_affine(torch.from_numpy(values), torch.from_numpy(measured), prediction.space)
    if not fit.used:
        return None, fit
    depth = fit.depth(torch.from_numpy(prediction.values).double(), NEAR_M, FAR_M).float().numpy()
    confidence = residual_confidence(depth, np.where(known, inputs.measured, np.float32(np.nan)), inputs.sky, SKY_M)
    depth[inputs.sky] = SKY_M
    return DenseDepth(depth, confidence), fit


def residual_confidence(
    depth: NDArray[np.float32], measured: NDArray[np.float32], sky: NDArray[np.bool_], sky_m: float
) -> NDArray[np.float32]:
    """exp(-e / 0.05) of the relative error e to be expected of ``depth`` f32[H, W], in 0..1; the same scale as that of
    ``core.depth.complete_depth``. e is the mean error at what was ``measured`` (NaN: nothing) around a pixel, within
    the distance that most pixels have to one. Away from all of them it goes over to twice the frame's mean error:
    nothing was compared there. Steps of depth around the pixel add to it. ``sky_m``: distance of the ``sky``."""
    known = np.isfinite(measured)
    off = np.zeros(depth.shape, np.float32)
    off[known] = np.minimum(np.abs(np.log(depth[known] / measured[known])), 1)
    rows = np.flatnonzero(known.any(1))
    away_px: Any = ndimage.distance_transform_edt(~known)
    reach_px = max(3.0, 2 * float(np.quantile(away_px[rows[0] : rows[-1] + 1], 0.9)))
    near: Any = ndimage.gaussian_filter(known.astype(np.float32), reach_px, mode="constant")
    total: Any = ndimage.gaussian_filter(off, reach_px, mode="constant")
    usual = 0.02 * float(near[known].mean())  # the say of not knowing, beside the usual number of measurements
    error = (total + usual * 2 * float(off[known].mean())) / (near + usual)
    around = np.log(np.where(sky, np.float32(sky_m), depth))
    steps = ndimage.maximum_filter(around, 5) - ndimage.minimum_filter(around, 5)
    confidence = np.exp(-(0.002 + error + 0.05 * np.minimum(steps, 1)) / _ERROR_SCALE).astype(np.float32)
    confidence[sky] = _SKY_CONFIDENCE
    return confidence
