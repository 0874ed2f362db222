"""Settings of ``mudg learn``."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT

BelowOne = Annotated[float, Field(ge=0, lt=1)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LearnData:
    """Training clips: from recorded logs if scenes are given, else from generated cities."""

    width: int = Field(default=192, ge=32)
    """Width of the training images, pixels."""
    height: int = Field(default=128, ge=32)
    """Height, pixels. Logs: only the area counts; the aspect is the camera's."""
    window: int = Field(default=8, ge=1)
    """Frames per clip."""
    clips: str = ""
    """Folder of training clips to use and complete (empty = inside the output folder)."""
    augment: bool = True
    """Vary colours, mirror, and spoil given classes."""
    reference_dropout: float = Field(default=0.2, ge=0, le=1)
    """Published-type models: how often a clip goes without its reference image; 0.2 as the paper says, 0.1 as the released code
    does."""
    cities: int = Field(default=240, ge=1)
    """Generated cities to train on."""
    first_cities: int = Field(default=40, ge=1)
    """Cities in use from the first step; the others join as training goes on."""
    all_cities_at: float = Field(default=0.6, ge=0, le=1)
    """Share of the steps after which all cities are in use."""
    clips_per_city: int = Field(default=4, ge=1)
    """Clips that each generated city gives."""
    held_out: int = Field(default=6, ge=1)
    """Cities kept for scoring only."""
    scenes: tuple[str, ...] = ()
    """Recorded logs to train on instead of cities: output folders of mudg run, or SCENE=FUSED each."""
    cameras: tuple[str, ...] = ()
    """Cameras of these logs (empty = all)."""
    stride: int = Field(default=4, ge=1)
    """Logs: frames from the start of one clip to the next one's."""
    frame_step: int = Field(default=1, ge=1)
    """Logs: take every n-th frame only."""
    held_out_every: int = Field(default=5, ge=0)
    """Logs: every n-th clip is kept for scoring only (0 = none)."""
    label_confidence: float = Field(default=0.5, ge=0, le=1)
    """Logs: labels with less confidence than this are not learned from."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LearnNetwork:
    """Shape of the denoising network and of the refiner behind it."""

    widths: tuple[int, ...] = (64, 128, 224)
    """Channels of the network's levels."""
    blocks: tuple[int, ...] = (1, 1, 2)
    """Residual blocks per level."""
    spatial_attention: tuple[bool, ...] = (False, False, True)
    """Whether a level attends between the places of a frame."""
    temporal_attention: tuple[bool, ...] = (False, False, True)
    """Whether a level attends between frames."""
    patch: int = Field(default=2, ge=1)
    """Side of the squares of latent pixels that the network takes as one."""
    refine_widths: tuple[int, ...] = (64, 128)
    """Channels of the refiner at the latent resolution and at half of it; none = no refiner."""
    refine_blocks: tuple[int, ...] = (2, 3)
    """Residual blocks per level of the refiner."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LearnCodec:
    """Training of the latent codec, before the network."""

    steps: int = Field(default=400, ge=1)
    """Steps of the codec's decoder."""
    batch: int = Field(default=16, ge=1)
    """Images per step of the codec's decoder."""
    fit_batches: int = Field(default=8, ge=1)
    """Batches of eight images to which the codec's linear part is fitted."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LearnOptimizer:
    """AdamW, its learning rate over the steps, and the size of a step."""

    batch_frames: int = Field(default=16, ge=1)
    """Frames per step, over all processes: half windows first, whole windows at the end."""
    full_window_share: float = Field(default=0.3, ge=0, le=1)
    """Share of the steps, at the end, with whole windows."""
    lr: float = Field(default=1e-3, gt=0)
    """Largest learning rate of the network."""
    warmup_steps: int = Field(default=100, ge=0)
    """Steps over which the learning rate rises to it."""
    decay_share: float = Field(default=0.5, gt=0, le=1)
    """Share of the steps, at the end, over which the learning rate falls."""
    last_lr_share: float = Field(default=0.02, gt=0, le=1)
    """Share of the learning rate at the end (1 = constant)."""
    betas: tuple[BelowOne, BelowOne] = (0.9, 0.99)
    """Decay of the gradients' mean, and of the mean of their squares."""
    weight_decay: float = Field(default=0.01, ge=0)
    """How strongly weights are pulled to zero."""
    clip_norm: float = Field(default=1.0, ge=0)
    """Gradients are scaled down to this norm (0 = never)."""
    average_decay: float = Field(default=0.998, ge=0, lt=1)
    """Decay of the moving average of the weights (0 = no average)."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LearnLoss:
    """What counts how much in the loss."""

    class_balance: float = Field(default=0.0, ge=0, le=1)
    """How strongly rare classes count in the semantic loss: 0 = as often as they occur, 1 = all classes alike. A refiner's
    scores are freed of it at the end."""
    refined_share: float = Field(default=0.5, gt=0, le=1)
    """Share of each side of the image on which the refiner is trained at a step."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LearnScore:
    """Scores and pictures of held-out clips."""

    every: int = Field(default=400, ge=1)
    """Steps per scoring and picture of the watched cities during training."""
    watched: int = Field(default=1, ge=1)
    """Held-out cities scored and drawn during training; all are at the end."""
    steps: int = Field(default=2, ge=1)
    """Denoising steps."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LearnCompute:
    """How the run is computed and recorded; none of this changes the result. A run may be continued with other values."""

    device: Literal["cpu", "cuda"] = "cpu"
    """Where the network is trained. Clip making stays on the CPU, and scoring too, but of a published-type model."""
    parallel: Literal["ddp", "fsdp"] = "ddp"
    """Under torchrun: ddp = a whole network per process; fsdp = parameters and moments in pieces."""
    accumulate: int = Field(default=1, ge=1)
    """Portions in which each process goes through its share of a step: less memory, same result."""
    recompute: bool = False
    """Keep no activations inside the network's blocks; the backward pass computes them again."""
    workers: int = Field(default=1, ge=0)
    """Processes that generate clips while training runs (0 = none: wait for another process to fill the folder). Clips of
    logs are made before training, by this process if 0."""
    checkpoint_every: int = Field(default=100, ge=1)
    """Steps per checkpoint."""
    log_every: int = Field(default=50, ge=1)
    """Steps per line of log.jsonl."""
    tensorboard: bool = False
    """Also write losses for TensorBoard (needs the package tensorboard, extra [track])."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LearnConfig:
    """Train a multi-modal diffusion model on generated cities, or on recorded logs."""

    MOVED: ClassVar[dict[str, str | None]] = {
        **{name: f"data.{name}" for name in (
            "width", "height", "window", "clips", "augment", "reference_dropout", "cities", "first_cities", "all_cities_at",
            "clips_per_city", "held_out", "scenes", "stride", "frame_step", "held_out_every", "label_confidence",
        )},
        **{name: f"network.{name}" for name in (
            "widths", "blocks", "spatial_attention", "temporal_attention", "patch", "refine_widths", "refine_blocks",
        )},
        **{name: f"optimizer.{name}" for name in (
            "batch_frames", "full_window_share", "lr", "warmup_steps", "decay_share", "last_lr_share", "weight_decay", "clip_norm",
            "average_decay",
        )},
        **{name: f"compute.{name}" for name in (
            "device", "parallel", "accumulate", "recompute", "workers", "checkpoint_every", "log_every", "tensorboard",
        )},
        "scene_cameras": "data.cameras", "codec_steps": "codec.steps", "codec_batch": "codec.batch",
        "codec_fit_batches": "codec.fit_batches", "codec_lr": None, "beta1": "optimizer.betas", "beta2": "optimizer.betas",
        "balance": "loss.class_balance", "refined_share": "loss.refined_share", "sample_every": "score.every",
        "watched": "score.watched", "sample_steps": "score.steps", "score_steps": "score.steps", "cache_latents": None,
    }  # fmt: skip

    seed: int = 0
    """Fixes the cities, the weights' start and every draw."""
    start: str = ""
    """Folder of a model to continue from, a converted one too, or "embedded" for the shipped one (empty = train from nothing)."""
    steps: int = Field(default=2800, ge=1)
    """Steps of the network."""
    frozen: Literal["nothing", "temporal_transformers", "temporal_layers", "denoiser"] = "nothing"
    """What keeps its weights. The published second stage freezes the temporal transformers alone; with denoiser only the
    refiner is trained."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """auto: bfloat16 on CPUs with AMX, float32 elsewhere."""
    threads: int = Field(default=1, ge=1)
    """Threads of the training process. Results are repeatable at a fixed number."""
    data: LearnData = Field(default_factory=LearnData)
    network: LearnNetwork = Field(default_factory=LearnNetwork)
    codec: LearnCodec = Field(default_factory=LearnCodec)
    optimizer: LearnOptimizer = Field(default_factory=LearnOptimizer)
    loss: LearnLoss = Field(default_factory=LearnLoss)
    score: LearnScore = Field(default_factory=LearnScore)
    compute: LearnCompute = Field(default_factory=LearnCompute)
