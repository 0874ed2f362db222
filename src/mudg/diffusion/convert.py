"""convert: a published checkpoint -> a model folder that `synthesize` and training read.

The checkpoint is a pickle from elsewhere: it is opened in a process of its own, under a memory limit, by torch's
restricted unpickler.
"""

from __future__ import annotations

import contextlib
import functools
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mudg.base import log, processes, store, weights
from mudg.base.errors import InputError, UsageError
from mudg.base.run_folder import Replacement, all_names, refuse_overlap
from mudg.diffusion import model_files
from mudg.diffusion.published import SCALE_ENTRIES, PublishedConfig, PublishedMDM
from mudg.diffusion.settings import ConvertConfig
from mudg.networks import clip
from mudg.networks.clip import TextTower

_UNET = "model.diffusion_model."
_ENTER = _UNET + "input_blocks.0.0.weight"
DTYPES = {"keep": None, "float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}
LICENCE = (
    "Weights keep the terms of those who published them; read the page they came from before any use. The code of MuDG"
    " and of DynamiCrafter is Apache-2.0; the data they were trained on have licences of their own (the Waymo Open"
    " Dataset is for non-commercial use)."
)


Work = Callable[[], None]
Conversion = Callable[[Path], tuple[Work, int]]
"""A folder to write -> what writes a model there, and the address space that it may take."""


def run(config: ConvertConfig, checkpoint: Path, to: Path, conversion: Conversion, *, overwrite: bool = False) -> Path:
    """Convert one checkpoint; returns `to`, which is complete or not there. config: see `ConvertConfig`. checkpoint: a
    .ckpt, .pt or .safetensors file; or the folder around DepthLab's files. to: folder of the model; replaced only with
    `overwrite`. conversion: of this kind of checkpoint. UsageError: the folder exists, or the resolution is not known.
    InputError: not such a checkpoint; nothing is written. ResourceError: memory limit or disk."""
    checkpoint, to = Path(checkpoint), Path(to)
    refuse_overlap(to, {"checkpoint": checkpoint})
    replacement = Replacement(to)
    replacement.recover(lambda folder: bool(own_names(folder)), own_names)
    replaces = to.exists()
    if replaces and not overwrite:
        raise UsageError("the folder exists", where=str(to), remedy="choose another --to, or add --overwrite")
    if replaces and not own_names(to):
        raise UsageError(
            "the folder holds files that do not belong to a model", where=str(to), remedy="choose another --to"
        )
    place = replacement.staging if replaces else to  # until it is whole, the old model stays as it is
    work, limit = conversion(place)
    if replaces:
        replacement.begin()
    try:
        with log.task("convert", 1) as bar:
            peak = processes.run_limited(work, limit, checkpoint)
            bar.advance()
        if replaces:
            replacement.swap(own_names)
    finally:
        with contextlib.suppress(OSError):  # there and empty only if converting failed
            replacement.staging.rmdir()
    memory = f"; peak memory {peak / processes.GIB:.1f} GiB, pages of the mapped file included" if peak else ""
    log.info(f"convert: {to} is complete{memory}")
    return to


def own_names(folder: Path) -> list[str]:
    """Names of the files of a model folder that this program wrote, its description last; none of any other."""
    try:
        content = store.read_json(folder / "model.json")
        files = list(content["files"]) if "files" in content else []
        files += [f"{part}/{name}" for part, entry in content.get("parts", {}).items() for name in entry["files"]]
        there = set(all_names(folder))
        return [name for name in (*files, "MODEL_CARD.md", "model.json") if name in there] if files else []
    except (InputError, KeyError, TypeError, AttributeError):
        return []


def of_diffusion(
    config: ConvertConfig, checkpoint: Path, to: Path, network: PublishedConfig | None = None
) -> tuple[Work, int]:
    """The conversion of a diffusion model, and the address space it may take. network: sizes of the network the
    checkpoint should hold (None: the published ones)."""
    if not checkpoint.is_file():
        raise InputError("no such checkpoint", where=str(checkpoint))
    height, width = resolution(config, checkpoint)
    network = replace(network or PublishedConfig(), height=height, width=width)
    return functools.partial(convert_file, config, checkpoint, to, network), memory_limit(config, checkpoint)


def resolution(config: ConvertConfig, checkpoint: Path) -> tuple[int, int]:
    """Height and width that the checkpoint was trained at: as configured, else from the file's name."""
    if config.resolution != "auto":
        height, width = config.resolution.split("x")
        return int(height), int(width)
    for part in (checkpoint.name, checkpoint.parent.name):
        for mark, size in (("1024", (576, 1024)), ("512", (320, 512))):
            if mark in part:
                return size
    what = "the training resolution is not in the file's name"
    remedy = "add --resolution 320x512 or --resolution 576x1024"
    raise UsageError(what, where=str(checkpoint), expected="512 or 1024 in the name", remedy=remedy)


def memory_limit(config: ConvertConfig, *files: Path) -> int:
    """Address space in bytes that conversion may add to what a process with torch has. The files, mapped (or read, and
    then copied once, where their format cannot be mapped), twice the largest weight file written, 3 GiB for working."""
    if config.memory_gb:
        return int(config.memory_gb * 1e9)
    read = sum(path.stat().st_size * (1 if zipfile.is_zipfile(path) else 2) for path in files)
    return read + 2 * model_files.SHARD_BYTES + 3 * processes.GIB


def convert_file(config: ConvertConfig, checkpoint: Path, to: Path, network: PublishedConfig) -> None:
    """The conversion itself, in this process (see `run` for errors)."""
    found, adapted = widen(weights.read_checkpoint(checkpoint))
    tensors = weights.match(found, wanted_shapes(network), str(checkpoint))
    _check_values(found, tensors, checkpoint)
    base_scale = float(tensors["scale"][-1])
    network = replace(network, schedule=replace(network.schedule, base_scale=base_scale))
    text = {name.removeprefix("text."): tensors.pop(name) for name in list(tensors) if name.startswith("text.")}
    tensors["text"] = embed_captions(network, text)
    facts = {
        "source": {
            "file": checkpoint.name,
            "bytes": checkpoint.stat().st_size,
            "sha256": store.sha256_file(checkpoint),
        },
        "adapted": adapted,
        "base_scale": base_scale,
        "caption": clip.CAPTION,
        "licence": LICENCE,
    }
    model_files.save_published(to, network, tensors, facts, _card(network, facts), DTYPES[config.dtype])


def widen(state: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], str]:
    """A checkpoint with 8 input channels made one with 12 and a modality label; others unchanged. Also says what was
    done. The condition's four input channels are used twice, for colour and for depth, and the whole kernel, noise
    channels included, is halved; the label's embedding starts as a copy of that of the noise step. Both as in the
    published training."""
    tensors = dict(state)
    kernel = tensors.get(_ENTER)
    if kernel is None or kernel.ndim != 4 or kernel.shape[1] % 2 or any(".class_embed." in name for name in tensors):
        return tensors, ""
    latent = kernel.shape[1] // 2
    tensors[_ENTER] = torch.cat([kernel, kernel[:, latent:]], 1) * 0.5
    for name in list(tensors):
        if name.startswith(_UNET + "time_embed."):
            tensors[name.replace(".time_embed.", ".class_embed.")] = tensors[name].clone()
    done = f"{2 * latent} input channels widened to {3 * latent}, label embedding copied from that of the noise step"
    return tensors, done + "; not trained since"


