"""A tiny network of the published kind, and fake checkpoints of it as the training frameworks write them."""

import zlib
from dataclasses import replace

import numpy as np
import torch
from toy_clips import tiny, with_settings

from mudg.base import weights
from mudg.core.noise import ScheduleConfig
from mudg.diffusion import convert
from mudg.diffusion.published import PublishedConfig, PublishedMDM
from mudg.diffusion.published_network import AutoencoderConfig, ResamplerConfig, VideoUNetConfig
from mudg.diffusion.settings import ConvertConfig, LearnNetwork
from mudg.networks.clip import TowerConfig

TINY = PublishedConfig(
    net=VideoUNetConfig(
        width=32, multipliers=(1, 2), blocks=1, attention=(True, False), head_width=8, first_heads=2, context_width=16
    ),
    codec=AutoencoderConfig(width=32, multipliers=(1, 2), blocks=1),
    image_tokens=ResamplerConfig(
        width=16, layers=1, head_width=8, heads=2, tokens=2, frames=4, image_width=16, context_width=16
    ),
    image=TowerConfig(16, 2, 2),
    image_side=28,
    text=TowerConfig(16, 3, 2),
    schedule=ScheduleConfig(base_scale=0.7),
    width=12,
    height=8,
)


def value_for(name, shape):
    """Values that depend on a tensor's published name alone (see golden/published_networks.md)."""
    numbers = np.random.RandomState(zlib.crc32(name.encode()) & 0xFFFFFFFF).standard_normal(int(np.prod(shape)))
    draw = numbers.reshape(shape)
    if len(shape) >= 2:
        draw = draw / np.sqrt(np.prod(shape[1:]))
    else:
        draw = 1 + 0.1 * draw if name.endswith(".weight") else 0.1 * draw
    return torch.from_numpy(draw.astype(np.float32))


def fill(module, ours, theirs):
    """Fill a module by published names; `ours`, `theirs`: prefix of its names in the whole model and in a
    checkpoint."""
    state = module.state_dict()
    published = weights.published_names([ours + name for name in state])
    filled = {}
    for name, value in state.items():
        given = published[ours + name]
        assert given.startswith(theirs)
        filled[name] = value_for(given.removeprefix(theirs), tuple(value.shape))
    module.load_state_dict(filled)
    return module.eval()


def scale_table(base=0.7):
    return torch.cat([torch.linspace(1, base, 400), torch.full((1000,), base)])


def tiny_checkpoint(base=0.7):
    """Published name -> tensor of a complete checkpoint of the tiny network, with the tables that real ones carry."""
    shapes = convert.wanted_shapes(TINY)
    published = weights.published_names(shapes)
    state = {theirs: value_for(theirs, shapes[ours]) for ours, theirs in published.items()}
    state["scale_arr"] = scale_table(base)
    state["betas"] = torch.linspace(0, 1, 1000)
    state["alphas_cumprod"] = torch.linspace(1, 0, 1000)
    state["cond_stage_model.model.logit_scale"] = torch.tensor(4.6)
    state["embedder.model.visual.proj"] = torch.zeros(16, 16)
    return state


def dynamicrafter_checkpoint():
    """The same as its ancestor has it: 8 input channels and no modality label."""
    state = {name: value for name, value in tiny_checkpoint().items() if ".class_embed." not in name}
    kernel = "model.diffusion_model.input_blocks.0.0.weight"
    state[kernel] = value_for(kernel, (32, 8, 3, 3))
    return state


def tiny_model():
    """The tiny model with the weights of `tiny_checkpoint`, which make every path matter."""
    model = PublishedMDM(TINY)
    for part in ("net", "codec", "image", "image_tokens"):
        fill(getattr(model, part), part + ".", "")
    model.text.copy_(value_for("text", tuple(model.text.shape)))
    return model.eval()


def published_settings(start, clips, **changes):
    """A run of two steps of `learn` on clips of points alone that goes on from a folder of the tiny model."""
    steps = {"steps": 2, "full_window_share": 1.0, "batch_frames": 8, "checkpoint_every": 100, "log_every": 1}
    rate = {"lr": 1e-4, "last_lr_share": 1.0, "warmup_steps": 0, "betas": (0.9, 0.999), "clip_norm": 0.5}
    data = {"first_cities": 3, "width": 32, "height": 32, "augment": False, "average_decay": 0.0}
    settings = replace(tiny(clips, start=str(start)), network=LearnNetwork())
    return with_settings(settings, **{**steps, **rate, **data, **changes})


def write_tiny(folder):
    """The tiny model as `convert` writes it."""
    torch.save({"state_dict": tiny_checkpoint()}, folder / "512.ckpt")
    convert.convert_file(ConvertConfig(), folder / "512.ckpt", folder / "model", TINY)
    return folder / "model"
