"""Dense depth from an image and LiDAR by a DepthLab folder, as ``mudg convert`` writes it: depth inpainting by latent
diffusion.

Liu et al., "DepthLab: from partial to complete" (2024). Two U-Nets of one layout: the reference U-Net sees the image's
latent once, and what its self-attentions read is kept; each self-attention of the denoising U-Net reads that beside its
own features. The denoising U-Net sees the noisy latent of depth, the latent of the mask (1 = missing) and the latent of
known depth, interpolated. Both are conditioned on one vector: the image's CLIP embedding through a linear layer.

Depth is scaled by the least and greatest known depth to -1..1. Denoising starts part of the way (``strength``) at known
depth filled by the nearest; after every step but the last, latent cells that are known get that depth's latent with the
noise of the step (Avrahami et al., "Blended diffusion", 2022). So the last step alone is free of them: known depth is
kept nearly, not exactly.

The published code runs every step twice, with and without image, and mixes the two with weight 1, which is the one with
the image: only that one is computed here. The noise is the same for every image.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass
from scipy import ndimage
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import checkpoint, records, seeds, store, weights
from mudg.base.config import STRICT
from mudg.base.errors import InputError, UsageError
from mudg.core.pictures import resize_bicubic
from mudg.labels.inputs import DepthInput, Prediction
from mudg.networks import clip, folders
from mudg.networks.folders import CPU

KIND: Final = "depthlab"
SCHEMA: Final = 1
DESCRIPTION: Final = "model.json"
LATENT_SCALE: Final = 0.18215
"""Factor of the autoencoder's latents, for image, mask and depth alike."""
UNETS: Final = ("denoising_unet", "reference_unet")
PARTS: Final = (*UNETS, "mapping_layer", "vae", "image_encoder")
_VISION: Final = (
    "hidden_size intermediate_size projection_dim num_hidden_layers num_attention_heads num_channels image_size "
    "patch_size hidden_act layer_norm_eps"
).split()


@checked_dataclass(frozen=True, config=STRICT)
class DepthLabSampling:
    """How depth is denoised; the defaults are those of MuDG's depth ground truth.

    Args:
        processing_px: longest side at which the networks work.
        steps: of the whole schedule.
        strength: share of the steps that is done, from known depth with noise; 1 = all, from noise.
        normalize_scale: known depth spans -scale..scale; below 1 it leaves room for what is farther.
    """

    processing_px: Annotated[int, Field(ge=8)] = 768
    steps: int = 50
    strength: Annotated[float, Field(gt=0, le=1)] = 0.8
    normalize_scale: Annotated[float, Field(gt=0, le=1)] = 1.0

    def __post_init__(self) -> None:
        if int(self.steps * self.strength) < 1:
            where, got, expected = "--depth-steps", str(self.steps), f"at least {int(np.ceil(1 / self.strength))}"
            raise UsageError("too few denoising steps: none is left of them", where=where, got=got, expected=expected)


PUBLISHED_SAMPLING: Final = DepthLabSampling()

# --- the networks ---------------------------------------------------------------------------------


