"""Settings of ``mudg synthesize``, ``convert`` and ``learn``."""

from __future__ import annotations

from typing import Annotated, Literal

from mudg.base.config import Limits, setting, settings
from mudg.base.devices import DeviceName

ConditionParts = Literal["full", "reference", "points", "concat", "repair"]
Precision = Literal["auto", "float32", "bfloat16", "float16"]
Realism = Literal["plain", "varied", "mixed"]
BelowOne = Annotated[float, Limits(ge=0, lt=1)]


@settings
class SynthesizeConfig:
    """Generate dense RGB, depth and semantics on laterally shifted trajectories with the diffusion model."""

    cameras: tuple[str, ...] = ("front",)
    """Cameras for which shifted views are made (empty = the first camera). A name that the scene lacks is an error."""
    shifts_m: tuple[float, ...] = (2.0, -2.0, 3.0, -3.0, 4.0, -4.0)
    """Lateral shifts in metres, positive to the left of the direction of travel; 0 = the recorded path."""
    paths: tuple[str, ...] = ()
    """Further paths by name: up+1, lane+0.1, speed-0.1, ..., as for render."""
    model: str = "embedded"
    """Diffusion model: "embedded" or "embedded-tiny", both shipped with the package, or a model folder written by learn
    or convert."""
    steps: int = setting(default=2, ge=1, le=1000)
    """Denoising steps. More add texture and agree less with the truth pixel by pixel. Use 50 for published-type
    models."""
    eta: float | None = setting(default=None, ge=0, le=1)
    """Noise added between steps, from 0 (deterministic) to 1 (as much as the reverse process has) (not given: 1)."""
    condition: ConditionParts = "full"
    """Which parts of the model's condition are given, to measure what each brings. reference: the nearest recorded
    image alone. points: LiDAR points alone. concat: both, without images warped by depth (published-type models: the
    image in frame 0, not in the image tokens). The shipped models were trained on whole conditions. repair: renders of
    `--fitted` and the nearest recorded image, without points; gives colour alone."""
    given_classes: bool = True
    """Use the classes of labelled points and recorded images in the model's condition, if the scene has labels."""
    align_depth: bool = True
    """Align generated depth to the LiDAR points in the same view (one scale and one shift per frame)."""
    overlap: int = setting(default=2, ge=0)
    """Frames that a window of the model shares with the previous window; they are kept, so that the video continues
    smoothly. Published-type models: 8."""
    width_px: int = setting(default=0, ge=0)
    """Image width in pixels at which the model works (0 = about the area it was trained at, in the camera's aspect
    ratio)."""
    full_size: bool = True
    """Write views at the camera's size: by the model's finisher, or, where it has none, with detail restored from
    warped recorded images. Off: at the size the model works at."""
    precision: Precision = "auto"
    """Number format of the diffusion model. auto: bfloat16 on CUDA devices and CPUs that compute in it, float32
    elsewhere (published-type models on older CUDA devices: float16). float16: published-type models on CUDA devices, as
    in the release."""
    device: DeviceName = "auto"
    """Device of the diffusion model: auto (CUDA if there is one), cpu, cuda, cuda:N, mps."""
    processes: int = setting(default=0, ge=0)
    """Number of trajectories made at the same time, with one thread each (0 = one per core; one for published-type
    models, and where the diffusion model is not on the CPU)."""
    guidance: float | None = setting(default=None, ge=1)
    """Published-type models: scale of classifier-free guidance; 1 = none, which halves the work (not given: 7.5)."""
    guidance_rescale: float | None = setting(default=None, ge=0, le=1)
    """Published-type models: guidance rescale, 0 (off) to 1; limits overexposure by guidance (not given: 0.7)."""
    memory_budget_gb: float = setting(default=0.0, ge=0)
    """Published-type models: memory in GB; the work is split to fit into it (0 = what is free on a CUDA device;
    elsewhere do not split). The result stays the same."""
    seed: int = 0
    """Seed of the noise."""


# mudg convert -------------------------------------------------------------------------------------


@settings
class ConvertConfig:
    """Convert a published checkpoint to a model folder."""

    network: Literal["diffusion", "inception", "i3d", "lpips", "lpips-vgg"] = "diffusion"
    """What the checkpoint holds: a diffusion model, or a network of the scores (docs/scores.md). The other settings
    apply to diffusion models only."""
    resolution: Literal["auto", "320x512", "576x1024"] = "auto"
    """Image height x width that the checkpoint was trained at. auto: from 512 or 1024 in the file's name."""
    dtype: Literal["keep", "float32", "float16", "bfloat16"] = "keep"
    """Number format of the written weights. keep: as in the checkpoint. bfloat16 halves the size of float32 weights."""
    memory_gb: float = setting(default=0.0, ge=0)
    """Limit, in GB, of the address space of the process that reads the checkpoint, beyond the program's own (0 =
    derived from the file's size). Raise it if the conversion runs out of memory."""


# mudg learn ---------------------------------------------------------------------------------------


