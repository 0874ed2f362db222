"""Depth by a latent diffusion model from a Marigold folder of diffusers, optionally guided by LiDAR.

Ke et al., "Repurposing diffusion-based image generators for monocular depth estimation" (2024): a U-Net denoises the
latent of a depth map beside the latent of the image; the decoder's mean over three channels, from -1 to 1, is depth up
to scale and shift.

With guidance, after Viola et al., "Marigold-DC: zero-shot monocular depth completion with guided diffusion" (2024): at
every step the clean latent that the network foresees is decoded and compared with LiDAR; the noisy latent is moved down
the gradient of the difference, which is brought to the length of the foreseen noise, by Adam. Scale and shift are not
learnt along, as there, but fitted anew at every step (``core.depth.fit_affine``), which needs no rate and lets go of
wrong returns.

Only the networks in the folder are used, not the package's pipeline: it would import what a file names. The noise is
the same for every image, so that a video does not flicker for its sake.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from mudg.base import seeds
from mudg.base.errors import InputError, UsageError
from mudg.core.depth import AffineFit, Space, fit_affine
from mudg.labels.inputs import PLAIN, DepthInput, DepthOptions, Prediction
from mudg.networks import folders
from mudg.networks.folders import CPU, Compute

GUIDED_STEPS: Final = 50
PLAIN_STEPS: Final = 10
RATE: Final = 0.05
"""Adam's rate for the latent, as published."""
PROCESSING_PX: Final = 768
SCHEDULE_FILE: Final = "scheduler/scheduler_config.json"
MAX_RETURNS: Final = 50_000
"""Returns that steer; more are thinned evenly."""


@dataclass(frozen=True, slots=True, eq=False)
class MarigoldParts:
    """The networks of a folder: U-Net, autoencoder, scheduler of diffusers, and the embedding [1, N, D] of no text."""

    unet: Any
    vae: Any
    scheduler: Any
    empty_text: Tensor


@dataclass(frozen=True, slots=True, eq=False)
class _Returns:
    """Where LiDAR steers: places ``grid`` f32[1, 1, N, 2] in -1..1 of the unpadded image, metres f32[N], and what the
    network's numbers stand for there, depth or its inverse, f32[N]."""

    grid: Tensor
    depth_m: Tensor
    goal: Tensor


