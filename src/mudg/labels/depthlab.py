"""Dense depth from an image and LiDAR by DepthLab (Liu et al., "DepthLab: from partial to complete", 2024), from a
folder that ``mudg convert`` writes: depth inpainting by latent diffusion, where a second U-Net sees the image and hands
its features over. docs/reference/labels.md says how it is run."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass
from scipy import ndimage
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import checkpoint, records, seeds, store, weights
from mudg.base.config import STRICT
from mudg.base.errors import InputError, IntegrityError, UsageError
from mudg.core.pictures import resize_bicubic
from mudg.labels.inputs import DepthInput, Prediction
from mudg.networks import clip, folders
from mudg.networks.folders import CPU

KIND, SCHEMA, DESCRIPTION = "depthlab", 2, "model.json"
LATENT_SCALE: Final = 0.18215
"""Factor of the autoencoder's latents, for image, mask and depth alike."""
UNETS: Final = ("denoising_unet", "reference_unet")
_MAPPING: Final = "mapping_layer"


@dataclass(frozen=True, config=STRICT)
class DepthLabSampling:
    """How depth is denoised; the defaults are those of MuDG's depth ground truth. ``processing_px``: longest side at
    which the networks work. ``steps``: of the whole schedule. ``strength``: share of the steps that is done, from known
    depth with noise; 1 = all, from noise."""

    processing_px: Annotated[int, Field(ge=8)] = 768
    steps: int = 50
    strength: Annotated[float, Field(gt=0, le=1)] = 0.8

    def __post_init__(self) -> None:
        if int(self.steps * self.strength) < 1:
            where, got, expected = "--depth-steps", str(self.steps), f"at least {int(np.ceil(1 / self.strength))}"
            raise UsageError("too few denoising steps: none is left of them", where=where, got=got, expected=expected)


def _network_classes() -> dict[str, Any]:
    """Sub-folder of a model -> class of its network. ResourceError: a package is missing."""
    diffusers, transformers = folders.package("diffusers"), folders.package("transformers")
    return {
        **dict.fromkeys(UNETS, folders.member(diffusers, "UNet2DConditionModel")),
        "vae": folders.member(diffusers, "AutoencoderKL"),
        "image_encoder": folders.member(transformers, "CLIPVisionModelWithProjection"),
    }


def _scheduler_of(folder: Path) -> Any:
    """The DDIM scheduler of diffusers with the settings of a folder. InputError: they are of another one."""
    file = folder / "scheduler_config.json"
    settings = folders.read_settings(file)
    kind, prediction = settings.get("_class_name"), settings.get("prediction_type", "epsilon")
    expected = "DDIMScheduler, v_prediction, epsilon or sample, rescale_betas_zero_snr: false"
    later = bool(settings.get("rescale_betas_zero_snr"))
    if kind != "DDIMScheduler" or prediction not in ("v_prediction", "epsilon", "sample") or later:
        got = f"{kind}, {prediction}" + (", rescale_betas_zero_snr: true, as in a later Marigold" if later else "")
        raise InputError("the folder's noise schedule is of another kind", where=str(file), got=got, expected=expected)
    return folders.member(folders.package("diffusers"), "DDIMScheduler").from_config(settings)


# --- from the reference U-Net to the denoising U-Net ----------------------------------------------


class _SharedAttention:
    """A processor of diffusers for one self-attention: the given one, with features passed from one U-Net to the other.
    Without a ``source`` it keeps the block's features [N, L, C]; with one, keys and values also come from the features
    kept there."""

    features: Tensor

    def __init__(self, attend: Any, source: _SharedAttention | None = None) -> None:
        self._attend, self._source = attend, source

    def __call__(
        self,
        attn: Any,
        hidden_states: Tensor,
        encoder_hidden_states: Tensor | None = None,
        attention_mask: Tensor | None = None,
        temb: Tensor | None = None,
    ) -> Tensor:
        context = None
        if self._source is None:
            self.features = hidden_states
        else:
            context = torch.cat([hidden_states, self._source.features.to(hidden_states.dtype)], 1)
        return self._attend(attn, hidden_states, context, attention_mask, temb)


