"""Settings of ``mudg fit``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT


@dataclass(frozen=True, kw_only=True, config=STRICT)
class StartConfig:
    """What the fit starts from."""

    gaussians: int = Field(default=70_000, ge=50)
    """Upper bound for the static points taken from the fused cloud, and for those of all objects together."""
    voxel_m: float = Field(default=0.15, gt=0)
    """Static points are thinned to one per cube of this size (finer close to the drive)."""
    far_m: float = Field(default=150.0, gt=1)
    """Distance of what is neither sky nor within LiDAR reach."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class DensifyConfig:
    """How the number and the shape of Gaussians change."""

    kind: Literal["gradient", "mcmc", "none"] = "gradient"
    """gradient: clone, split and prune by screen gradients; mcmc: move those that do nothing, grow to max_gaussians; none: as they
    start."""
    max_gaussians: int = Field(default=120_000, ge=100)
    """Gaussians are added up to this number."""
    longest_to_middle: float = Field(default=10.0, ge=1)
    """A Gaussian's longest axis is kept within this factor of its middle one: needles look right along the recorded path only."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ObjectConfig:
    """Dynamic objects."""

    deformable: bool = True
    """Let people and cyclists change their shape within their boxes."""
    mirror_start: bool = True
    """Start vehicles with their points mirrored to the side that nothing measured."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class PoseConfig:
    """Correction of the boxes of dynamic objects."""

    learn: bool = False
    """Correct the boxes while fitting (offset and yaw per key)."""
    start: float = Field(default=0.25, ge=0, le=1)
    """Share of the iterations before the first round of corrections."""
    rounds: int = Field(default=4, ge=0)
    """Rounds of corrections, spread evenly up to 85 % of the iterations (0 = only take the noise out of the tracks)."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class AppearanceConfig:
    """Corrections of cameras and colours; not used in renders."""

    exposure: Literal["none", "camera", "image"] = "none"
    """Learn an affine colour map per camera, or per recorded image."""
    exposure_weight: float = Field(default=0.01, ge=0)
    """Pull of colour maps, of recorded and virtual views, towards the identity."""
    cameras: bool = False
    """Correct the pose of every recorded image while fitting."""
    virtual: bool = False
    """mudg_s: learn an affine colour map per set of virtual views, so that their colours do not reach the recorded path."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RecordedLossConfig:
    """Weights of the loss terms of recorded views, and of those that every view has."""

    ssim_weight: float = Field(default=0.2, ge=0, le=1)
    """Share of structural similarity in the colour term; the rest is absolute difference."""
    lidar_weight: float = Field(default=0.1, ge=0)
    """LiDAR depth (best 95 % of the points, relative error)."""
    sky_weight: float = Field(default=0.05, ge=0)
    """Sky stays free of Gaussians, on recorded and virtual views."""
    semantic_weight: float = Field(default=0.1, ge=0)
    """Classes (cross-entropy)."""
    semantic_every: int = Field(default=3, ge=1)
    """Recorded views render and learn classes at every n-th step only (they converge early and cost a third of a step)."""
    object_weight: float = Field(default=0.0, ge=0)
    """Dynamic objects decide, inside their boxes, between there and not there, and leave no haze outside (published: 0.1)."""
    opacity_weight: float | None = Field(default=None, ge=0)
    """Pulls all opacities down, so that what no view needs fades (unset = 0.01 with mcmc, else 0)."""
    scale_weight: float | None = Field(default=None, ge=0)
    """Pulls all sizes down, per metre (unset = 0.001 with mcmc, else 0)."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class VirtualConfig:
    """mudg_s: what is learnt from virtual views, and when."""

    probability: float = Field(default=0.4, ge=0, le=1)
    """How often a step takes a virtual view (theta; published: 0.2, in place of the recorded one)."""
    beside: bool = True
    """A step that takes a virtual view learns from its recorded one as well; off: from the virtual one alone, as published."""
    start: float = Field(default=0.15, ge=0, le=1)
    """Share of the iterations before virtual views join."""
    stop: float = Field(default=0.9, ge=0, le=1)
    """Share of the iterations after which only recorded views are taken again, which gives the recorded path back what it lost."""
    gaussians: int = Field(default=8000, ge=0)
    """At most so many Gaussians start at surfaces that only virtual views show."""
    densify: bool = False
    """Virtual views also decide where Gaussians are added."""
    confidence_power: float = Field(default=1.0, ge=0)
    """Every term is weighted by the observation's confidence to this power (0 = all pixels alike)."""
    color_weight: float = Field(default=1.0, ge=0)
    """Colour."""
    ssim_weight: float = Field(default=0.3, ge=0, le=1)
    """Share of structural similarity in the colour term."""
    perceptual_weight: float = Field(default=0.3, ge=0)
    """Perceptual distance, measured by `perception`."""
    perception: Literal["filters", "codec", "lpips"] = "filters"
    """Features that renders and virtual views are compared by. filters: fixed ones; codec: the shipped diffusion model's, which is
    slower; lpips: that network, from `lpips_weights`."""
    lpips_weights: str = ""
    """Safetensors file with LPIPS weights (AlexNet, version 0.1, the lpips package's names)."""
    depth_weight: float = Field(default=0.3, ge=0)
    """Dense depth that the diffusion model made, robust and relative."""
    lidar_weight: float = Field(default=0.2, ge=0)
    """Depth of the fused LiDAR points drawn at the virtual views (best 95 % of them, relative error)."""
    semantic_weight: float = Field(default=0.02, ge=0)
    """Classes (cross-entropy). Small: the shipped diffusion model tells classes less well than Gaussians that learned them from
    recorded frames."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class FitConfig:
    """Fit a dynamic Gaussian scene to recorded, and optionally virtual, views."""

    MOVED: ClassVar[Mapping[str, str | None]] = {
        "initial_gaussians": "start.gaussians", "voxel_m": "start.voxel_m", "far_m": "start.far_m", "densify": "densify.kind",
        "max_gaussians": "densify.max_gaussians", "longest_to_middle": "densify.longest_to_middle", "deformable": "objects.deformable",
        "mirror_start": "objects.mirror_start", "learn_poses": "poses.learn", "pose_start": "poses.start", "pose_rounds": "poses.rounds",
        "exposure": "appearance.exposure", "exposure_weight": "appearance.exposure_weight", "learn_cameras": "appearance.cameras",
        "virtual_appearance": "appearance.virtual", "lpips_weights": "virtual.lpips_weights",
        **{name: f"loss.{name}" for name in (
            "ssim_weight", "lidar_weight", "sky_weight", "semantic_weight", "semantic_every", "object_weight", "opacity_weight",
            "scale_weight",
        )},
        **{f"virtual_{name}": f"virtual.{name}" for name in (
            "probability", "beside", "start", "stop", "gaussians", "densify", "confidence_power", "color_weight", "ssim_weight",
            "perceptual_weight", "perception", "depth_weight", "lidar_weight", "semantic_weight",
        )},
        **dict.fromkeys(("selective_adam", "color_terms", "mirror_probability", "outlier_deviations", "virtual_grow",
                         "virtual_seen_weight")),
    }  # fmt: skip

    method: Literal["gs3d", "street_gaussians", "mudg_s"] = "mudg_s"
    """Which nodes and which supervision (see the table of methods)."""
    iterations: int = Field(default=2000, ge=1, le=1_000_000)
    """Optimisation steps, one recorded view each (mudg_s: see virtual). Schedules and learning rates follow this number."""
    seed: int = 0
    """Fixes every random draw."""
    cameras: tuple[str, ...] = ()
    """Cameras whose recorded frames are fitted; empty = all."""
    width_px: int = Field(default=0, ge=0)
    """Width of the recorded images while fitting; the height follows (0 = as recorded)."""
    sh_degree: int = Field(default=0, ge=0, le=3)
    """Bands of view-dependent colour. On short drives every band above 0 overfits to the recorded path."""
    semantics: bool = True
    """Carry class logits on every Gaussian where labels exist."""
    raster: Literal["auto", "cpu", "torch", "gsplat"] = "auto"
    """Backend of the renderer; auto takes the fastest there is and says which."""
    checkpoint_every: int = Field(default=500, ge=1)
    """Steps per checkpoint."""
    preview_every: int = Field(default=500, ge=1)
    """Steps per preview picture."""
    start: StartConfig = Field(default_factory=StartConfig)
    densify: DensifyConfig = Field(default_factory=DensifyConfig)
    objects: ObjectConfig = Field(default_factory=ObjectConfig)
    poses: PoseConfig = Field(default_factory=PoseConfig)
    appearance: AppearanceConfig = Field(default_factory=AppearanceConfig)
    loss: RecordedLossConfig = Field(default_factory=RecordedLossConfig)
    virtual: VirtualConfig = Field(default_factory=VirtualConfig)
