"""Settings of ``mudg fit``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT


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
    mirror_start: bool = True
    """Start vehicles with their points mirrored to the side that nothing measured."""
    exposure: Literal["none", "camera", "image"] = "none"
    """Learn an affine colour map per camera, or per recorded image; not used in renders."""
    exposure_weight: float = Field(default=0.01, ge=0)
    """Pull of colour maps, of recorded and virtual views, towards the identity."""
    learn_cameras: bool = False
    """Correct the pose of every recorded image while fitting; not used in renders."""
    virtual_appearance: bool = False
    """mudg_s: learn an affine colour map per set of virtual views, so that their colours do not reach the recorded path."""
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