def wanted_shapes(network: PublishedConfig) -> dict[str, tuple[int, ...]]:
    """Our name -> shape of everything that a checkpoint must hold: the model, the text tower, the table of the dynamic
    rescale."""
    with torch.device("meta"):
        model, tower = PublishedMDM(network), TextTower(network.text, network.vocabulary)
    shapes = {name: tuple(value.shape) for name, value in model.state_dict().items() if name != "text"}
    shapes |= {f"text.{name}": tuple(value.shape) for name, value in tower.state_dict().items()}
    return shapes | {"scale": (SCALE_ENTRIES,)}


def _check_values(state: Mapping[str, Tensor], tensors: Mapping[str, Tensor], where: Path) -> None:
    """InputError for values that no such model has: not finite, a schedule that keeps signal, a rescale outside (0,
    1]."""
    weights.refuse_bad_values(tensors, str(where))
    scale, alpha_bar = tensors["scale"].float(), state.get("alphas_cumprod")
    if float(scale.min()) <= 0 or float(scale.max()) > 1 + 1e-6:
        what, got = "the dynamic rescale table is out of range", f"{float(scale.min())} .. {float(scale.max())}"
        raise InputError(what, where=f"{where}: scale_arr", expected="0 < value <= 1", got=got)
    if alpha_bar is not None and abs(float(alpha_bar.flatten()[-1])) > 1e-6:
        what = "the checkpoint's noise schedule keeps signal at its last step"
        remedy = "take a MuDG or DynamiCrafter checkpoint; this is another model"
        got = str(float(alpha_bar.flatten()[-1]))
        raise InputError(what, where=f"{where}: alphas_cumprod[-1]", expected="0", got=got, remedy=remedy)


@torch.no_grad()
def embed_captions(network: PublishedConfig, tower_weights: Mapping[str, Tensor]) -> Tensor:
    """Token vectors f32[2,77,D] of the published caption and of the empty one, by the checkpoint's own text tower."""
    with torch.device("meta"):
        tower = TextTower(network.text, network.vocabulary)
    tower.load_state_dict({n: t if n == "tokens.weight" else t.float() for n, t in tower_weights.items()}, assign=True)
    ids = torch.stack([clip.padded_tokens(clip.CAPTION_IDS), clip.padded_tokens(clip.EMPTY_IDS)])
    tower.tokens = torch.nn.Embedding.from_pretrained(tower.tokens.weight[ids.flatten()].float())
    return tower.eval()(torch.arange(ids.numel()).view_as(ids)).float()


def _card(network: PublishedConfig, facts: Mapping[str, Any]) -> str:
    adapted = facts["adapted"] or "nothing"
    return (
        f"# Diffusion model converted from {facts['source']['file']}\n\nTrained at {network.width}x{network.height},"
        f" {network.window} frames. SHA-256 of the source: {facts['source']['sha256']}.\nAdapted: {adapted}. Dynamic"
        f" rescale down to {facts['base_scale']:g}, as the checkpoint says.\n\n## Licence\n\n{facts['licence']}\n"
    )