class Marigold:
    """A Marigold model ready for use; ``load`` makes one from a folder."""

    def __init__(
        self,
        parts: MarigoldParts,
        *,
        space: Space = "depth",
        steps: int = PLAIN_STEPS,
        guided: bool = False,
        longest_px: int = PROCESSING_PX,
        compute: Compute = CPU,
    ) -> None:
        """``longest_px``: longest side for the networks.

        Raises:
            UsageError: more steps than the noise schedule has.
        """
        check_steps(parts.scheduler, steps)
        self._parts, self._space, self._steps, self._guided = parts, space, steps, guided
        self._longest_px, self._compute = longest_px, compute
        self._cell = 2 ** (len(parts.vae.config.block_out_channels) - 1)

    @classmethod
    def load(cls, folder: str | Path, compute: Compute = CPU, options: DepthOptions = PLAIN) -> Marigold:
        """Read the networks of a folder.

        Raises:
            ResourceError: a package or the device is missing. InputError: a part is missing or another kind.
                UsageError: too many steps.
        """
        path = Path(folder)
        index = folders.read_settings(path / "model_index.json")
        diffusers, transformers = folders.package("diffusers"), folders.package("transformers")
        text = folders.load_network(folders.member(transformers, "CLIPTextModel"), path, compute, "text_encoder")
        with torch.no_grad():
            empty_text = text(_empty_tokens(path).to(compute.device))[0].float()
        schedule = path / SCHEDULE_FILE
        unet = folders.load_network(folders.member(diffusers, "UNet2DConditionModel"), path, compute, "unet")
        vae = folders.load_network(folders.member(diffusers, "AutoencoderKL"), path, compute, "vae")
        parts = MarigoldParts(unet, vae, ddim_scheduler(folders.read_settings(schedule), str(schedule)), empty_text)
        space: Space = "disparity" if index.get("prediction_type") == "disparity" else "depth"
        usual = GUIDED_STEPS if options.guided else int(index.get("default_denoising_steps") or PLAIN_STEPS)
        longest_px = int(index.get("default_processing_resolution") or PROCESSING_PX)
        steps, guided = options.steps or usual, options.guided
        return cls(parts, space=space, steps=steps, guided=guided, longest_px=longest_px, compute=compute)

    def __call__(self, inputs: DepthInput) -> Prediction:
        """Depth of one image at the image's size, up to scale and shift (to what is near the LiDAR's with guidance)."""
        image, size = self._prepared(inputs.rgb)
        shape = (1, self._parts.vae.config.latent_channels, *(side // self._cell for side in image.shape[2:]))
        noise = torch.randn(shape, generator=seeds.torch_generator(0, 0, "marigold"))
        returns = _returns(inputs, self._space, self._compute.device) if self._guided else None
        found = self.predict(image, size, noise, returns)
        return Prediction.resized(found, inputs, self._space)

    def _prepared(self, rgb: NDArray[np.uint8]) -> tuple[Tensor, tuple[int, int]]:
        """Image u8[H, W, 3] -> f32[1, 3, h, w] in -1..1, its borders repeated to whole cells; and its unpadded size."""
        image = torch.from_numpy(rgb.copy()).permute(2, 0, 1)[None].float() / 127.5 - 1
        size = working_size(rgb, self._longest_px)
        image = functional.interpolate(image, size=size, mode="bilinear", antialias=True)
        fill = (0, -size[1] % self._cell, 0, -size[0] % self._cell)
        return functional.pad(image, fill, mode="replicate").to(self._compute.device), size

    def predict(self, image: Tensor, size: tuple[int, int], noise: Tensor, returns: _Returns | None = None) -> Tensor:
        """Depth f32[1, 1, h, w] in 0..1 of a prepared image, from noise [1, C, h, w] in cells; steered by returns."""
        scheduler, vae = self._parts.scheduler, self._parts.vae
        scheduler.set_timesteps(self._steps)
        with torch.no_grad(), self._compute.autocast():
            image_latent = vae.encode(image).latent_dist.mode() * vae.config.scaling_factor
        latent = noise.to(image.device)
        adam = _Adam(latent.shape, latent.device)
        for t in scheduler.timesteps:
            if returns is None:
                with torch.no_grad():
                    output = self._denoised(image_latent, latent, t)
            else:
                with torch.enable_grad():
                    latent = latent.detach().requires_grad_()
                    output = self._denoised(image_latent, latent, t)
                    gradient = self._gradient(latent, output, t, size, returns)
                noise_length = float(self._foreseen(latent.detach(), output.detach(), t)[1].norm())
                latent = latent.detach() - adam.step(gradient * (noise_length / max(float(gradient.norm()), 1e-8)))
            latent = scheduler.step(output.detach(), t, latent.detach()).prev_sample
        with torch.no_grad():
            return self._decoded(latent, size).clamp(0, 1)

    def _denoised(self, image_latent: Tensor, latent: Tensor, t: Tensor) -> Tensor:
        with self._compute.autocast():
            given = torch.cat([image_latent.to(latent.dtype), latent], 1)
            output = self._parts.unet(given, t, encoder_hidden_states=self._parts.empty_text, return_dict=False)[0]
        return output.float()

    def _decoded(self, latent: Tensor, size: tuple[int, int]) -> Tensor:
        """Latent -> f32[1, 1, h, w], 0..1 but for overshoots, cut to the unpadded size."""
        vae = self._parts.vae
        with self._compute.autocast():
            found = vae.decode(latent / vae.config.scaling_factor, return_dict=False)[0]
        return (found.float().mean(1, keepdim=True)[..., : size[0], : size[1]] + 1) / 2

    def _foreseen(self, latent: Tensor, output: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Clean latent and noise that the network's output stands for at step ``t``."""
        kept = float(self._parts.scheduler.alphas_cumprod[int(t)])
        signal, noise = math.sqrt(kept), math.sqrt(1 - kept)
        kind = self._parts.scheduler.config.prediction_type
        if kind == "v_prediction":
            return signal * latent - noise * output, signal * output + noise * latent
        if kind == "epsilon":
            return (latent - noise * output) / signal, output
        return output, (latent - signal * output) / noise

    def _gradient(self, latent: Tensor, output: Tensor, t: Tensor, size: tuple[int, int], returns: _Returns) -> Tensor:
        """Gradient of the mean error at the returns."""
        clean, _ = self._foreseen(latent, output, t)
        depth = self._decoded(clean, size)
        at = functional.grid_sample(depth, returns.grid, mode="bilinear", padding_mode="border", align_corners=False)
        values = at[0, 0, 0]
        fit = fit_affine(values.detach().cpu(), returns.depth_m.cpu(), self._space)
        scale, shift, spread = _towards(fit, returns.goal)
        error = (scale * values + shift) / returns.goal - 1
        loss = functional.huber_loss(error, torch.zeros_like(error), delta=max(3 * spread, 1e-3))
        return torch.autograd.grad(loss, latent)[0]


class _Adam:
    """Steps of Adam (Kingma and Ba) for one tensor that the caller moves."""

    def __init__(self, shape: torch.Size, device: torch.device) -> None:
        self._mean, self._square = torch.zeros(shape, device=device), torch.zeros(shape, device=device)
        self._count = 0

    def step(self, gradient: Tensor) -> Tensor:
        """What to take away."""
        self._count += 1
        self._mean = 0.9 * self._mean + 0.1 * gradient
        self._square = 0.999 * self._square + 0.001 * gradient.square()
        mean, square = self._mean / (1 - 0.9**self._count), self._square / (1 - 0.999**self._count)
        return RATE * mean / (square.sqrt() + 1e-8)


def _towards(fit: AffineFit, goal: Tensor) -> tuple[float, float, float]:
    """Scale and shift to compare with, and half of the errors' spread. Where the foreseen depth does not rise with the
    returns, as in the first steps, 0..1 stands for the range of the returns."""
    if math.isfinite(fit.residual) and fit.scale > 0:
        return fit.scale, fit.shift, fit.residual
    low, high = (float(goal.quantile(share)) for share in (0.02, 0.98))
    return high - low, low, 0.5


def _returns(inputs: DepthInput, space: Space, device: str) -> _Returns | None:
    row, column = np.nonzero(np.isfinite(inputs.measured) & ~inputs.sky)
    if len(row) == 0:
        return None
    keep = np.linspace(0, len(row) - 1, min(len(row), MAX_RETURNS)).astype(int)
    row, column = row[keep], column[keep]
    height, width = inputs.measured.shape
    grid = np.stack([2 * (column + 0.5) / width - 1, 2 * (row + 0.5) / height - 1], 1).astype(np.float32)
    depth_m = torch.from_numpy(inputs.measured[row, column]).to(device)
    goal = depth_m if space == "depth" else 1 / depth_m
    return _Returns(torch.from_numpy(grid)[None, None].to(device), depth_m, goal)


def working_size(rgb: NDArray[np.uint8], longest_px: int) -> tuple[int, int]:
    """Height and width of an image u8[H, W, 3] whose longest side gets ``longest_px`` pixels."""
    height, width = rgb.shape[:2]
    return max(1, height * longest_px // max(height, width)), max(1, width * longest_px // max(height, width))


def check_steps(scheduler: Any, steps: int) -> None:
    """UsageError for more denoising steps than the noise schedule has."""
    most = int(scheduler.config.num_train_timesteps)
    if steps > most:
        raise UsageError("too many denoising steps", where="--depth-steps", expected=f"<= {most}", got=str(steps))


def ddim_scheduler(settings: Mapping[str, Any], where: str) -> Any:
    """The DDIM scheduler of diffusers with the settings of a folder.

    Raises:
        InputError: the settings are of another scheduler. ResourceError: diffusers is missing.
    """
    kind, prediction = settings.get("_class_name"), settings.get("prediction_type", "epsilon")
    if kind != "DDIMScheduler" or prediction not in _PREDICTIONS:
        got, expected = f"{kind}, {prediction}", f"DDIMScheduler, {', '.join(_PREDICTIONS)}"
        raise InputError("the folder's noise schedule is of another kind", where=where, got=got, expected=expected)
    scheduler_class = folders.member(folders.package("diffusers"), "DDIMScheduler")
    return scheduler_class.from_config({name: value for name, value in settings.items() if not name.startswith("_")})


_PREDICTIONS: Final = ("v_prediction", "epsilon", "sample")


def _empty_tokens(folder: Path) -> Tensor:
    """Numbers of the tokens that begin and end a text, i64[1, 2]: the empty text that conditions the network."""
    file = folder / "tokenizer" / "vocab.json"
    if file.is_file():
        vocabulary = folders.read_settings(file)
    else:
        file = folder / "tokenizer" / "tokenizer.json"
        vocabulary = folders.read_settings(file).get("model", {}).get("vocab", {})
    marks = [vocabulary.get(name) for name in ("<|startoftext|>", "<|endoftext|>")]
    if not all(isinstance(mark, int) for mark in marks):
        raise InputError("the vocabulary lacks the marks of a text's ends", where=str(file), got=str(marks))
    return torch.tensor([marks])