def part_configs(
    unet: Mapping[str, Any], vae: Mapping[str, Any], vision: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Configurations of all parts, from those of Marigold's U-Net and autoencoder and of the image encoder.

    Raises:
        InputError: a number is missing, or one that DepthLab's sampling takes for granted differs.
    """
    plain = {name: value for name, value in unet.items() if not name.startswith("_")}
    encoder = {name: vision[name] for name in _VISION if name in vision}
    with records.understood("the networks of DepthLab", "DepthLab"):
        latent, width, embedding = vae["latent_channels"], plain["cross_attention_dim"], encoder["projection_dim"]
    if abs(float(vae.get("scaling_factor", LATENT_SCALE)) - LATENT_SCALE) > 1e-9:
        what = "the autoencoder scales its latents otherwise than DepthLab does"
        raise InputError(what, where="vae: scaling_factor", expected=str(LATENT_SCALE), got=str(vae["scaling_factor"]))
    return {
        "denoising_unet": {**plain, "in_channels": 3 * latent},
        "reference_unet": {**plain, "in_channels": latent},
        "mapping_layer": {"in_features": embedding, "out_features": width},
        "vae": {name: value for name, value in vae.items() if not name.startswith("_")},
        "image_encoder": encoder,
    }


def blank_parts(configs: Mapping[str, Mapping[str, Any]]) -> dict[str, nn.Module]:
    """The networks of ``PARTS`` without values (on the meta device): they say which tensors a folder must hold.

    The reference U-Net ends with its last block: what follows there is neither published nor used.

    Raises:
        InputError: a configuration that the packages refuse. ResourceError: a package is missing.
    """
    diffusers, transformers = folders.package("diffusers"), folders.package("transformers")
    unet = folders.member(diffusers, "UNet2DConditionModel")
    vision = folders.member(transformers, "CLIPVisionConfig")
    vae = folders.member(diffusers, "AutoencoderKL")
    encoder = folders.member(transformers, "CLIPVisionModelWithProjection")
    makers: dict[str, Callable[[dict[str, Any]], nn.Module]] = {
        **dict.fromkeys(UNETS, unet.from_config),
        "mapping_layer": lambda config: nn.Linear(**config),
        "vae": vae.from_config,
        "image_encoder": lambda config: encoder(vision(**config)),
    }
    made: dict[str, nn.Module] = {}
    for name, make in makers.items():
        with records.understood("the description of a network", f"DepthLab: {name}"), torch.device("meta"):
            made[name] = make(dict(configs[name]))
    reference: Any = made["reference_unet"]
    reference.conv_norm_out, reference.conv_out = None, nn.Identity()
    return made


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class DepthLabParts:
    """The networks, ready for use, and the noise schedule of diffusers (DDIM)."""

    denoising_unet: Any
    reference_unet: Any
    mapping_layer: Any
    vae: Any
    image_encoder: Any
    scheduler: Any


def read_parts(folder: Path, described: Mapping[str, Any], device: torch.device = CPU) -> DepthLabParts:
    """The networks of a converted folder in float32 on their device, every file checked against its sha256.

    Raises:
        InputError: the description is not whole, or tensors do not fit it. IntegrityError: a file is missing or
            altered.
        ResourceError: a package is missing.
    """
    where = folder / DESCRIPTION
    with records.understood("a DepthLab model", str(where)):
        configs = {name: dict(described["parts"][name]["config"]) for name in PARTS}
        files = {name: {str(f): str(d) for f, d in described["parts"][name]["files"].items()} for name in PARTS}
        schedule = dict(described["scheduler"])
        made = blank_parts(configs)
    for name, network in made.items():
        state = checkpoint.read_shards(folder / name, files[name], remedy="convert the published files again")
        weights.match_exactly(state, weights.shapes_of(network), str(folder / name), "its configuration")
        network.load_state_dict({n: value.float() for n, value in state.items()}, assign=True)
        _fill_tables(network, name)
        network.to(device).eval().requires_grad_(False)
    return DepthLabParts(**made, scheduler=ddim_scheduler(schedule, f"{where}: scheduler"))


def _fill_tables(network: nn.Module, part: str) -> None:
    """Number the places of the image encoder's patches: the one table that its file does not hold."""
    for name, table in list(network.named_buffers()):
        if not table.is_meta:
            continue
        owner, _, short = name.rpartition(".")
        if short != "position_ids":
            raise InputError("the installed package's network has a table that is not known", where=part, got=name)
        setattr(network.get_submodule(owner), short, torch.arange(table.shape[-1]).expand(table.shape).clone())


def ddim_scheduler(settings: Mapping[str, Any], where: str) -> Any:
    """The DDIM scheduler of diffusers with the settings of a folder.

    Raises:
        InputError: the settings are of another scheduler. ResourceError: diffusers is missing.
    """
    kind, prediction = settings.get("_class_name"), settings.get("prediction_type", "epsilon")
    if kind != "DDIMScheduler" or prediction not in ("v_prediction", "epsilon", "sample"):
        got, expected = f"{kind}, {prediction}", "DDIMScheduler, v_prediction, epsilon or sample"
        raise InputError("the folder's noise schedule is of another kind", where=where, got=got, expected=expected)
    scheduler_class = folders.member(folders.package("diffusers"), "DDIMScheduler")
    return scheduler_class.from_config({name: value for name, value in settings.items() if not name.startswith("_")})


# --- from the reference U-Net to the denoising U-Net ----------------------------------------------


class _SharedAttention:
    """A processor of diffusers for one self-attention: the given one, with features passed from one U-Net to the other.

    Without a ``source`` it keeps the block's features [N, L, C]; with one, keys and values also come from the features
    kept there.
    """

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
        if self._source is None:
            self.features, context = hidden_states, None
        else:
            context = torch.cat([hidden_states, self._source.features.to(hidden_states.dtype)], 1)
        return self._attend(attn, hidden_states, context, attention_mask, temb)


def share_features(reference_unet: Any, denoising_unet: Any) -> None:
    """Let every self-attention of the denoising U-Net read, beside its own, the features of the same block of the
    reference U-Net.

    From then on a pass of the reference U-Net must come before those of the denoising U-Net, with the same size and
    batch.

    Raises:
        InputError: the two differ in their blocks, or have none.
    """
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


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """One image and its known depth at the size of the networks, padded to whole latent cells by the last row and
    column.

    Args:
        image: f32[1, 3, H, W] in -1..1.
        crop: f32[1, 3, S, S], the middle of the image as CLIP wants it.
        nearest, linear: f32[1, 1, H, W], known depth in -scale..scale, filled by the nearest known and by linear
            interpolation (0 outside the triangles between the known).
        missing: f32[1, 1, H, W], 1 where depth is not known.
        size: height and width without the padding.
        low_m, high_m: least and greatest known depth.
    """

    image: Tensor
    crop: Tensor
    nearest: Tensor
    linear: Tensor
    missing: Tensor
    size: tuple[int, int]
    low_m: float
    high_m: float


def prepare(inputs: DepthInput, sampling: DepthLabSampling, cell: int, crop_px: int) -> Prepared:
    """Inputs of the networks for an image; ``cell``: pixels per latent cell and side, ``crop_px``: side of CLIP's
    image.

    Raises:
        InputError: no depth is known.
    """
    height, width = inputs.rgb.shape[:2]
    size = tuple(max(1, side * sampling.processing_px // max(height, width)) for side in (height, width))
    depth = known_depth(np.where(inputs.sky, np.float32(np.nan), inputs.measured), size)
    known = np.isfinite(depth)
    if not known.any():
        raise InputError("no LiDAR return in the image", where="depth network", expected="at least one")
    low, high = float(depth[known].min()), float(depth[known].max())
    values = ((depth - low) / (high - low + 1e-6) - 0.5) * (2 * sampling.normalize_scale)
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
    where there is none.

    The published code picks single pixels instead, which loses most returns when an image shrinks.
    """
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
    """A DepthLab model ready for use; ``load`` makes one from a converted folder."""

    def __init__(
        self, parts: DepthLabParts, sampling: DepthLabSampling = PUBLISHED_SAMPLING, device: torch.device = CPU
    ) -> None:
        """Raises: UsageError: more steps than the noise schedule has."""
        most = int(parts.scheduler.config.num_train_timesteps)
        if sampling.steps > most:
            where, got = "--depth-steps", str(sampling.steps)
            raise UsageError("too many denoising steps", where=where, expected=f"<= {most}", got=got)
        self._parts, self._sampling, self._device = parts, sampling, device
        self._cell = 2 ** (len(parts.vae.config.block_out_channels) - 1)
        share_features(parts.reference_unet, parts.denoising_unet)

    @classmethod
    def load(cls, folder: str | Path, device: torch.device = CPU, steps: int = 0) -> DepthLab:
        """Read a folder that ``mudg convert`` wrote; ``steps`` of denoising, 0 = as the folder says.

        Raises:
            InputError: not such a folder, or not of this version. IntegrityError: a file is missing or altered.
            ResourceError: a package is missing. UsageError: too few steps.
        """
        file = Path(folder) / DESCRIPTION
        described = folders.read_settings(file)
        if described.get("kind") != KIND or described.get("schema") != SCHEMA:
            what = "not a DepthLab model of this version"
            got, remedy = f"{described.get('kind')}, {described.get('schema')}", "convert the published files again"
            raise InputError(what, where=str(file), expected=f"kind {KIND}, schema {SCHEMA}", got=got, remedy=remedy)
        sampling = records.parse_dataclass(DepthLabSampling, described.get("sampling"), f"{file}: sampling")
        sampling = dataclasses.replace(sampling, steps=steps or sampling.steps)
        return cls(read_parts(Path(folder), described, device), sampling, device)

    def __call__(self, inputs: DepthInput) -> Prediction:
        """Depth of one image at the image's size, near metres: it is to be aligned.

        Raises:
            InputError: no depth is known in the image.
        """
        made = prepare(inputs, self._sampling, self._cell, int(self._parts.image_encoder.config.image_size))
        shape = (1, self._parts.vae.config.latent_channels, *(side // self._cell for side in made.image.shape[2:]))
        noise = torch.randn(shape, generator=seeds.torch_generator(0, 0, "depthlab"))
        found = self.predict(made, noise) * (made.high_m - made.low_m) + made.low_m
        return Prediction.resized(found, inputs, "depth", least=0)

    def predict(self, prepared: Prepared, noise: Tensor) -> Tensor:
        """Depth f32[1, 1, h, w], 0..1 between least and greatest known (others go beyond), from noise [1, C, H, W]."""
        parts, sampling, device = self._parts, self._sampling, self._device
        noise = noise.to(device)
        with torch.inference_mode():
            planes = (prepared.nearest, prepared.linear, 2 * prepared.missing - 1, prepared.image)
            depth, known, mask, image = map(self._encoded, planes)
            # one pixel of every cell decides, as published
            missing = functional.interpolate(prepared.missing, size=noise.shape[2:], mode="nearest").to(device)
            embedding = parts.mapping_layer(parts.image_encoder(prepared.crop.to(device)).image_embeds[:, None])
            parts.reference_unet(image, torch.zeros((), dtype=torch.int64), encoder_hidden_states=embedding)
            parts.scheduler.set_timesteps(sampling.steps)
            times = parts.scheduler.timesteps[sampling.steps - int(sampling.steps * sampling.strength) :]
            latent = parts.scheduler.add_noise(depth, noise, times[:1]) if sampling.strength < 1 else noise
            for i, t in enumerate(times):
                seen = torch.cat([latent, mask, known], 1)
                output = parts.denoising_unet(seen, t, encoder_hidden_states=embedding, return_dict=False)[0]
                latent = parts.scheduler.step(output, t, latent).prev_sample
                if i + 1 < len(times):
                    as_known = parts.scheduler.add_noise(depth, noise, times[i + 1 : i + 2])
                    latent = missing * latent + (1 - missing) * as_known
            decoded = parts.vae.decode(latent / LATENT_SCALE, return_dict=False)[0]
        found = decoded.mean(1, keepdim=True)[..., : prepared.size[0], : prepared.size[1]]
        return (found / sampling.normalize_scale + 1) / 2

    def _encoded(self, plane: Tensor) -> Tensor:
        """Latent f32 of an image [1, 3, H, W], or of one channel thrice."""
        return self._parts.vae.encode(plane.expand(-1, 3, -1, -1).to(self._device)).latent_dist.mode() * LATENT_SCALE


# conversion ---------------------------------------------------------------------------------------
#
#     FOLDER/
#       DepthLab/                             denoising_unet.pth, reference_unet.pth, mapping_layer.pth
#       marigold-depth-v1-0/                  model_index.json, scheduler, vae, and of unet the description alone
#       CLIP-ViT-H-14-laion2B-s32B-b79K/      config.json, and model.safetensors or pytorch_model.bin
#
# Tensors are compared with the networks that the descriptions stand for, by name and shape, all of them before the
# first is written. The published code takes what the pickle of the denoising U-Net or of the linear layer lacks from
# Marigold or leaves it random; here that is an error.

PICKLES = {part: f"{part}.pth" for part in (*UNETS, "mapping_layer")}
"""Part -> the published file that holds it."""
LICENCE = (
    "Weights keep the terms of those who published them: DepthLab, Marigold (made from Stable Diffusion) and the CLIP"
    " image encoder. Read the pages they came from before any use."
)
_BASE, _ENCODER = "marigold-depth-v1-0", "CLIP-ViT-H-14-laion2B-s32B-b79K"
_ENCODER_PARTS = ("vision_model.", "visual_projection.")
_PLACES = "vision_model.embeddings.position_ids"
"""A table 0, 1, 2, ... that older files of CLIP hold."""
_MAPPING = "mapping_layer."


def weight_files(folder: Path) -> dict[str, Path]:
    """Part -> the published file, or folder, that holds its weights.

    Raises:
        InputError: something is missing.
    """
    files = {part: folder / "DepthLab" / name for part, name in PICKLES.items()}
    files["vae"] = folder / _BASE / "vae"
    encoder = [folder / _ENCODER / name for name in ("model.safetensors", "pytorch_model.bin")]
    files["image_encoder"] = next((file for file in encoder if file.is_file()), encoder[0])
    needed = (*files.values(), folder / _BASE / "unet" / "config.json", folder / _ENCODER / "config.json")
    missing = [file.relative_to(folder).as_posix() for file in needed if not file.exists()]
    if missing:
        remedy = "put the three folders into one under their own names, as DepthLab's page says, and give that folder"
        raise InputError("a part of DepthLab is missing", where=str(folder), got=", ".join(missing), remedy=remedy)
    return files


def source_files(folder: Path) -> list[Path]:
    """The weight files that are read. InputError: something is missing."""
    sources = weight_files(folder).values()
    return [file for one in sources for file in (sorted(one.glob("*.safetensors")) if one.is_dir() else [one])]


def described(folder: Path) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    """Configuration of every part, and the noise schedule.

    Raises:
        InputError: a description is missing or is of another kind.
    """
    unet, vae = (folders.read_settings(folder / _BASE / name / "config.json") for name in ("unet", "vae"))
    told = folders.read_settings(folder / _ENCODER / "config.json")
    vision = told
    if told.get("model_type") == "clip":
        vision = {**(told.get("vision_config") or {})}
        if "projection_dim" in told:  # the whole model's number counts: old descriptions repeat a default inside
            vision["projection_dim"] = told["projection_dim"]
    vision_class = folders.member(folders.package("transformers"), "CLIPVisionConfig")
    with records.understood("the description of an image encoder", str(folder / _ENCODER / "config.json")):
        vision = vision_class.from_dict(vision).to_dict()
    file = folder / _BASE / "scheduler" / "scheduler_config.json"
    schedule = folders.read_settings(file)
    ddim_scheduler(schedule, str(file))
    if schedule.get("rescale_betas_zero_snr"):
        what = "this is the noise schedule of a later Marigold"
        expected, remedy = f"that of {_BASE}, which DepthLab was made from", f"take {_BASE}"
        raise InputError(what, where=str(file), got="rescale_betas_zero_snr: true", expected=expected, remedy=remedy)
    return part_configs(unet, vae, vision), schedule


def read(folder: Path, configs: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Tensor]]:
    """The tensors of every part, checked.

    Raises:
        InputError: a file cannot be read, or does not hold what its network needs.
    """
    files = weight_files(folder)
    found = {part: dict(weights.read_checkpoint(file)) for part, file in files.items() if part != "vae"}
    found["mapping_layer"] = {name.removeprefix(_MAPPING): value for name, value in found["mapping_layer"].items()}
    encoder = found["image_encoder"]
    found["image_encoder"] = {n: x for n, x in encoder.items() if n.startswith(_ENCODER_PARTS) and n != _PLACES}
    autoencoder = folders.member(folders.package("diffusers"), "AutoencoderKL")
    found["vae"] = dict(folders.load_network(autoencoder, folder / _BASE, subfolder="vae").state_dict())
    for part, network in blank_parts(configs).items():
        weights.match_exactly(found[part], weights.shapes_of(network), str(files[part]), f"DepthLab's {part}")
        weights.refuse_bad_values(found[part], str(files[part]))
    return found


def convert_folder(folder: Path, to: Path, dtype: torch.dtype | None, shard_bytes: int) -> None:
    """The conversion, in this process; ``to`` is complete or not there.

    Args:
        folder: what holds the sources. dtype: number format of the weights (None: as published). shard_bytes: of one
            file.

    Raises:
        InputError: something is missing or is not DepthLab. ResourceError: a package is missing, or the disk is full.
    """
    files = source_files(folder)
    configs, schedule = described(folder)
    found = read(folder, configs)
    sources = [
        {"file": f.relative_to(folder).as_posix(), "bytes": f.stat().st_size, "sha256": store.sha256_file(f)}
        for f in files
    ]
    rows = "".join(f"| {source['file']} | {source['bytes']} | {source['sha256']} |\n" for source in sources)
    card = (
        "# DepthLab: depth inpainting, for `mudg annotate --depth-network`\n\n"
        f"Converted from:\n\n| file | bytes | SHA-256 |\n|---|---|---|\n{rows}\n## Licence\n\n{LICENCE}\n"
    )
    with store.atomic_directory(to) as partial:
        parts: dict[str, Any] = {part: {"config": configs[part]} for part in PARTS}
        for part, described_part in parts.items():
            described_part["files"] = checkpoint.write_shards(partial / part, found[part], shard_bytes, dtype)
        store.write_text(partial / "MODEL_CARD.md", card)
        description = {"schema": SCHEMA, "kind": KIND, "parts": parts, "scheduler": schedule}
        description |= {"sampling": asdict(PUBLISHED_SAMPLING), "facts": {"sources": sources, "licence": LICENCE}}
        store.write_json(partial / DESCRIPTION, description)
        store.sync_tree(partial)
