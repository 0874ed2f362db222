"""The frozen configuration of every verb, in one file that imports no torch, so that ``--help`` answers at once.

Defaults are a full run on a small machine. Every field is one flag; units are in the names.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT
from mudg.data.city.config import CityConfig


@dataclass(frozen=True, kw_only=True, config=STRICT)
class IngestConfig:
    """Turn a dataset log, or the built-in procedural city, into a scene directory."""

    resolution: str = ""
    """Size of the scene's images: longest side, e.g. 960, or WIDTHxHEIGHT (empty = as recorded). Images are never enlarged."""
    workers: int = Field(default=0, ge=0)
    """Threads that convert frames (0 = one per processor). The result does not depend on it."""
    contact_sheet: bool = True
    """Draw contact_sheet.jpg: frames with LiDAR and boxes, and the scene from above."""
    test_every: int = Field(default=4, ge=0)
    """Hold out every n-th frame of all cameras for scoring (0 = hold out none)."""
    format: str = "auto"
    """Format of the log: kitti, kitti360, waymo, nuscenes, argoverse2, pandaset, nuplan, dgp or custom (auto = look)."""
    frames: str = ""
    """Frames to take, FIRST:END with END left out, e.g. 0:40 (empty = all). KITTI: numbers of its files; else counted from 0."""
    cameras: tuple[str, ...] = ()
    """Cameras to take, by their names in the scene or in the data set (empty = the format's usual ones)."""
    sequence: str = ""
    """Which log, sequence, scene or frame, where a folder holds several."""
    poses: str = ""
    """File (or folder of GPS/IMU packets) with vehicle poses, instead of the one found by looking."""
    boxes: str = ""
    """File with tracked boxes, instead of the one found by looking."""
    skip_missing: bool = False
    """Leave out frames of which an image or scan is missing, instead of refusing."""
    untwist: Literal["auto", "yes", "no"] = "auto"
    """Undo the distortion of LiDAR scans by the vehicle's motion (auto = where the dataset says they are distorted)."""
    city: CityConfig = Field(default_factory=CityConfig)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class AnnotateConfig:
    """Make the labels that a scene lacks: dense depth, classes, sky, movers, each with a confidence."""

    labeller: Literal["embedded", "geometry", "network"] = "embedded"
    """What tells classes and sky. embedded: the small network that comes with the package, from image, heights and boxes; geometry: rules
    for these, without a network; network: a segmentation network from `weights`."""
    weights: str = ""
    """labeller network: folder of a SegFormer, Mask2Former or EoMT with Cityscapes classes, as transformers writes it, or its name in the
    Hugging Face cache (owner/name or owner/name@revision). labeller embedded: folder of a network trained with
    tools/train_segmenter.py (empty = the one that comes with the package)."""
    depth: bool = True
    """Write dense depth: LiDAR of several sweeps, filled along the image."""
    depth_network: str = ""
    """Take dense depth from a network, aligned to LiDAR: folder, or name in the Hugging Face cache, of a PromptDepthAnything, Depth
    Anything (transformers) or Marigold (diffusers), or folder of a DepthLab (mudg convert)."""
    depth_guided: bool = True
    """Marigold: LiDAR steers every denoising step (slower); else the result is only aligned to it."""
    depth_steps: int = Field(default=0, ge=0)
    """Marigold and DepthLab: denoising steps (0 = what the folder says, or 50 with LiDAR steering)."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the networks of labeller and `depth_network` compute."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Of these networks. auto is float32: bfloat16 is faster on some devices, and rounds depth to 0.4 percent."""
    sweeps: int = Field(default=6, ge=1, le=100)
    """Sweeps of each LiDAR, the nearest in time, whose points are put together."""
    dynamic: bool = True
    """Write where tracked things are seen that move."""
    ego: bool = False
    """Write where the own vehicle is seen: pixels at the bottom that stay the same while it moves."""
    processes: int = Field(default=0, ge=0)
    """Frames labelled at the same time (0 = one per core)."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class FuseConfig:
    """Fuse sweeps and images into a static coloured cloud and one cloud per moving object."""

    voxel_m: float = Field(default=0.0, ge=0)
    """Keep one point per voxel of this size (0 = keep all)."""
    occlusion_test: bool = True
    """Give no colour to points behind a nearer surface."""
    max_image_gap_s: float = Field(default=0.06, ge=0)
    """Images at most this far in time from a sweep colour its points."""
    colour_from_held_out: bool = False
    """Also take colours from held-out images (scores at held-out frames then mean little)."""
    box_growth_m: float = Field(default=0.1, ge=0, le=2)
    """Moving boxes are grown by this on each side."""
    floor_margin_m: float = Field(default=0.1, ge=0, le=1)
    """Points this close above a moving box's floor stay with the road."""
    moving_distance_m: float = Field(default=0.5, gt=0)
    """A tracked box that gets or travels farther than this moves."""
    min_object_points: int = Field(default=100, ge=1)
    """Moving objects with fewer coloured points are left out."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LearnConfig:
    """Train a multi-modal diffusion model on generated cities, or on recorded logs."""

    seed: int = 0
    """Fixes the cities, the weights' start and every draw."""
    start: str = ""
    """Folder of a model to continue from, a converted one too, or "embedded" for the shipped one (empty = train from nothing)."""
    scenes: tuple[str, ...] = ()
    """Recorded logs to train on instead of cities: output folders of mudg run, or SCENE=FUSED each."""
    scene_cameras: tuple[str, ...] = ()
    """Cameras of these logs (empty = all)."""
    stride: int = Field(default=4, ge=1)
    """Logs: frames from the start of one clip to the next one's."""
    frame_step: int = Field(default=1, ge=1)
    """Logs: take every n-th frame only."""
    held_out_every: int = Field(default=5, ge=0)
    """Logs: every n-th clip is kept for scoring only (0 = none)."""
    label_confidence: float = Field(default=0.5, ge=0, le=1)
    """Logs: labels with less confidence than this are not learned from."""
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
    watched: int = Field(default=1, ge=1)
    """Held-out cities scored and drawn during training."""
    clips: str = ""
    """Folder of training clips to use and complete (empty = inside the output folder)."""
    workers: int = Field(default=1, ge=0)
    """Processes that generate clips while training runs (0 = none: wait for another process to fill the folder). Clips of
    logs are made before training, by this process if 0."""
    threads: int = Field(default=1, ge=1)
    """Threads of the training process. Results are repeatable at a fixed number."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """auto: bfloat16 on CPUs with AMX, float32 elsewhere."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the network is trained. Clip making stays on the CPU, and scoring too, but of a published-type model."""
    parallel: Literal["ddp", "fsdp"] = "ddp"
    """Under torchrun: ddp = a whole network per process; fsdp = parameters and moments in pieces."""
    accumulate: int = Field(default=1, ge=1)
    """Portions in which each process goes through its share of a step: less memory, same result."""
    recompute: bool = False
    """Keep no activations inside the network's blocks; the backward pass computes them again."""
    cache_latents: bool = False
    """Keep latents of the fixed codec on disk. Worth it for an expensive codec; needs --no-augment."""
    tensorboard: bool = False
    """Also write losses for TensorBoard (needs the package tensorboard, extra [track])."""
    width: int = Field(default=192, ge=32)
    """Width of the training images, pixels."""
    height: int = Field(default=128, ge=32)
    """Logs: only the area counts; the aspect is the camera's."""
    window: int = Field(default=8, ge=1)
    """Frames per clip."""
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
    refined_share: float = Field(default=0.5, gt=0, le=1)
    """Share of each side of the image on which the refiner is trained at a step."""
    codec_steps: int = Field(default=400, ge=1)
    """Steps of the codec's decoder."""
    codec_batch: int = Field(default=16, ge=1)
    """Images per step of the codec's decoder."""
    codec_fit_batches: int = Field(default=8, ge=1)
    """Batches to which the codec's linear part is fitted."""
    codec_lr: float = Field(default=2e-3, gt=0)
    """Learning rate of the codec's decoder."""
    steps: int = Field(default=2800, ge=1)
    """Steps of the denoising network."""
    batch_frames: int = Field(default=16, ge=1)
    """Frames per step, over all processes: half windows first, whole windows at the end."""
    full_window_share: float = Field(default=0.3, ge=0, le=1)
    """Share of the steps, at the end, with whole windows."""
    lr: float = Field(default=1e-3, gt=0)
    """Largest learning rate of the denoising network."""
    warmup_steps: int = Field(default=100, ge=0)
    """Steps over which the learning rate rises to it."""
    decay_share: float = Field(default=0.5, gt=0, le=1)
    """Share of the steps, at the end, over which the learning rate falls."""
    last_lr_share: float = Field(default=0.02, gt=0, le=1)
    """Share of the learning rate at the end (1 = constant)."""
    beta1: float = Field(default=0.9, ge=0, lt=1)
    """AdamW: decay of the gradients' mean."""
    beta2: float = Field(default=0.99, ge=0, lt=1)
    """AdamW: decay of the mean of their squares."""
    weight_decay: float = Field(default=0.01, ge=0)
    """AdamW: how strongly weights are pulled to zero."""
    clip_norm: float = Field(default=1.0, ge=0)
    """Gradients are scaled down to this norm (0 = never)."""
    frozen: Literal["nothing", "temporal_transformers", "temporal_layers", "denoiser"] = "nothing"
    """What keeps its weights. The published second stage freezes the temporal transformers alone; with denoiser only the
    refiner is trained."""
    augment: bool = True
    """Vary colours, mirror, and spoil given classes."""
    reference_dropout: float = Field(default=0.2, ge=0, le=1)
    """How often a clip goes without its reference image; only for models that use one. Published-type models: 0.2 as the
    paper says, 0.1 as the released code does."""
    balance: float = Field(default=0.0, ge=0, le=1)
    """How strongly rare classes count in the semantic loss: 0 = as often as they occur, 1 = all classes alike. A refiner's
    scores are freed of it at the end."""
    average_decay: float = Field(default=0.998, ge=0, lt=1)
    """Decay of the moving average of the weights (0 = no average)."""
    checkpoint_every: int = Field(default=100, ge=1)
    """Steps per checkpoint."""
    log_every: int = Field(default=50, ge=1)
    """Steps per line of log.jsonl."""
    sample_every: int = Field(default=400, ge=1)
    """Steps per scoring and picture of the watched cities."""
    sample_steps: int = Field(default=2, ge=1)
    """Denoising steps of these pictures."""
    score_steps: int = Field(default=2, ge=1)
    """Denoising steps of the scores at the end."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class BenchConfig:
    """Measure on generated cities, against exact truth: the diffusion model on ones it never saw, or scenes, also off the path."""

    model: str = "embedded"
    """"embedded" or "embedded-tiny", shipped with the package, or the folder of a model made by learn."""
    cities: Literal["reported", "development"] = "reported"
    """reported: the list on which nothing is chosen. development: the list to look at while choosing."""
    count: int = Field(default=6, ge=1, le=6)
    """How many cities of the list; four clips each (2, 3, 4 m and the recorded path)."""
    steps: tuple[int, ...] = (1, 2, 8)
    """Denoising steps to compare."""
    sampler: Literal["ddim", "ancestral", "dpm_solver", "renoise"] = "ddim"
    """How the denoising steps are taken."""
    eta: float = Field(default=1.0, ge=0, le=1)
    """Noise that ddim adds between steps: 0 = deterministic, 1 = ancestral."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """auto: bfloat16 on CPUs with AMX, float32 elsewhere."""
    threads: int = Field(default=1, ge=1)
    """mdm, mdm-ablation, poses: threads of torch."""
    seed: int = 0
    """Fixes every random draw."""
    ablation_steps: int = Field(default=1500, ge=1)
    """mdm-ablation: training steps of each variant."""
    ablation_cities: int = Field(default=40, ge=1)
    """mdm-ablation: cities to train on."""
    list: Literal["development", "reported"] = "development"
    """shift: list of logs; nothing is chosen on the reported one."""
    logs: int = Field(default=8, ge=1, le=8)
    """shift: how many logs of the list (the development list has 4)."""
    methods: tuple[str, ...] = ("nearest_fill", "gs3d", "street_gaussians", "mudg_r", "mudg_s")
    """shift: methods to compare, of these five."""
    iterations: int = Field(default=1000, ge=1)
    """shift: steps of every fit."""
    ablation: bool = False
    """shift: also mudg_s with only some of its virtual terms: colour; colour and depth; colour and classes."""
    variant: tuple[str, ...] = ()
    """shift: also mudg_s with other settings of fit, each NAME=FIELD:VALUE,FIELD:VALUE."""
    processes: int = Field(default=0, ge=0)
    """shift: logs worked on at the same time, one thread each (0 = one per core)."""
    videos: bool = True
    """shift: also make the videos of the page."""
    pose_iterations: int = Field(default=300, ge=1)
    """poses: steps of each fit."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SynthesizeConfig:
    """Generate dense RGB, depth and semantics on shifted trajectories with the diffusion model."""

    cameras: tuple[str, ...] = ("front",)
    """Cameras to move sideways. Names that the scene lacks are an error; empty = the first camera."""
    shifts_m: tuple[float, ...] = (2.0, -2.0, 3.0, -3.0, 4.0, -4.0)
    """Lateral shifts, metres, positive to the left of the direction of travel; 0 = the recorded path."""
    model: str = "embedded"
    """"embedded" or "embedded-tiny", shipped with the package, or the folder of a model made by learn."""
    steps: int = Field(default=2, ge=1, le=1000)
    """Denoising steps. More give more texture, and less agreement with the truth pixel by pixel."""
    sampler: Literal["ddim", "ancestral", "dpm_solver", "renoise"] = "ddim"
    """How the steps are taken. Each costs one pass of the network per step."""
    eta: float = Field(default=1.0, ge=0, le=1)
    """Noise that ddim adds between steps: 0 = deterministic, 1 = ancestral."""
    start: Literal["noise", "condition", "render"] = "noise"
    """condition, render: start from the condition, or from the fitted scene's renders, with noise on it, and run only the
    share `strength` of the schedule."""
    strength: float = Field(default=1.0, gt=0, le=1)
    """start condition, render: share of the noise schedule that is run (1 = all of it)."""
    samples: int = Field(default=1, ge=1)
    """Samples per clip; the first is kept, the spread of all lowers the confidence. Costs that many times the passes."""
    given_classes: bool = True
    """Let the classes of labelled points and recorded images into the condition, where the scene has labels."""
    label_confidence: float = Field(default=0.5, ge=0, le=1)
    """Labels of recorded images with less confidence than this are not given."""
    align_depth: bool = True
    """Bring generated depth to the scale of the LiDAR points in the same view (scale and shift per frame)."""
    overlap: int = Field(default=2, ge=0)
    """Frames that a window of the model shares with the one before; they are kept, so that the video continues."""
    width_px: int = Field(default=0, ge=0)
    """Width the model works at (0 = about the area it was trained at, in the camera's aspect)."""
    full_size: bool = True
    """Write views at the camera's size, with detail of the warped recorded images put back; otherwise at the model's."""
    held_out_images: bool = False
    """Also warp in recorded images that are held out for scoring."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """auto: bfloat16 on CPUs with AMX, float32 elsewhere."""
    processes: int = Field(default=0, ge=0)
    """Trajectories made at the same time, one thread each (0 = one per core; one for a published-type model)."""
    guidance: float = Field(default=7.5, ge=1)
    """Published-type models: weight of the guided prediction; 1 = none, at half the work."""
    guidance_rescale: float = Field(default=0.7, ge=0, le=1)
    """Published-type models: how far the spread of the guided prediction is pulled back."""
    memory_budget_gb: float = Field(default=0.0, ge=0)
    """Published-type models: cut the work so that it fits into this memory (0 = do not cut)."""
    seed: int = 0
    """Fixes the noise."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ConvertConfig:
    """Turn a published checkpoint into a model folder."""

    resolution: Literal["auto", "320x512", "576x1024"] = "auto"
    """Height and width that the checkpoint was trained at (auto = 512 or 1024 in the file's name)."""
    dtype: Literal["keep", "float32", "float16", "bfloat16"] = "keep"
    """Number format of the weights that are written."""
    towers: str = ""
    """OpenCLIP ViT-H/14 weights for a checkpoint that lacks them (empty = the checkpoint has its own)."""
    shard_mb: int = Field(default=1024, ge=1)
    """Weight files are at most about this large."""
    memory_gb: float = Field(default=0.0, ge=0)
    """Address space that reading the checkpoint may take beyond the program's own (0 = from the file's size)."""


