"""Settings of ``mudg edit``, ``mudg render`` and ``mudg score``."""

from __future__ import annotations

from typing import Literal

from mudg.base.config import setting, settings
from mudg.base.devices import DeviceName


@settings
class EditConfig:
    """Change a drive as an edit script says."""

    raster: Literal["auto", "cpu", "torch", "gsplat"] = "auto"
    """Rasteriser backend. auto picks the fastest one available and prints its name."""
    device: DeviceName = "auto"
    """Device: auto (CUDA if there is one), cpu, cuda, cuda:N."""


@settings
class RenderConfig:
    """Render a fitted scene on recorded and shifted trajectories."""

    cameras: tuple[str, ...] = ("front",)
    """Cameras to render (empty = the first camera). A name that the scene lacks is an error."""
    shifts_m: tuple[float, ...] = (0.0, 2.0, -2.0, 3.0, -3.0, 4.0, -4.0)
    """Lateral shifts in metres, positive to the left of the direction of travel; 0 = the recorded path."""
    paths: tuple[str, ...] = ()
    """Further paths by name. up+1: raised by 1 m. lane+0.1: a lane change, 0.1 m further to the left with every frame.
    speed+0.1: 0.1 m further ahead with every frame. A minus means down, right, slower."""
    width_px: int = setting(default=0, ge=0)
    """Image width in pixels (0 = as recorded); the height follows."""
    fov_deg: float = setting(default=0.0, ge=0, lt=170)
    """Horizontal field of view in degrees (0 = the camera's own)."""
    lidar: str = ""
    """Also simulate the log's LiDAR sweeps at every shift: a sensor of the scene, pandar128, at128, hdl64, vlp16, or a
    JSON file of beams (docs/simulator.md). Empty = none."""
    layers: tuple[Literal["instances", "normals", "motion", "distance", "confidence"], ...] = ()
    """Also write these layers of every view, with its boxes and its trust: ids of objects, normals of surfaces, optical
    flow to the next view in pixels, distance along the ray in metres, and how certain a pixel is (docs/datasets.md)."""
    video: bool = True
    """Also write one MP4 video per trajectory."""
    repair: bool = False
    """Let the diffusion model make every view once more from its render, and mix both by its confidence and by the
    distance from the recorded path. Better off the path, slower: half a second a view (docs/edit/repair.md)."""
    repair_model: str = "embedded"
    """Diffusion model of --repair: "embedded" or "embedded-tiny", both shipped with the package, or a folder written by
    learn."""
    raster: Literal["auto", "cpu", "torch", "gsplat"] = "auto"
    """Rasteriser backend. auto picks the fastest one available and prints its name."""
    device: DeviceName = "auto"
    """Device: auto (CUDA if there is one), cpu, cuda, cuda:N."""


@settings
class ScoreConfig:
    """Score rendered and generated views against ground truth where it exists."""

    width_px: int = setting(default=0, ge=0)
    """Image width in pixels at which everything is compared; the height follows (0 = the size of the scene's
    camera)."""
    baseline: bool = True
    """Also score a baseline without learning: the fused points, with every hole filled by the nearest point."""
    perceptual_views: int = setting(default=8, ge=0)
    """Number of views per trajectory, evenly spread, at which the perceptual distance is computed (0 = none). It costs
    more than all other metrics together."""
    lpips_weights: str = ""
    """Safetensors file with LPIPS weights (AlexNet, version 0.1, tensor names of the lpips package). LPIPS is computed
    at the same views as the perceptual distance (empty = not computed)."""
    lpips_vgg_weights: str = ""
    """The same for LPIPS with VGG-16 (empty = not computed)."""
    lpips_input: Literal["correct", "unscaled"] = "correct"
    """Range of the colours that LPIPS gets. unscaled: 0 to 1 where -1 to 1 belongs, as much published code of Gaussian
    scenes has it; only to compare with its numbers."""
    fid_weights: str = ""
    """File with the weights of FID's Inception-v3 network (`pt_inception-2015-12-05-6726825d.pth`, or its tensors as
    safetensors). FID and KID then compare all views with the recorded frames of the same camera (empty = not
    computed)."""
    fid_resize: Literal["pytorch-fid", "tf1", "clean", "tm", "neurad"] = "pytorch-fid"
    """How FID's network gets its 299 x 299 pixels: as pytorch-fid, torch-fidelity (tf1), clean-fid (clean),
    torchmetrics (tm) or neurad-studio (neurad) do it. Numbers of different rules cannot be compared."""
    fvd_weights: str = ""
    """File with the weights of FVD's I3D network (Kinetics-400), as safetensors, a state dict or the TorchScript
    archive. FVD then compares clips of 16 views with those of the recorded video of the same camera (empty = not
    computed)."""
    fvd_resize: Literal["videogpt", "google", "stylegan-v"] = "videogpt"
    """How FVD's network gets its 224 x 224 pixels: shorter side and crop (videogpt), or squashed (google,
    stylegan-v)."""
    detections: str = ""
    """File with boxes that a detector found in the views, as COCO results. NTA-IoU is then computed (empty = not
    computed)."""
    lanes: str = ""
    """Folder with lane masks that a detector made of the views, METHOD/TRAJECTORY/000000.png. NTL-IoU is then computed
    (empty = not computed). Generated cities only: prepared logs have no lane lines."""
    error_pictures: bool = True
    """Write an image of the colour error at the middle view of every trajectory."""
    device: DeviceName = "auto"
    """Device of the networks behind perceptual distance, LPIPS, FID and FVD: auto (CUDA if there is one),
    cpu, cuda, cuda:N. All other metrics run on the CPU."""
