"""convert, of DepthLab: three published pickles, Marigold's folder and CLIP's -> one folder that ``annotate --depth-network`` reads.

    FOLDER/
      DepthLab/                denoising_unet.pth, reference_unet.pth, mapping_layer.pth
      marigold-depth-v1-0/     model_index.json, scheduler, vae, and of unet the description alone
      CLIP-ViT-H-14-.../       config.json, and model.safetensors or pytorch_model.bin

The three are recognised by what lies in them, not by their names. Tensors are compared with the networks that the descriptions stand
for, by name and shape, all of them before the first is written. The published code takes what the pickle of the denoising U-Net or of
the linear layer lacks from Marigold or leaves it random; here that is an error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mudg.base import shards, store
from mudg.base.errors import InputError
from mudg.data import weights
from mudg.models import folders
from mudg.models.depth import depthlab, marigold
from mudg.models.depth.depthlab import PARTS, UNETS

PICKLES = {part: f"{part}.pth" for part in (*UNETS, "mapping_layer")}
"""Part -> the published file that holds it."""
LICENCE = (
    "Weights keep the terms of those who published them: DepthLab, Marigold (made from Stable Diffusion) and the CLIP image encoder. "
    "Read the pages they came from before any use."
)
_ENCODER_FILES = ("model.safetensors", "pytorch_model.bin")
_ENCODER = ("vision_model.", "visual_projection.")
_PLACES = "vision_model.embeddings.position_ids"
"""A table 0, 1, 2, ... that older files of CLIP hold."""
_MAPPING = "mapping_layer."


@dataclass(frozen=True, slots=True)
class Sources:
    """The folders that a DepthLab model is made of: the three pickles, Marigold, the image encoder."""

    pickles: Path
    base: Path
    encoder: Path

    def files(self) -> list[Path]:
        """The weight files that are read."""
        autoencoder = sorted((self.base / "vae").glob("*.safetensors"))
        return [*(self.pickles / name for name in PICKLES.values()), *autoencoder, self.encoder_file()]

    def encoder_file(self) -> Path:
        """The image encoder's weight file; InputError if there is none."""
        for name in _ENCODER_FILES:
            if (self.encoder / name).is_file():
                return self.encoder / name
        raise InputError("the image encoder has no weight file", where=str(self.encoder),
            expected=" or ".join(_ENCODER_FILES))  # fmt: skip


def find(folder: Path) -> Sources:
    """What is needed, in a folder or directly below it.

    Raises:
        InputError: something is missing, or there twice.
    """
    places = [folder, *sorted(place for place in folder.iterdir() if place.is_dir())]
    pickles = _only(
        folder, [place for place in places if any((place / name).is_file() for name in PICKLES.values())],
        f"the published files {', '.join(PICKLES.values())}",
    )  # fmt: skip
    for name in PICKLES.values():
        if not (pickles / name).is_file():
            raise InputError("a published file is missing", where=str(pickles), expected=name)
    marigolds = ("MarigoldPipeline", "MarigoldDepthPipeline")
    base = _only(
        folder, [place for place in places if _json_value(place / "model_index.json", "_class_name") in marigolds],
        "marigold-depth-v1-0, a folder of diffusers",
    )  # fmt: skip
    encoder = _only(
        folder, [place for place in places if _json_value(place / "config.json", "model_type") in ("clip", "clip_vision_model")],
        "CLIP-ViT-H-14-laion2B-s32B-b79K, a folder of transformers",
    )  # fmt: skip
    return Sources(pickles, base, encoder)


def _only(folder: Path, found: list[Path], what: str) -> Path:
    if len(found) != 1:
        raise InputError(
            "a part of DepthLab is missing" if not found else "a part of DepthLab was found more than once", where=str(folder),
            expected=f"one folder with {what}", got=", ".join(place.name for place in found) or "none",
            remedy="put the three folders into one, as DepthLab's page says, and give that folder",
        )  # fmt: skip
    return found[0]


def _json_value(file: Path, key: str) -> object:
    return folders.read_settings(file).get(key) if file.is_file() else None


