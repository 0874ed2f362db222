"""Made-up weights under the names of CLIP, small, for tests: no published numbers, but every part takes part."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from mudg.networks import clip as clip_image


def drawn(shapes: Mapping[str, tuple[int, ...]], seed: int) -> dict[str, torch.Tensor]:
    """Values that keep activations at about their size."""
    generator = torch.Generator().manual_seed(seed)
    made = {}
    for name, shape in shapes.items():
        noise = torch.randn(shape, generator=generator)
        if len(shape) > 1 and name.endswith(("weight", "proj")):
            noise *= (1.0 / noise[0].numel()) ** 0.5
        elif name.endswith("weight"):
            noise = 1 + 0.2 * noise
        else:
            noise *= 0.2
        made[name] = noise
    return made


def clip_state(
    seed: int = 0, width: int = 128, blocks: int = 2, patch: int = 14, side: int = 42
) -> dict[str, torch.Tensor]:
    """All tensors of a small image tower under OpenAI's names."""
    return drawn(clip_image.tensor_shapes(width, blocks, patch, (side // patch) ** 2, 32), seed)


def transformers_names(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The same tower as the transformers package stores it, with parts that are not read."""
    found = {"logit_scale": torch.ones(()), "text_model.final_layer_norm.weight": torch.ones(4)}
    fixed = {
        "visual.class_embedding": "embeddings.class_embedding",
        "visual.positional_embedding": "embeddings.position_embedding.weight",
        "visual.conv1.weight": "embeddings.patch_embedding.weight",
        "visual.ln_pre.weight": "pre_layrnorm.weight",
        "visual.ln_pre.bias": "pre_layrnorm.bias",
        "visual.ln_post.weight": "post_layernorm.weight",
        "visual.ln_post.bias": "post_layernorm.bias",
    }
    leaves = {"ln_1": "layer_norm1", "ln_2": "layer_norm2", "attn.out_proj": "self_attn.out_proj"}
    leaves |= {"mlp.c_fc": "mlp.fc1", "mlp.c_proj": "mlp.fc2"}
    for name, value in state.items():
        if name == "visual.proj":
            found["visual_projection.weight"] = value.T
        elif name in fixed:
            found[f"vision_model.{fixed[name]}"] = value
        else:
            _, _, _, number, rest = name.split(".", 4)
            block = f"vision_model.encoder.layers.{number}"
            if rest.startswith("attn.in_proj_"):
                for part, rows in zip("qkv", value.chunk(3), strict=True):
                    found[f"{block}.self_attn.{part}_proj.{rest.removeprefix('attn.in_proj_')}"] = rows
            else:
                leaf, kind = rest.rsplit(".", 1)
                found[f"{block}.{leaves[leaf]}.{kind}"] = value
    return found