def _densify_by_name(value: object) -> object:
    """Older files say yes or no."""
    return {True: "gradient", False: "none"}[value] if isinstance(value, bool) else value


@dataclass(frozen=True, kw_only=True, config=STRICT)
class FitConfig:
    """Fit a dynamic Gaussian scene to recorded, and optionally virtual, views."""

    method: Literal["gs3d", "street_gaussians", "mudg_s"] = "mudg_s"
    """Which nodes and which supervision (see the table of methods)."""
    iterations: int = Field(default=2000, ge=1, le=1_000_000)
    """Optimisation steps, one recorded view each (mudg_s: see virtual_probability). Schedules and learning rates follow this number."""
    seed: int = 0
    """Fixes every random draw."""
    cameras: tuple[str, ...] = ()
    """Cameras whose recorded frames are fitted; empty = all."""
    width_px: int = Field(default=0, ge=0)
    """Width of the recorded images while fitting; the height follows (0 = as recorded)."""
    sh_degree: int = Field(default=0, ge=0, le=3)
    """Bands of view-dependent colour. On short drives every band above 0 learns the recorded line by heart."""
    semantics: bool = True
    """Carry class logits on every Gaussian where labels exist."""
    semantic_every: int = Field(default=3, ge=1)
    """Recorded views render and learn classes at every n-th step only (they converge early and cost a third of a step)."""
    longest_to_middle: float = Field(default=10.0, ge=1)
    """A Gaussian's longest axis is kept within this factor of its middle one: needles look right along the recorded line only."""
    max_gaussians: int = Field(default=120_000, ge=100)
    """Gaussians are added up to this number."""
    initial_gaussians: int = Field(default=70_000, ge=50)
    """Upper bound for the static points taken from the fused cloud, and for those of all objects together."""
    voxel_m: float = Field(default=0.15, gt=0)
    """Static points are thinned to one per cube of this size (finer close to the drive)."""
    far_m: float = Field(default=150.0, gt=1)
    """Distance of what is neither sky nor within LiDAR reach."""
    selective_adam: bool = False
    """Update only the Gaussians that a step's view shows."""
    learn_poses: bool = False
    """Correct the boxes of moving objects while fitting (offset and yaw per key)."""
    densify: Annotated[Literal["gradient", "mcmc", "none"], BeforeValidator(_densify_by_name)] = "gradient"
    """How the number of Gaussians changes. gradient: clone, split and prune by screen gradients; mcmc: move those that do nothing,
    grow to max_gaussians; none: as they start."""
    opacity_weight: float | None = Field(default=None, ge=0)
    """Pulls all opacities down, so that what no view needs fades (unset = 0.01 with mcmc, else 0)."""
    scale_weight: float | None = Field(default=None, ge=0)
    """Pulls all sizes down, per metre (unset = 0.001 with mcmc, else 0)."""
    pose_start: float = Field(default=0.25, ge=0, le=1)
    """learn_poses: share of the iterations before the first round of corrections."""
    pose_rounds: int = Field(default=4, ge=0)
    """learn_poses: rounds of corrections, spread evenly up to 85 % of the iterations (0 = only take the noise out of the tracks)."""
    deformable: bool = True
    """Let people and cyclists change their shape within their boxes."""
    color_terms: int = Field(default=0, ge=0, le=8)
    """Sines and cosines by which the colour of moving objects may vary over time (published: 4; 0 = constant)."""
    mirror_start: bool = True
    """Start vehicles with their points mirrored to the side that nothing measured."""
    mirror_probability: float = Field(default=0.0, ge=0, le=1)
    """How often vehicles are shown mirrored while fitting, so that one side teaches the other."""
    exposure: Literal["none", "camera", "image"] = "none"
    """Learn an affine colour map per camera, or per recorded image; not used in renders."""
    exposure_weight: float = Field(default=0.01, ge=0)
    """Pull of colour maps, of recorded and virtual views, towards the identity."""
    learn_cameras: bool = False
    """Correct the pose of every recorded image while fitting; not used in renders."""
    virtual_appearance: bool = False
    """mudg_s: learn an affine colour map per set of virtual views, so that their colours do not reach the recorded path."""
    outlier_deviations: float = Field(default=0.0, ge=0)
    """Leave out starting points that lie lonelier than usual by so many standard deviations (0 = keep all)."""
    object_weight: float = Field(default=0.0, ge=0)
    """Moving objects decide, inside their boxes, between there and not there, and leave no haze outside (published: 0.1)."""
    ssim_weight: float = Field(default=0.2, ge=0, le=1)
    """Share of structural similarity in the colour term of recorded views; the rest is absolute difference."""
    lidar_weight: float = Field(default=0.1, ge=0)
    """LiDAR depth on recorded views (best 95 % of the points, relative error)."""
    sky_weight: float = Field(default=0.05, ge=0)
    """Sky stays free of Gaussians, on recorded views."""
    semantic_weight: float = Field(default=0.1, ge=0)
    """Classes of recorded views (cross-entropy)."""
    virtual_probability: float = Field(default=0.4, ge=0, le=1)
    """mudg_s: how often a step takes a virtual view (theta; published: 0.2, in place of the recorded one)."""
    virtual_beside: bool = True
    """A step that takes a virtual view learns from its recorded one as well; off: from the virtual one alone, as published."""
    virtual_start: float = Field(default=0.15, ge=0, le=1)
    """mudg_s: share of the iterations before virtual views join."""
    virtual_stop: float = Field(default=0.9, ge=0, le=1)
    """mudg_s: share of the iterations after which only recorded views are taken again, which gives the recorded path back what
    it lost."""
    virtual_grow: float = Field(default=0.0, ge=0, le=1)
    """mudg_s: share of the iterations over which virtual views farther and farther from the recorded path join (0 = all at once)."""
    virtual_seen_weight: float = Field(default=1.0, ge=0, le=1)
    """mudg_s: weight of virtual pixels whose surface a recorded view saw, beside 1 for those that none saw. Lower it for a
    diffusion model that is worse than the scene fitted without it."""
    virtual_confidence_power: float = Field(default=1.0, ge=0)
    """mudg_s: every term of a virtual view is weighted by the observation's confidence to this power (0 = all pixels alike)."""
    virtual_gaussians: int = Field(default=8000, ge=0)
    """mudg_s: at most so many Gaussians start at surfaces that only virtual views show."""
    virtual_densify: bool = False
    """mudg_s: virtual views also decide where Gaussians are added."""
    virtual_color_weight: float = Field(default=1.0, ge=0)
    """mudg_s: colour of virtual views."""
    virtual_ssim_weight: float = Field(default=0.3, ge=0, le=1)
    """mudg_s: share of structural similarity in the colour term, as `ssim_weight` for recorded views."""
    virtual_perceptual_weight: float = Field(default=0.3, ge=0)
    """mudg_s: likeness of virtual views in the eyes of `virtual_perception`."""
    virtual_perception: Literal["filters", "codec", "lpips"] = "filters"
    """mudg_s: in whose eyes renders are like virtual views. filters: fixed ones; codec: the shipped diffusion model's, which is slower;
    lpips: that network, from `lpips_weights`."""
    lpips_weights: str = ""
    """Safetensors file with LPIPS weights (AlexNet, version 0.1, the lpips package's names)."""
    virtual_depth_weight: float = Field(default=0.3, ge=0)
    """mudg_s: dense depth that the diffusion model made, robust and relative."""
    virtual_lidar_weight: float = Field(default=0.2, ge=0)
    """mudg_s: depth of the fused LiDAR points drawn at the virtual views (best 95 % of them, relative error)."""
    virtual_semantic_weight: float = Field(default=0.02, ge=0)
    """Small: the shipped diffusion model tells classes less well than Gaussians that learned them from recorded frames."""
    checkpoint_every: int = Field(default=500, ge=1)
    """Steps per checkpoint."""
    preview_every: int = Field(default=500, ge=1)
    """Steps per preview picture."""
    raster: Literal["auto", "cpu", "torch", "gsplat"] = "auto"
    """Backend of the renderer; auto takes the fastest there is and says which."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RenderConfig:
    """Render a fitted scene on recorded and shifted trajectories."""

    cameras: tuple[str, ...] = ("front",)
    """Cameras to render. Names that the scene lacks are an error; empty = the first camera."""
    shifts_m: tuple[float, ...] = (0.0, 2.0, -2.0, 3.0, -3.0, 4.0, -4.0)
    """Lateral shifts, metres, positive to the left of the direction of travel; 0 = the recorded drive."""
    height_m: float = 0.0
    """Added to the height of shifted cameras."""
    yaw_deg: float = 0.0
    """Turn of shifted cameras about the vertical, counter-clockwise from above."""
    width_px: int = Field(default=0, ge=0)
    """Image width (0 = as recorded)."""
    remove_tracks: tuple[str, ...] = ()
    """Moving objects to leave out."""
    sky_below_alpha: float = Field(default=0.5, ge=0, le=1)
    """Pixels covered less than this are sky: no depth, semantics sky."""
    video: bool = True
    """Also write a video per trajectory."""
    fps: float = Field(default=10.0, gt=0)
    """Pictures per second of the videos."""
    raster: Literal["auto", "cpu", "torch", "gsplat"] = "auto"
    """Backend of the renderer; auto takes the fastest there is and says which."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ScoreConfig:
    """Score renders and generated views against truth where it exists."""

    width_px: int = Field(default=0, ge=0)
    """Width at which everything is compared; the height follows (0 = the size of the scene's camera)."""
    baseline: bool = True
    """Also score the sparse condition with its holes filled by the nearest point: the bar a model has to clear."""
    perceptual_views: int = Field(default=8, ge=0)
    """At so many views of every trajectory, evenly spread, also the perceptual distance, which costs more than all other metrics
    together (0 = never)."""
    lpips_weights: str = ""
    """Safetensors file with LPIPS weights (AlexNet, version 0.1, the lpips package's names), for LPIPS at the same views (empty = not
    computed)."""
    error_pictures: bool = True
    """Write one picture of the colour error for the middle view of every trajectory."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RunConfig:
    """The whole chain. Each verb's settings carry its name as prefix."""

    ingest: IngestConfig = Field(default_factory=IngestConfig)
    annotate: AnnotateConfig = Field(default_factory=AnnotateConfig)
    fuse: FuseConfig = Field(default_factory=FuseConfig)
    synthesize: SynthesizeConfig = Field(default_factory=SynthesizeConfig)
    fit: FitConfig = Field(default_factory=FitConfig)
    render: RenderConfig = Field(default_factory=RenderConfig)
    score: ScoreConfig = Field(default_factory=ScoreConfig)


