"""Tiny random networks: of transformers and diffusers, saved as those packages save the real ones (without the
packages: skip); and settings of a small diffusion model."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from mudg.diffusion import model_files
from mudg.diffusion.model import MDM, MDMConfig
from mudg.networks.codec import CodecConfig

NAMES = {0: "Road", 1: "traffic light", 2: "sky", 3: "unicorn"}
LABELS = {"id2label": NAMES, "label2id": {name: number for number, name in NAMES.items()}}


def small_mdm(**changes: Any) -> MDMConfig:
    """Settings of a diffusion model that is made in a moment."""
    size = {"widths": (16, 32), "blocks": (1, 1), "refine_widths": (8, 16), "refine_blocks": (1, 1), "embed_width": 16}
    attention = {"spatial_attention": (False, True), "temporal_attention": (False, True)}
    codec = CodecConfig(decoder_width=8, decoder_blocks=1)
    return MDMConfig(**{**size, **attention, "codec": codec, "patch": 2, "window": 4, "area_px": 24576, **changes})


TINY = small_mdm(widths=(16, 24), head_width=8, patch=1, window=8)
PLAIN = replace(TINY, refine_widths=(), refine_blocks=())
FINISHING = replace(TINY, renders=True, finish_widths=(8, 16), finish_blocks=(1, 1))


def randomise(values: Iterable[torch.Tensor], seed: int = 0, gain: float = 0.5, bias: float = 0.1) -> None:
    """Fill weights and biases with random numbers, so that every path matters."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for value in values:
            scale = gain / value[0].numel() ** 0.5 if value.ndim > 1 else bias
            value.copy_(torch.randn(value.shape, generator=generator) * scale)


def learn_part(model: MDM) -> list[torch.nn.Parameter]:
    """Parameters that training changes after the codec."""
    return [p for n, p in model.named_parameters() if not n.startswith("codec.")]


def randomised(config: MDMConfig) -> MDM:
    """A model whose zero-initialised layers are random too."""
    model = MDM(config).eval()
    randomise(learn_part(model))
    return model


def saved_mdm(folder: Path, **changes: Any) -> Path:
    """Folder of a small diffusion model that uses renders, with windows of 8 frames."""
    torch.manual_seed(0)
    model_files.save(MDM(small_mdm(**{"window": 8, "renders": True, **changes})), folder, "a model of tests", {})
    return folder


def package(name: str) -> Any:
    """A package of the extra ``models``, or a skip that says what is missing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = pytest.importorskip(name, reason=f"{name} is not installed (extra models)")
    found.utils.logging.disable_progress_bar()
    return found


def seeded(network: torch.nn.Module, seed: int = 0, gain: float = 1.0) -> torch.nn.Module:
    """The network with weights that depend on the seed alone; biases too, so that no output is constant."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, value in network.named_parameters():
            if value.ndim > 1:
                value.copy_(gain * torch.randn(value.shape, generator=generator) / value[0].numel() ** 0.5)
            elif "norm" not in name:
                value.copy_(0.1 * torch.randn(value.shape, generator=generator))
    return network.eval()


def segformer(folder: Path) -> Any:
    """SegFormer of 24 thousand parameters."""
    t = package("transformers")
    size = {"depths": [1] * 4, "hidden_sizes": [8, 8, 16, 16], "num_attention_heads": [1, 1, 2, 2]}
    config = t.SegformerConfig(**size, decoder_hidden_size=16, **LABELS)
    return _saved(seeded(t.SegformerForSemanticSegmentation(config)), folder)


def mask2former(folder: Path) -> Any:
    """Mask2Former on a Swin backbone."""
    t = package("transformers")
    stages, tower = [f"stage{number}" for number in range(1, 5)], {"depths": [1] * 4, "num_heads": [1, 1, 2, 2]}
    swin = t.SwinConfig(image_size=64, embed_dim=8, **tower, window_size=4, out_features=stages)
    names = ("feature_size", "mask_feature_size", "hidden_dim", "encoder_feedforward_dim", "dim_feedforward")
    size = {**dict.fromkeys(names, 32), "encoder_layers": 1, "decoder_layers": 2, "num_attention_heads": 2}
    config = t.Mask2FormerConfig(backbone_config=swin, **size, num_queries=6, **LABELS)
    return _saved(seeded(t.Mask2FormerForUniversalSegmentation(config)), folder)