@settings
class LearnData:
    """Training clips: from recorded logs if `scenes` is given, else from generated cities."""

    width: int = setting(default=192, ge=32)
    """Width of the training images in pixels."""
    height: int = setting(default=128, ge=32)
    """Height of the training images in pixels. For logs only the area width x height counts; the aspect ratio is the
    camera's."""
    window: int = setting(default=8, ge=1)
    """Frames per clip."""
    clips: str = ""
    """Folder of training clips to read; missing clips are added to it (empty = a folder inside the output). Give an
    earlier run's folder to reuse its clips."""
    augment: bool = True
    """Vary the training clips: change colours, mirror, and corrupt the classes in the condition."""
    reference_dropout: float = setting(default=0.2, ge=0, le=1)
    """Published-type models: share of the clips that are trained without their reference in the image tokens (paper:
    0.2, released code: 0.1)."""
    cities: int = setting(default=240, ge=1)
    """Number of generated cities to train on."""
    skip_cities: int = setting(default=0, ge=0)
    """Generated cities to leave out before the first one, for example those of an earlier run whose `clips` this run
    uses and adds to."""
    first_cities: int = setting(default=40, ge=1)
    """Number of cities in use from the first step. The others are generated and join while training runs."""
    all_cities_at: float = setting(default=0.6, ge=0, le=1)
    """Share of the steps after which all cities are in use, 0 to 1."""
    clips_per_city: int = setting(default=4, ge=1)
    """Clips taken from each generated city."""
    realism: Realism = "plain"
    """Generated cities: varied = cities, cameras, LiDARs and their faults as in recorded logs (docs/training.md). mixed
    = half of them are. The small model then also learns five aspect ratios, all of about the area width x height.
    Cities for scoring stay plain."""
    log_frames: int = setting(default=12, ge=12)
    """Generated cities: frames of each log. Longer logs, with fits of more steps, give better renders."""
    side_cameras: float | None = setting(default=None, ge=0, le=1)
    """Generated cities: share with two cameras beside the front one (not given: 0.4 of plain cities, 0.35 of varied
    ones)."""
    fit_steps: tuple[Annotated[int, Limits(ge=1)], Annotated[int, Limits(ge=1)]] = (100, 300)
    """Generated cities: fewest and most steps of the fit to each city; cities for scoring have the middle of them."""
    renders: bool = True
    """Generated cities: fit a scene to each city's images for a few hundred steps and give its renders in the
    condition, with patches at the camera's resolution. Takes about half a minute per city. Not done for models that use
    no renders. Without it, or on recorded logs, no model learns to use renders or gets a finisher."""
    textures: str = ""
    """Varied cities: folder with photographs of surfaces (textures/*.jpg, *.png) and panoramas of skies (sky/*.hdr) to
    use (empty = none)."""
    held_out: int = setting(default=6, ge=1)
    """Number of additional cities that are used for scoring only."""
    scenes: tuple[str, ...] = ()
    """Recorded logs to train on instead of cities: output folders of mudg run, or SCENE=FUSED for each. Or one list of
    many scenes, a file that ends in .yaml or .json (docs/training.md)."""
    bad_scenes: float = setting(default=0.02, ge=0, le=1)
    """Scenes of a list: share that may be missing or damaged. These are named and left out; more end the training."""
    cameras: tuple[str, ...] = ()
    """Logs: cameras to take clips from (empty = all)."""
    stride: int = setting(default=4, ge=1)
    """Logs: frames between the starts of two clips. Values below `window` give overlapping clips."""
    held_out_every: int = setting(default=5, ge=0)
    """Logs: every n-th clip is used for scoring only (0 = none)."""


@settings
class LearnNetwork:
    """Shape of the denoising network and of the refiner behind it."""

    widths: tuple[int, ...] = (64, 128, 224)
    """Channels of the network at each resolution level."""
    blocks: tuple[int, ...] = (1, 1, 2)
    """Residual blocks at each level."""
    spatial_attention: tuple[bool, ...] = (False, False, True)
    """For each level: whether it has attention between positions of a frame."""
    temporal_attention: tuple[bool, ...] = (False, False, True)
    """For each level: whether it has attention between frames."""
    refine_widths: tuple[int, ...] = (64, 128)
    """Channels of the refiner at the latent resolution and at half of it (empty = no refiner)."""
    refine_blocks: tuple[int, ...] = (2, 3)
    """Residual blocks of the refiner at each level."""
    renders: bool = True
    """Let the condition hold renders of a fitted scene."""
    finish_widths: tuple[int, ...] = (32, 64)
    """Channels of the finisher, which brings clips to the camera's size, at half and at a quarter of that size (empty =
    no finisher)."""
    finish_blocks: tuple[int, ...] = (2, 2)
    """Residual blocks of the finisher at each level."""


@settings
class LearnCodec:
    """Training of the latent codec, which precedes the network's."""

    steps: int = setting(default=400, ge=1)
    """Training steps of the codec's decoder."""
    batch: int = setting(default=16, ge=1)
    """Images per step of the codec's decoder."""
    fit_batches: int = setting(default=8, ge=1)
    """Number of batches, of eight images each, to which the linear part of the codec is fitted."""