DEMO_CITY = 3
"""Seed of the city that `mudg demo` shows: a crossing by day, much traffic, a cyclist, a car that turns."""


def run_preset(fast: bool = False) -> RunConfig:
    """The chain's settings before any file or flag; the first camera of whatever scene it is.

    Sized for a few minutes on two cores. ``fast`` trades quality for time: a smaller city, fewer denoising steps and
    iterations.
    """
    config = with_lines(RunConfig(), cameras=())
    frames, width, height, cameras, iterations, steps = 24, 384, 256, config.ingest.city.cameras, 1000, 2
    if fast:
        frames, width, height, cameras, iterations, steps = 12, 240, 160, ("front",), 250, 1
    city = replace(config.ingest.city, seed=DEMO_CITY, n_frames=frames, width=width, height=height, cameras=cameras)
    return replace(
        config,
        ingest=replace(config.ingest, city=city),
        fit=replace(config.fit, iterations=iterations),
        synthesize=replace(config.synthesize, steps=steps),
    )


def with_seed(config: RunConfig, seed: int) -> RunConfig:
    """The same settings with ``seed`` in every verb that draws random numbers."""
    parts = {f.name: getattr(config, f.name) for f in fields(config)}  # type: ignore[arg-type]
    seeded = {n: replace(p, seed=seed) for n, p in parts.items() if any(f.name == "seed" for f in fields(p))}
    seeded["ingest"] = replace(config.ingest, city=replace(config.ingest.city, seed=seed))
    return replace(config, **seeded)


def with_lines(
    config: RunConfig, *, cameras: tuple[str, ...] | None = None, shifts_m: tuple[float, ...] | None = None
) -> RunConfig:
    """The same settings with these cameras (empty = the first) and lateral shifts in synthesize and render.

    Render always adds the recorded path, synthesize leaves it out.
    """
    synthesize, render = config.synthesize, config.render
    if cameras is not None:
        synthesize, render = replace(synthesize, cameras=cameras), replace(render, cameras=cameras)
    if shifts_m is not None:
        moved = tuple(shift for shift in dict.fromkeys(shifts_m) if shift != 0)
        synthesize, render = replace(synthesize, shifts_m=moved), replace(render, shifts_m=(0.0, *moved))
    return replace(config, synthesize=synthesize, render=render)