def share_features(reference_unet: Any, denoising_unet: Any) -> None:
    """Let every self-attention of the denoising U-Net read, beside its own, the features of the same block of the
    reference U-Net, whose pass must come first from then on, with the same size and batch. InputError: the two differ
    in their blocks, or have none."""
    unets = [dict(unet.named_modules()) for unet in (reference_unet, denoising_unet)]
    writers, readers = ({name: m for name, m in unet.items() if name.rpartition(".")[2] == "attn1"} for unet in unets)
    if set(writers) != set(readers) or not writers:
        got = ", ".join(sorted(set(writers) ^ set(readers))[:4]) or "none at all"
        raise InputError("the two U-Nets differ in their self-attentions", where="DepthLab", got=got)
    for name, writer in writers.items():
        source = _SharedAttention(writer.processor)
        writer.set_processor(source)
        readers[name].set_processor(_SharedAttention(readers[name].processor, source))


# --- inputs of the networks -----------------------------------------------------------------------


class Prepared(NamedTuple):
    """One image f32[1, 3, H, W] in -1..1 and its known depth at the size of the networks, padded to whole latent cells
    by the last row and column (``size``: without). ``crop``: f32[1, 3, S, S], the middle of the image as CLIP wants it.
    ``nearest``, ``linear``: f32[1, 1, H, W], known depth in -1..1, filled by the nearest known and by linear
    interpolation (0 outside the triangles between the known). ``missing``: f32[1, 1, H, W], 1 where depth is not known.
    ``low_m``, ``high_m``: least and greatest known depth."""

    image: Tensor
    crop: Tensor
    nearest: Tensor
    linear: Tensor
    missing: Tensor
    size: tuple[int, int]
    low_m: float
    high_m: float