@settings
class LearnOptimizer:
    """AdamW, its learning-rate schedule, and the batch size."""

    batch_frames: int = setting(default=16, ge=1)
    """Frames per step over all processes. Steps use clips of half the window first, and whole windows at the end."""
    full_window_share: float = setting(default=0.3, ge=0, le=1)
    """Share of the steps, at the end, that use whole windows, 0 to 1."""
    lr: float = setting(default=1e-3, gt=0)
    """Largest learning rate. Use about a tenth of the default to fine-tune a trained model."""
    warmup_steps: int = setting(default=100, ge=0)
    """Steps over which the learning rate rises to its largest value."""
    decay_share: float = setting(default=0.5, gt=0, le=1)
    """Share of the steps, at the end, over which the learning rate falls."""
    last_lr_share: float = setting(default=0.02, gt=0, le=1)
    """Learning rate of the last step, as a share of the largest one (1 = constant)."""
    betas: tuple[BelowOne, BelowOne] = (0.9, 0.99)
    """AdamW's decay rates of the mean gradient and of the mean squared gradient."""
    clip_norm: float = setting(default=1.0, ge=0)
    """Gradients with a larger norm than this are scaled down to it (0 = never)."""
    average_decay: float = setting(default=0.998, ge=0, lt=1)
    """Decay of the moving average of the weights, which is the result (0 = no average)."""


@settings
class LearnLoss:
    """Terms of the training loss."""

    class_balance: float = setting(default=0.0, ge=0, le=1)
    """Balance of rare classes in the semantic loss: 0 = as frequent as they are, 1 = all classes count the same. The
    bias this gives the refiner's class scores is removed after training."""
    refined_share: float = setting(default=0.5, gt=0, le=1)
    """The refiner is trained on a crop whose sides are this share of the image's."""


@settings
class LearnScore:
    """Scores and sample images of held-out clips."""

    every: int = setting(default=400, ge=1)
    """Steps between scorings during training."""
    watched: int = setting(default=1, ge=1)
    """Number of held-out cities scored and drawn during training. At the end all are scored."""
    steps: int = setting(default=2, ge=1)
    """Denoising steps of the scored samples."""


@settings
class LearnCompute:
    """How the training is computed and logged. These settings do not change the result; a run may be resumed with other
    values."""

    device: DeviceName = "auto"
    """Device on which the networks are trained and scored: auto (CUDA if there is one), cpu, cuda, cuda:N, mps. Under
    torchrun cuda is one device for each process. Clips are made on the CPU."""
    accumulate: int = setting(default=1, ge=1)
    """Gradient accumulation: each process computes its share of a step in this many portions. Larger needs less memory
    and gives the same result."""
    recompute: bool = False
    """Activation checkpointing: recompute the activations of the network's blocks in the backward pass. Needs less
    memory, takes longer."""
    workers: int = setting(default=1, ge=0)
    """Processes that generate clips of cities while training runs (0 = wait until another process has written them).
    Clips of logs are made before training starts, by this process if 0."""
    checkpoint_every: int = setting(default=100, ge=1)
    """Steps between checkpoints; an interrupted training resumes at the last one."""
    cache: str = ""
    """Lists of scenes: folder for training clips that are fetched or made when they are needed; several runs and
    processes may share it (empty = a folder inside the output)."""
    cache_gb: float = setting(default=50.0, gt=0)
    """Largest size of that folder in GB. The clips that were not used for the longest time are removed first."""
    read_ahead: int = setting(default=4, ge=0)
    """Steps ahead for which training clips are fetched, made and drawn by threads beside the training (0 = none)."""
    log_every: int = setting(default=50, ge=1)
    """Steps between lines of log.jsonl."""


@settings
class LearnConfig:
    """Train a multi-modal diffusion model on generated cities or on recorded logs."""

    seed: int = 0
    """Seed of the cities, the initial weights and all other random numbers."""
    start: str = ""
    """Model to continue from: a folder written by learn or convert, or "embedded" for the shipped model (empty = train
    from scratch)."""
    steps: int = setting(default=2800, ge=1)
    """Training steps of the network."""
    frozen: Literal["nothing", "temporal_transformers", "temporal_layers", "denoiser"] = "nothing"
    """Layers that keep their weights. temporal_transformers: as in the published second stage. temporal_layers: all
    layers that mix frames. denoiser: train the refiner only."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Number format of the computation. auto: bfloat16 on CUDA devices and CPUs that compute in it, float32
    elsewhere."""
    threads: int = setting(default=1, ge=1)
    """Threads of the training process. Results are repeatable for the same number of threads."""
    data: LearnData = setting(default_factory=LearnData)
    network: LearnNetwork = setting(default_factory=LearnNetwork)
    codec: LearnCodec = setting(default_factory=LearnCodec)
    optimizer: LearnOptimizer = setting(default_factory=LearnOptimizer)
    loss: LearnLoss = setting(default_factory=LearnLoss)
    score: LearnScore = setting(default_factory=LearnScore)
    compute: LearnCompute = setting(default_factory=LearnCompute)
