"""Settings of ``mudg synthesize``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from mudg.base.config import setting, settings
from mudg.base.devices import DeviceName


@settings
class SynthesizeConfig:
    """Generate dense RGB, depth and semantics on laterally shifted trajectories with the diffusion model."""

    RETIRED: ClassVar[Mapping[str, tuple[str, Any]]] = {
        "samples": ("condition", 1),
        "label_confidence": ("align_depth", 0.5),
        "held_out_images": ("precision", False),
    }

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
    sampler: Literal["ddim", "dpm_solver"] = "ddim"
    """Sampler of the diffusion model. ddim: first order, with fresh noise between steps. dpm_solver: second order and
    deterministic, for many steps. Both cost one network pass per step."""
    eta: float | None = setting(default=None, ge=0, le=1)
    """Sampler ddim: noise added between steps, from 0 (deterministic) to 1 (as much as the reverse process has) (not
    given: 1)."""
    condition: Literal["full", "reference", "points", "concat", "freevs", "repair"] = "full"
    """Which parts of the model's condition are given, to measure what each brings. reference: the nearest recorded
    image alone. points: LiDAR points alone. concat: both, without images warped by depth (published-type models: the
    image in frame 0, not in the image tokens). The shipped models were trained on whole conditions. freevs: the
    condition of FreeVS, for models learned with `--data.condition freevs`; gives colour alone. repair: renders of
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
    precision: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
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
    offload: bool = False
    """Published-type models: keep the image tower (1.3 GB in bfloat16) on the CPU except while it reads a reference.
    Done without being asked where a memory budget needs it."""
    compiled: bool = False
    """Published-type models: compile the denoising network (torch.compile). The first step then takes minutes, further
    ones less."""
    seed: int = 0
    """Seed of the noise."""