def prepare(inputs: DepthInput, processing_px: int, cell: int, crop_px: int) -> Prepared:
    """Inputs of the networks for an image; ``cell``: pixels per latent cell and side, ``crop_px``: side of CLIP's
    image. InputError: no depth is known."""
    height, width = inputs.rgb.shape[:2]
    size = tuple(max(1, side * processing_px // max(height, width)) for side in (height, width))
    depth = known_depth(np.where(inputs.known, inputs.measured, np.float32(np.nan)), size)
    known = np.isfinite(depth)
    if not known.any():
        raise InputError("no LiDAR return in the image", where="depth network", expected="at least one")
    low, high = float(depth[known].min()), float(depth[known].max())
    values = ((depth - low) / (high - low + 1e-6) - 0.5) * 2
    index: Any = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    scaled = resize_bicubic(inputs.rgb, size[1], size[0])
    fill = (0, -size[1] % cell, 0, -size[0] % cell)

    def padded(planes: NDArray[Any]) -> Tensor:
        return functional.pad(torch.from_numpy(planes.astype(np.float32))[None], fill, mode="replicate")

    image = padded(scaled.transpose(2, 0, 1)) / 127.5 - 1
    nearest, linear = padded(values[tuple(index)][None]), padded(linear_fill(values)[None])
    return Prepared(image, clip_crop(inputs.rgb, crop_px), nearest, linear, padded(~known[None]), size, low, high)


def known_depth(measured: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Measured depth at another size, f32[h, w]: the nearest one in the part of the image that a pixel covers, NaN
    where there is none. (The published code picks single pixels, which loses most returns when an image shrinks.)"""
    near = torch.from_numpy(np.where(np.isfinite(measured), -measured, np.float32(-np.inf)))[None, None]
    found = -functional.adaptive_max_pool2d(near, size)[0, 0].numpy()
    return np.where(np.isfinite(found), found, np.float32(np.nan))


def linear_fill(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Known values f[h, w] (NaN = unknown) interpolated in the triangles between them; 0 outside, f32[h, w]."""
    row, column = np.nonzero(np.isfinite(values))
    try:
        between = LinearNDInterpolator(np.stack([row, column], 1), values[row, column], fill_value=0)
        filled = between(*np.indices(values.shape)).astype(np.float32)
    except QhullError:  # fewer than three, or all in one line: there are no triangles
        filled = np.zeros(values.shape, np.float32)
    filled[row, column] = values[row, column]
    return filled


def clip_crop(rgb: NDArray[np.uint8], side_px: int) -> Tensor:
    """Image u8[H, W, 3] as CLIP prepares it, f32[1, 3, S, S]: bicubic to the shorter side, the middle, normalised."""
    height, width = rgb.shape[:2]
    shorter = min(height, width)
    high, wide = height * side_px // shorter, width * side_px // shorter
    scaled = resize_bicubic(rgb, wide, high)
    top, left = (high - side_px) // 2, (wide - side_px) // 2
    return folders.normalized(scaled[top : top + side_px, left : left + side_px], clip.MEAN, clip.DEVIATION)


# --- denoising ------------------------------------------------------------------------------------


class DepthLab:
    """A DepthLab model ready for use, from what ``mudg convert`` wrote; every file is checked against its SHA-256.
    ``steps``: of denoising, 0 = as the folder says. InputError: not such a folder, or not of this version.
    IntegrityError: a file is missing or altered. ResourceError: a package is missing. UsageError: too few steps, or
    more than the noise schedule has."""

    def __init__(self, folder: str | Path, device: torch.device = CPU, steps: int = 0) -> None:
        folder, self._device = Path(folder), device
        file, remedy = folder / DESCRIPTION, "convert the published files again"
        described = folders.read_settings(file)
        if described.get("kind") != KIND or described.get("schema") != SCHEMA:
            what, got = "not a DepthLab model of this version", f"{described.get('kind')}, {described.get('schema')}"
            raise InputError(what, where=str(file), expected=f"kind {KIND}, schema {SCHEMA}", got=got, remedy=remedy)
        sampling = records.parse_dataclass(DepthLabSampling, described.get("sampling"), f"{file}: sampling")
        self.sampling = dataclasses.replace(sampling, steps=steps or sampling.steps)
        with records.understood("a DepthLab model", str(file)):
            files = {str(name): str(sha256) for name, sha256 in described["files"].items()}
        for name, sha256 in files.items():
            if not (folder / name).is_file() or store.sha256_file(folder / name) != sha256:
                raise IntegrityError("a file of a model is missing or altered", where=str(folder / name), remedy=remedy)
        found = {name: folders.load_network(of, folder, device, name) for name, of in _network_classes().items()}
        self.networks: dict[str, Any] = {**found, "scheduler": _scheduler_of(folder / "scheduler")}
        mapping = checkpoint.read_tensors(folder / f"{_MAPPING}.safetensors")
        self.mapping = {name: value.float().to(device) for name, value in mapping.items()}
        most = int(self.networks["scheduler"].config.num_train_timesteps)
        if self.sampling.steps > most:
            where, got = "--depth-steps", str(self.sampling.steps)
            raise UsageError("too many denoising steps", where=where, expected=f"<= {most}", got=got)
        self._cell = 2 ** (len(self.networks["vae"].config.block_out_channels) - 1)
        share_features(self.networks["reference_unet"], self.networks["denoising_unet"])

    def __call__(self, inputs: DepthInput) -> Prediction:
        """Depth of one image at the image's size, near metres: it is to be aligned. InputError: no depth is known in
        the image."""
        crop_px = int(self.networks["image_encoder"].config.image_size)
        made = prepare(inputs, self.sampling.processing_px, self._cell, crop_px)
        channels = self.networks["vae"].config.latent_channels
        shape = (1, channels, *(side // self._cell for side in made.image.shape[2:]))
        noise = torch.randn(shape, generator=seeds.torch_generator(0, 0, "depthlab"))
        found = self.predict(made, noise) * (made.high_m - made.low_m) + made.low_m
        return Prediction.resized(found, inputs, "depth", least=0)

    def predict(self, prepared: Prepared, noise: Tensor) -> Tensor:
        """Depth f32[1, 1, h, w], 0..1 between least and greatest known (others go beyond), from noise [1, C, H, W]."""
        denoise, reference, vae, encoder, scheduler = self.networks.values()
        sampling, device, noise = self.sampling, self._device, noise.to(self._device)

        def encoded(plane: Tensor) -> Tensor:
            """Latent f32 of an image [1, 3, H, W], or of one channel thrice."""
            return vae.encode(plane.expand(-1, 3, -1, -1).to(device)).latent_dist.mode() * LATENT_SCALE

        with torch.inference_mode():
            planes = (prepared.nearest, prepared.linear, 2 * prepared.missing - 1, prepared.image)
            depth, known, mask, image = map(encoded, planes)
            # one pixel of every cell decides, as published
            missing = functional.interpolate(prepared.missing, size=noise.shape[2:], mode="nearest").to(device)
            embedding = functional.linear(encoder(prepared.crop.to(device)).image_embeds[:, None], **self.mapping)
            reference(image, torch.zeros((), dtype=torch.int64), encoder_hidden_states=embedding)
            scheduler.set_timesteps(sampling.steps)
            times = scheduler.timesteps[sampling.steps - int(sampling.steps * sampling.strength) :]
            latent = scheduler.add_noise(depth, noise, times[:1]) if sampling.strength < 1 else noise
            for i, t in enumerate(times):  # the pass without image has weight 0 in the published mixture
                seen = torch.cat([latent, mask, known], 1)
                output = denoise(seen, t, encoder_hidden_states=embedding, return_dict=False)[0]
                latent = scheduler.step(output, t, latent).prev_sample
                if i + 1 < len(times):
                    as_known = scheduler.add_noise(depth, noise, times[i + 1 : i + 2])
                    latent = missing * latent + (1 - missing) * as_known
            decoded = vae.decode(latent / LATENT_SCALE, return_dict=False)[0]
        found = decoded.mean(1, keepdim=True)[..., : prepared.size[0], : prepared.size[1]]
        return (found + 1) / 2


# conversion ---------------------------------------------------------------------------------------
#
#     FOLDER/
#       DepthLab/                             denoising_unet.pth, reference_unet.pth, mapping_layer.pth
#       marigold-depth-v1-0/                  scheduler, vae, and of unet the description alone
#       CLIP-ViT-H-14-laion2B-s32B-b79K/      config.json, model.safetensors
#
# Tensors are compared with the networks that the descriptions stand for, by name and shape. The published code takes
# what the pickle of the denoising U-Net or of the linear layer lacks from Marigold or leaves it random; here that is an
# error.

LICENCE: Final = (
    "Weights keep the terms of those who published them: DepthLab, Marigold (made from Stable Diffusion) and the CLIP"
    " image encoder. Read the pages they came from before any use."
)
_BASE, _ENCODER = "marigold-depth-v1-0", "CLIP-ViT-H-14-laion2B-s32B-b79K"


def source_files(folder: Path) -> list[Path]:
    """The weight files that are read. InputError: something is missing."""
    own = [folder / "DepthLab" / f"{part}.pth" for part in (*UNETS, _MAPPING)]
    needed = (*own, folder / _BASE / "unet" / "config.json", folder / _BASE / "vae", folder / _ENCODER)
    missing = [path.relative_to(folder).as_posix() for path in needed if not path.exists()]
    if missing:
        remedy = "put the three folders into one under their own names, as DepthLab's page says, and give that folder"
        raise InputError("a part of DepthLab is missing", where=str(folder), got=", ".join(missing), remedy=remedy)
    return [*own, *(file for part in needed[-2:] for file in sorted(part.glob("*.safetensors")))]


def _filled(network: nn.Module, file: Path, spare: tuple[str, ...] = ()) -> Any:
    """A network on the meta device with the tensors of a published file. Those of ``spare`` are neither published nor
    used: they become 0. InputError: a tensor is missing, unknown, of another shape or not finite."""
    wanted = weights.shapes_of(network)
    zeros = {name: torch.zeros(shape) for name, shape in wanted.items() if name.startswith(spare)} if spare else {}
    state = {name.removeprefix(f"{_MAPPING}."): value for name, value in weights.read_checkpoint(file).items()}
    state = {**zeros, **state}
    weights.match_exactly(state, wanted, str(file), f"DepthLab's {file.stem}")
    weights.refuse_bad_values(state, str(file))
    network.load_state_dict(state, assign=True)
    return network


def convert_folder(folder: Path, to: Path, dtype: torch.dtype | None, shard_bytes: int) -> None:
    """The conversion of a folder of sources, in this process; ``to`` is complete or not there. ``dtype``: number format
    of the weights (None: as they are). ``shard_bytes``: of one file. InputError: something is missing or is not
    DepthLab. ResourceError: a package is missing, or the disk is full."""
    files, classes = source_files(folder), _network_classes()
    scheduler = _scheduler_of(folder / _BASE / "scheduler")
    whole: Any = folders.load_network(folders.member(folders.package("transformers"), "CLIPModel"), folder / _ENCODER)
    vae: Any = folders.load_network(classes["vae"], folder / _BASE, subfolder="vae")
    if abs(float(vae.config.scaling_factor) - LATENT_SCALE) > 1e-9:
        what, got = "the autoencoder scales its latents otherwise than DepthLab does", str(vae.config.scaling_factor)
        raise InputError(what, where="vae: scaling_factor", expected=str(LATENT_SCALE), got=got)
    vision, latent = whole.config.vision_config, vae.config.latent_channels
    vision.projection_dim = whole.config.projection_dim  # old descriptions repeat a default inside
    file = folder / _BASE / "unet" / "config.json"
    layout = folders.read_settings(file)
    with records.understood("the description of a network", str(file)), torch.device("meta"):
        encoder = classes["image_encoder"](vision)
        mapping = nn.Linear(vision.projection_dim, layout["cross_attention_dim"])
        channels = zip(UNETS, (3 * latent, latent), strict=True)
        unets = [classes[part].from_config({**layout, "in_channels": count}) for part, count in channels]
    encoder.vision_model, encoder.visual_projection = whole.vision_model, whole.visual_projection
    *unet_files, mapping_file = files[:3]
    spares = ((), ("conv_norm_out.", "conv_out."))
    filled = [_filled(*one) for one in zip(unets, unet_files, spares, strict=True)]
    networks = {**dict(zip(UNETS, filled, strict=True)), "vae": vae, "image_encoder": encoder}
    mapped = {name: value.float() for name, value in _filled(mapping, mapping_file).state_dict().items()}
    sources = [
        {"file": f.relative_to(folder).as_posix(), "bytes": f.stat().st_size, "sha256": store.sha256_file(f)}
        for f in files
    ]
    rows = "".join(f"| {source['file']} | {source['bytes']} | {source['sha256']} |\n" for source in sources)
    card = (
        "# DepthLab: depth inpainting, for `mudg annotate --depth-network`\n\n"
        f"Converted from:\n\n| file | bytes | SHA-256 |\n|---|---|---|\n{rows}\n## Licence\n\n{LICENCE}\n"
    )
    with store.atomic_directory(to) as partial, store.disk_errors("cannot write the model", to):
        for name, network in networks.items():
            (network if dtype is None else network.to(dtype)).save_pretrained(
                partial / name, max_shard_size=shard_bytes
            )
        scheduler.save_pretrained(partial / "scheduler")
        store.write_safetensors(partial / f"{_MAPPING}.safetensors", mapped)
        written = {name: store.sha256_file(partial / name) for name in store.list_files(partial)}
        store.write_text(partial / "MODEL_CARD.md", card)
        description = {"schema": SCHEMA, "kind": KIND, "sampling": dataclasses.asdict(DepthLabSampling())}
        description |= {"files": written, "facts": {"sources": sources, "licence": LICENCE}}
        store.write_json(partial / DESCRIPTION, description)
        store.sync_tree(partial)
