"""DepthLab at its published sizes: tensors and parameters of every part, counted on the meta device; or a stand-in of
the files.

    python bench/depthlab_size.py                    # prints the table
    python bench/depthlab_size.py --write FOLDER     # made-up values in half precision, 4.6 GB: something to rehearse
                                                     `mudg convert` with

Needs the extra ``models``. The sizes are those of Stable Diffusion 2 (Marigold v1-0) and CLIP ViT-H/14.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import torch
from safetensors.torch import save_file

from mudg.labels import depthlab

UNET = {
    "_class_name": "UNet2DConditionModel",
    "in_channels": 8,
    "out_channels": 4,
    "block_out_channels": [320, 640, 1280, 1280],
    "attention_head_dim": [5, 10, 20, 20],
    "cross_attention_dim": 1024,
    "use_linear_projection": True,
    "layers_per_block": 2,
}
VAE = {
    "_class_name": "AutoencoderKL",
    "block_out_channels": [128, 256, 512, 512],
    "layers_per_block": 2,
    "latent_channels": 4,
    "down_block_types": ["DownEncoderBlock2D"] * 4,
    "up_block_types": ["UpDecoderBlock2D"] * 4,
    "scaling_factor": 0.18215,
}
VISION = {
    "hidden_size": 1280,
    "intermediate_size": 5120,
    "num_hidden_layers": 32,
    "num_attention_heads": 16,
    "image_size": 224,
    "patch_size": 14,
    "hidden_act": "gelu",
    "projection_dim": 512,
}
SCHEDULE = {
    "_class_name": "DDIMScheduler",
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "clip_sample": False,
    "set_alpha_to_one": False,
    "steps_offset": 1,
    "prediction_type": "v_prediction",
}


def main() -> None:
    """Print the table, or write the stand-in."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", type=Path, help="folder for the stand-in")
    folder = parser.parse_args().write
    configs = depthlab.part_configs(UNET, VAE, {**VISION, "projection_dim": 1024})
    made = depthlab.blank_parts(configs)
    sys.stdout.write("| part | tensors | parameters, millions |\n|---|---|---|\n")
    for name, network in made.items():
        shapes = depthlab.shapes_of(network)
        sys.stdout.write(
            f"| {name} | {len(shapes)} | {sum(torch.Size(s).numel() for s in shapes.values()) / 1e6:.1f} |\n"
        )
    if folder is None:
        return
    texts = {
        "marigold-depth-v1-0/model_index.json": {"_class_name": "MarigoldPipeline"},
        "marigold-depth-v1-0/unet/config.json": UNET,
        "marigold-depth-v1-0/vae/config.json": VAE,
        "marigold-depth-v1-0/scheduler/scheduler_config.json": SCHEDULE,
        "CLIP-ViT-H-14-laion2B-s32B-b79K/config.json": {
            "model_type": "clip",
            "projection_dim": 1024,
            "vision_config": {**VISION, "model_type": "clip_vision_model"},
        },
    }
    for name, content in texts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(json.dumps(content))
    (folder / "DepthLab").mkdir()
    generator = torch.Generator().manual_seed(0)
    for name, network in made.items():
        prefix = "mapping_layer." if name == "mapping_layer" else ""
        state = {
            prefix + key: (torch.randn(shape, generator=generator) * 0.02).half()
            for key, shape in depthlab.shapes_of(network).items()
        }
        if name == "vae":
            save_file(state, folder / "marigold-depth-v1-0/vae/diffusion_pytorch_model.safetensors")
        elif name == "image_encoder":
            save_file(state, folder / "CLIP-ViT-H-14-laion2B-s32B-b79K/model.safetensors")
        else:
            torch.save(state, folder / "DepthLab" / f"{name}.pth")


if __name__ == "__main__":
    main()
