"""Settings of ``mudg fit``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

from mudg.base.config import setting, settings
from mudg.base.devices import DeviceName


@settings
class StartConfig:
    """Initial Gaussians."""

    gaussians: int = setting(default=70_000, ge=50)
    """Largest number of static Gaussians taken from the fused cloud; the same limit holds for all objects together."""
    voxel_m: float = setting(default=0.15, gt=0)
    """Static points are thinned to one per cube of this size, in metres (finer close to the recorded path). Smaller
    gives more detail and takes longer."""


@settings
class DensifyConfig:
    """Adding, removing and shaping Gaussians during the fit."""

    kind: Literal["gradient", "none"] = "gradient"
    """gradient: clone, split and prune by image gradients. none: keep the initial number."""
    max_gaussians: int = setting(default=120_000, ge=100)
    """Largest number of Gaussians. More give finer detail and take more time and memory."""
    longest_to_middle: float = setting(default=10.0, ge=1)
    """Largest ratio of a Gaussian's longest axis to its middle axis. Long needles look right on the recorded path only,
    so lower it if shifted views show them."""


@settings
class ObjectConfig:
    """Dynamic objects."""

    deformable: bool = True
    """Let pedestrians and cyclists change shape inside their boxes."""
    mirror_start: bool = True
    """Initialise vehicles with their points mirrored to the side that LiDAR did not measure."""


@settings
class PoseConfig:
    """Correction of the box poses of dynamic objects."""

    learn: bool = False
    """Correct the boxes while fitting (position and yaw at every key of a track). Use it if the boxes are noisy."""
    start: float = setting(default=0.25, ge=0, le=1)
    """Share of the iterations before the first round of corrections, 0 to 1."""
    rounds: int = setting(default=4, ge=0)
    """Number of correction rounds, spread evenly up to 85 % of the iterations (0 = only smooth the tracks)."""


@settings
class AppearanceConfig:
    """Correction of camera poses and exposure while fitting; renders do not use it."""

    exposure: Literal["none", "camera", "image"] = "none"
    """Learn an affine colour map per camera or per recorded image. Use it if exposure or white balance changes during
    the log."""
    cameras: bool = False
    """Correct the camera pose of every recorded image. Use it if calibration or vehicle poses are inaccurate."""


@settings
class DrawingConfig:
    """How Gaussians are drawn while fitting; renders of the fitted scene draw them in the same way."""

    antialias: bool = False
    """Reduce the opacity of Gaussians smaller than a pixel by what the blur of the screen adds to them (Mip-Splatting).
    Use it if renders will be larger, smaller, nearer or further than the recorded images."""


@settings
class RecordedLossConfig:
    """Loss weights of recorded views, and of the terms that every view has. 0 turns a term off."""

    ssim_weight: float = setting(default=0.2, ge=0, le=1)
    """Share of structural similarity (SSIM) in the colour term, 0 to 1; the rest is absolute difference."""
    lidar_weight: float = setting(default=0.1, ge=0)
    """Weight of LiDAR depth (relative error; the worst 5 % of the points are ignored)."""
    sky_weight: float = setting(default=0.05, ge=0)
    """Weight of the term that keeps the sky free of Gaussians, on recorded views."""
    semantic_weight: float = setting(default=0.1, ge=0)
    """Weight of semantic classes (cross-entropy)."""
    semantic_every: int = setting(default=3, ge=1)
    """Learn classes from recorded views at every n-th step only. Classes converge early and cost a third of a step."""
    object_weight: float = setting(default=0.0, ge=0)
    """Weight of the term that makes dynamic objects opaque or empty inside their boxes and removes haze outside
    (published: 0.1)."""
    opacity_weight: float = setting(default=0.0, ge=0)
    """Weight that lowers all opacities, so that Gaussians that no view needs fade. 0.01 helps shifted views of fits
    without generated ones."""


@settings
class VirtualConfig:
    """mudg_s: learning from virtual views. Loss weights of 0 turn a term off."""

    probability: float = setting(default=0.4, ge=0, le=1)
    """Probability that a step uses a virtual view, 0 to 1 (published: 0.2)."""
    continued_probability: float = setting(default=1.0, ge=0, le=1)
    """The same for a fit that continues a finished one (`--start-from`), which has few steps to learn from them."""
    beside: bool = True
    """A step with a virtual view also learns from its recorded view. Off: from the virtual view alone, as published."""
    start: float = setting(default=0.15, ge=0, le=1)
    """Share of the iterations before virtual views are used, 0 to 1. A fit that continues a finished one uses them at
    once."""
    stop: float = setting(default=0.9, ge=0, le=1)
    """Share of the iterations after which virtual views are no longer used, 0 to 1. Ending on recorded views restores
    quality on the recorded path."""
    half_size: float = setting(default=0.8, ge=0, le=1)
    """Share of the iterations up to which virtual views are used at half their size, 0 to 1: faster, with little loss.
    0: always at full size. A fit that continues a finished one begins at 0.5. Views above 2.5 million pixels are never
    used at full size, except with 0."""
    gaussians: int = setting(default=8000, ge=0)
    """Largest number of Gaussians initialised at surfaces that only virtual views show (0 = none)."""
    confidence_power: float = setting(default=0.5, ge=0)
    """Every virtual loss term is weighted by the confidence of the generated pixel, raised to this power (0 = all
    pixels count the same)."""
    color_weight: float = setting(default=0.5, ge=0)
    """Weight of colour."""
    ssim_weight: float = setting(default=0.3, ge=0, le=1)
    """Share of structural similarity (SSIM) in the colour term, 0 to 1."""
    perceptual_weight: float = setting(default=0.15, ge=0)
    """Weight of the perceptual distance, measured by `perception`."""
    perception: Literal["filters", "lpips"] = "filters"
    """Features of the perceptual distance. filters: a fixed filter bank. lpips: the LPIPS network, which needs
    `lpips_weights`."""
    lpips_weights: str = ""
    """Safetensors file with LPIPS weights (AlexNet, version 0.1, tensor names of the lpips package)."""
    depth_weight: float = setting(default=0.3, ge=0)
    """Weight of the generated dense depth (robust relative error)."""
    lidar_weight: float = setting(default=0.2, ge=0)
    """Weight of the fused LiDAR points' depth in virtual views (relative error; the worst 5 % of the points are
    ignored)."""
    sky_weight: float = setting(default=0.05, ge=0)
    """Weight of the term that keeps the generated sky free of Gaussians (published: none)."""
    semantic_weight: float = setting(default=0.02, ge=0)
    """Weight of generated classes (cross-entropy). It is small because Gaussians that learned from recorded frames know
    classes better than the shipped diffusion model."""


@settings
class RadianceConfig:
    """Method emernerf (``baselines/emernerf.py``)."""

    size: Literal["small", "published", "tiny"] = "small"
    """emernerf: sizes of the networks, and numbers of rays and samples (docs/baselines.md)."""


@settings
class FitConfig:
    """Fit a dynamic Gaussian scene to recorded and, optionally, virtual views."""

    method: Literal[
        "gs3d", "street_gaussians", "pvg", "omnire", "s3gaussian", "bezier", "emernerf", "difix", "mudg_s"
    ] = "mudg_s"
    """What is fitted. gs3d: static Gaussians only. street_gaussians: static world, dynamic objects and sky. mudg_s: the
    same, supervised by virtual views. pvg, s3gaussian, emernerf (without boxes), omnire, bezier, difix (which learns
    from repaired renders): published methods for comparison (docs/baselines.md)."""
    iterations: int = setting(default=2000, ge=1, le=1_000_000)
    """Optimisation steps, each with one recorded view (mudg_s: sometimes a virtual view too). Learning rates and
    schedules adapt to this number. With `--start-from`: further steps, the second half of a schedule of twice as
    many."""
    seed: int = 0
    """Seed of all random numbers; the same seed gives the same result."""
    cameras: tuple[str, ...] = ()
    """Cameras whose recorded images are fitted (empty = all)."""
    width_px: int = setting(default=0, ge=0)
    """Image width in pixels while fitting; the height follows (0 = as recorded). Lower it to save time and memory."""
    sh_degree: int = setting(default=0, ge=0, le=3)
    """Degree of the spherical harmonics for view-dependent colour. On short drives every degree above 0 overfits to the
    recorded path."""
    semantics: bool = True
    """Learn semantic classes where the scene has labels."""
    raster: Literal["auto", "cpu", "torch", "gsplat"] = "auto"
    """Rasteriser backend. auto picks the fastest one available and prints its name."""
    device: DeviceName = "auto"
    """Device: auto (CUDA if there is one), cpu, cuda, cuda:N."""
    checkpoint_every: int = setting(default=500, ge=1)
    """Steps between checkpoints; an interrupted fit resumes at the last one. Large ones are rarer: they take at most a
    twentieth of the time."""
    preview_every: int = setting(default=500, ge=1)
    """Steps between preview images."""
    start: StartConfig = setting(default_factory=StartConfig)
    densify: DensifyConfig = setting(default_factory=DensifyConfig)
    objects: ObjectConfig = setting(default_factory=ObjectConfig)
    poses: PoseConfig = setting(default_factory=PoseConfig)
    appearance: AppearanceConfig = setting(default_factory=AppearanceConfig)
    drawing: DrawingConfig = setting(default_factory=DrawingConfig)
    loss: RecordedLossConfig = setting(default_factory=RecordedLossConfig)
    virtual: VirtualConfig = setting(default_factory=VirtualConfig)
    radiance: RadianceConfig = setting(default_factory=RadianceConfig)


# methods ------------------------------------------------------------------------------------------
#
# The methods that can be compared, as rows of plain values. Only what works is listed. Every method ends in folders of
# observations on named trajectories, so that one scorer serves all: it either fits a scene (``mudg fit``) and renders
# it, or generates its views directly (``mudg synthesize``).


@dataclass(frozen=True)
class Method:
    """One row. ``title``: for tables. ``made_by``: the verb that produces its views (``render`` after ``fit``, or
    ``synthesize``). ``nodes``: what its scene consists of (objects: a node per dynamic track); empty for a method
    without a scene. ``supervision``: what its scene learns from; virtual: the views of mudg_r; repaired: its own
    renders beside the path, repaired. ``scene``: what its scene is made of: Gaussians, or a radiance field that is
    marched along rays. ``boxes``: whether it knows the tracked boxes, of the scene and of the fused clouds."""

    title: str
    made_by: Literal["render", "synthesize"]
    nodes: tuple[Literal["static", "objects", "sky"], ...] = ()
    supervision: tuple[Literal["color", "semantics", "lidar", "sky", "virtual", "repaired"], ...] = ()
    scene: Literal["gaussians", "radiance"] = "gaussians"
    boxes: bool = True

    @property
    def learns_virtual(self) -> bool:
        """Whether its fit learns from views that no camera recorded."""
        return bool({"virtual", "repaired"} & set(self.supervision))


_STREET: Final = ("color", "semantics", "lidar", "sky")
_WHOLE: Final = ("static", "objects", "sky")

METHODS: Final[dict[str, Method]] = {
    "gs3d": Method("3D Gaussians, static", "render", ("static",), ("color", "semantics"), boxes=False),
    "street_gaussians": Method("Gaussians without diffusion", "render", _WHOLE, _STREET),
    "pvg": Method("PVG, our sky model", "render", ("static", "sky"), _STREET, boxes=False),
    "s3gaussian": Method(
        "S3Gaussian without features", "render", ("static",), ("color", "semantics", "lidar"), boxes=False
    ),
    "bezier": Method("BezierGS", "render", _WHOLE, _STREET),
    "omnire": Method("OmniRe without SMPL", "render", _WHOLE, _STREET),
    "emernerf": Method("EmerNeRF, small", "render", (), ("color", "lidar", "sky"), "radiance", boxes=False),
    "difix": Method("Difix3D scheme, our network, no last repair", "render", _WHOLE, (*_STREET, "repaired")),
    "mudg_r": Method("Diffusion output", "synthesize"),
    "mudg_s": Method("Gaussians with diffusion", "render", _WHOLE, (*_STREET, "virtual")),
}

PUBLISHED: Final = ("pvg", "s3gaussian", "bezier", "omnire", "emernerf", "difix")
"""Published methods for comparison, fitted to recorded views alone; difix goes on under repaired renders."""

WEIGHTS: Final[Mapping[str, tuple[str, ...]]] = {
    "pvg": ("loss.lidar_weight", "loss.sky_weight"),
    "s3gaussian": ("loss.lidar_weight", "loss.ssim_weight"),
    "bezier": ("loss.lidar_weight",),
    "omnire": ("loss.lidar_weight",),
}
"""Settings in whose place a method has published weights of its own; they must keep their defaults."""
_OBJECTS: Final = ("poses.learn", "objects.deformable", "loss.object_weight")
UNFIT: Final[Mapping[str, tuple[str, ...]]] = {
    "bezier": _OBJECTS,
    **dict.fromkeys(("gs3d", "pvg", "s3gaussian"), (*_OBJECTS, "objects.mirror_start")),
}
"""Other settings that mean nothing to a method and must keep their defaults."""
_REPAIRS: Final = (
    *("probability", "continued_probability", "gaussians", "color_weight", "ssim_weight", "perceptual_weight"),
    *("perception", "lpips_weights", "depth_weight", "lidar_weight", "semantic_weight"),
)
"""Settings of virtual views that ``difix`` chooses itself."""
_OF_ALL: Final = frozenset("method iterations seed cameras width_px device checkpoint_every preview_every".split())
"""Settings that methods without Gaussians have, too."""


def has_setting(method: str, name: str) -> bool:
    """Whether a setting of a fit, by its dotted name, applies to a method."""
    row, (group, _, field) = METHODS[method], name.partition(".")
    if row.scene == "radiance":
        return name in _OF_ALL or group == "radiance"
    if group == "virtual":
        return row.learns_virtual and (method != "difix" or field not in _REPAIRS)
    foreign = name in (*WEIGHTS.get(method, ()), *UNFIT.get(method, ())) or group == "radiance"
    return not foreign and (row.boxes or group not in ("poses", "objects"))