def described(sources: Sources) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    """Configuration of every part, and the noise schedule.

    Raises:
        InputError: a description is missing or is of another kind.
    """
    unet, vae = (folders.read_settings(sources.base / name / "config.json") for name in ("unet", "vae"))
    clip = folders.read_settings(sources.encoder / "config.json")
    vision = clip
    if clip.get("model_type") == "clip":
        vision = {**(clip.get("vision_config") or {})}
        if "projection_dim" in clip:  # the whole model's number counts: old descriptions repeat a default inside
            vision["projection_dim"] = clip["projection_dim"]
    transformers = folders.package("transformers")
    try:
        vision_config = folders.member(transformers, "CLIPVisionConfig").from_dict(vision).to_dict()
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError("the image encoder has no description", where=str(sources.encoder / "config.json"),
                         got=str(error)[:300]) from error  # fmt: skip
    file = sources.base / marigold.SCHEDULE_FILE
    schedule = folders.read_settings(file)
    marigold.ddim_scheduler(schedule, str(file))
    if schedule.get("rescale_betas_zero_snr"):
        raise InputError("this is the noise schedule of a later Marigold", where=str(file),
            got="rescale_betas_zero_snr: true", expected="that of marigold-depth-v1-0, which DepthLab was made from",
            remedy="take marigold-depth-v1-0")  # fmt: skip
    return depthlab.part_configs(unet, vae, vision_config), schedule


def read(sources: Sources, configs: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Tensor]]:
    """The tensors of every part, checked.

    Raises:
        InputError: a file cannot be read, or does not hold what its network needs.
    """
    found = {part: weights.read_checkpoint(sources.pickles / PICKLES[part]) for part in UNETS}
    mapping = weights.read_checkpoint(sources.pickles / PICKLES["mapping_layer"])
    found["mapping_layer"] = {name.removeprefix(_MAPPING): value for name, value in mapping.items()}
    autoencoder = folders.member(folders.package("diffusers"), "AutoencoderKL")
    found["vae"] = dict(folders.load_network(autoencoder, sources.base, subfolder="vae").state_dict())
    encoder = weights.read_checkpoint(sources.encoder_file())
    found["image_encoder"] = {
        name: value for name, value in encoder.items() if name.startswith(_ENCODER) and name != _PLACES
    }
    files = {**{part: sources.pickles / name for part, name in PICKLES.items()}, "vae": sources.base / "vae",
             "image_encoder": sources.encoder_file()}  # fmt: skip
    for part, network in depthlab.blank_parts(configs).items():
        weights.match_exactly(found[part], depthlab.shapes_of(network), str(files[part]), f"DepthLab's {part}")
        weights.refuse_bad_values(found[part], str(files[part]))
    return found


def convert_folder(folder: Path, to: Path, dtype: torch.dtype | None, shard_bytes: int) -> None:
    """The conversion, in this process; ``to`` is complete or not there.

    Args:
        folder: what holds the sources. dtype: number format of the weights (None: as published). shard_bytes: of one file.

    Raises:
        InputError: something is missing or is not DepthLab. ResourceError: a package is missing, or the disk is full.
    """
    sources = find(folder)
    configs, schedule = described(sources)
    found = read(sources, configs)
    facts = {
        "sources": [
            {"file": path.relative_to(folder).as_posix(), "bytes": path.stat().st_size, "sha256": store.sha256_file(path)}
            for path in sources.files()
        ],
        "licence": LICENCE,
    }  # fmt: skip
    with store.atomic_directory(to) as partial:
        parts = {
            part: {"config": configs[part], "files": shards.write_shards(partial / part, found[part], shard_bytes, dtype)}
            for part in PARTS
        }  # fmt: skip
        store.write_text(partial / "MODEL_CARD.md", _card(facts))
        description = {
            "schema": depthlab.SCHEMA, "kind": depthlab.KIND, "parts": parts, "scheduler": schedule,
            "sampling": asdict(depthlab.PUBLISHED_SAMPLING), "facts": facts,
        }  # fmt: skip
        store.write_json(partial / depthlab.DESCRIPTION, description)
        store.sync_tree(partial)


def _card(facts: Mapping[str, Any]) -> str:
    rows = "".join(f"| {source['file']} | {source['bytes']} | {source['sha256']} |\n" for source in facts["sources"])
    return (
        "# DepthLab: depth inpainting, for `mudg annotate --depth-network`\n\n"
        f"Converted from:\n\n| file | bytes | SHA-256 |\n|---|---|---|\n{rows}\n## Licence\n\n{facts['licence']}\n"
    )