def depth_anything(folder: Path, *, with_lidar: bool = False, metric: bool = False) -> Any:
    """Depth Anything or PromptDepthAnything on a DINOv2 backbone, for images whose shorter side is 42 px."""
    t = package("transformers")
    tower = {"hidden_size": 16, "num_hidden_layers": 4, "num_attention_heads": 2, "intermediate_size": 16}
    outputs = {"out_indices": [1, 2, 3, 4], "reshape_hidden_states": False, "apply_layernorm": True}
    backbone = t.Dinov2Config(**tower, image_size=42, patch_size=14, **outputs)
    config_class = t.PromptDepthAnythingConfig if with_lidar else t.DepthAnythingConfig
    neck = {"reassemble_hidden_size": 16, "neck_hidden_sizes": [8] * 4, "fusion_hidden_size": 8, "head_hidden_size": 8}
    kind = "metric" if metric or with_lidar else "relative"
    limits = {"depth_estimation_type": kind, "max_depth": 80 if metric else 1}
    config = config_class(backbone_config=backbone, patch_size=14, **neck, **limits)
    network_class = t.PromptDepthAnythingForDepthEstimation if with_lidar else t.DepthAnythingForDepthEstimation
    network = _saved(seeded(network_class(config), gain=1.5), folder)
    steps = {f"do_{name}": name != "pad" for name in ("resize", "rescale", "normalize", "pad")}
    described = {"size": {"height": 42, "width": 42}, "keep_aspect_ratio": True, "ensure_multiple_of": 14, **steps}
    described |= {"resample": 3, "rescale_factor": 1 / 255}
    described |= {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
    (folder / "preprocessor_config.json").write_text(json.dumps(described))
    return network


def _marigold(folder: Path) -> tuple[Any, Any]:
    """What DepthLab reads of a Marigold folder; its U-Net and autoencoder, with latents of half the size."""
    d = package("diffusers")
    size = {"block_out_channels": (8, 16), "layers_per_block": 1, "norm_num_groups": 4}
    down, up = ("DownBlock2D", "CrossAttnDownBlock2D"), ("CrossAttnUpBlock2D", "UpBlock2D")
    width = {"in_channels": 8, "out_channels": 4, "cross_attention_dim": 8, "attention_head_dim": 4, **size}
    unet = d.UNet2DConditionModel(**width, down_block_types=down, up_block_types=up)
    down, up = ("DownEncoderBlock2D",) * 2, ("UpDecoderBlock2D",) * 2
    vae = d.AutoencoderKL(**size, latent_channels=4, down_block_types=down, up_block_types=up)
    betas = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}
    steps = {"steps_offset": 1, "prediction_type": "v_prediction", "timestep_spacing": "trailing"}
    scheduler = d.DDIMScheduler(**betas, clip_sample=False, set_alpha_to_one=False, **steps)
    for seed, (name, network) in enumerate({"unet": unet, "vae": vae}.items()):
        seeded(network, seed).save_pretrained(folder / name)
    scheduler.save_pretrained(folder / "scheduler")
    (folder / "model_index.json").write_text(json.dumps({"_class_name": "MarigoldPipeline"}))
    return unet, vae


def depthlab(folder: Path) -> dict[str, Any]:
    """DepthLab's files as they are published, around a Marigold and a CLIP of vectors of six numbers; the networks."""
    t, d = package("transformers"), package("diffusers")
    unet, vae = _marigold(folder / "marigold-depth-v1-0")
    config = {name: value for name, value in unet.config.items() if not name.startswith("_")}
    tower = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2}
    words = {"vocab_size": 8, "max_position_embeddings": 8, "bos_token_id": 6, "eos_token_id": 7}
    parts = {"text_config": {**tower, **words}, "vision_config": {**tower, "image_size": 28, "patch_size": 14}}
    clip = t.CLIPModel(t.CLIPConfig(**parts, projection_dim=6))
    seeded(clip, 8)
    made = {
        "denoising_unet": seeded(d.UNet2DConditionModel(**{**config, "in_channels": 12}), 5),
        "reference_unet": seeded(d.UNet2DConditionModel(**{**config, "in_channels": 4}), 6),
        "mapping_layer": seeded(torch.nn.Linear(6, 8), 7),
        "vae": vae,
        "clip": _saved(clip, folder / "CLIP-ViT-H-14-laion2B-s32B-b79K"),
    }
    (folder / "DepthLab").mkdir()
    for name, prefix in (("denoising_unet", ""), ("reference_unet", ""), ("mapping_layer", "mapping_layer.")):
        state = {
            f"{prefix}{key}": value
            for key, value in made[name].state_dict().items()
            if name != "reference_unet" or not key.startswith(("conv_norm_out", "conv_out"))
        }
        torch.save(state, folder / "DepthLab" / f"{name}.pth")
    return made


def _saved(network: Any, folder: Path) -> Any:
    folder.mkdir(parents=True, exist_ok=True)
    network.save_pretrained(str(folder))
    return network


def hide(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """As if a package were not installed."""
    monkeypatch.setitem(sys.modules, name, None)
