"""Settings of ``mudg page`` and ``mudg view``."""

from __future__ import annotations

from mudg.base.config import setting, settings
from mudg.base.devices import DeviceName


@settings
class PageConfig:
    """What a viewer page holds."""

    method: str = ""
    """Fit of a run to show (empty = the best one: mudg_s, else street_gaussians)."""
    budget: int = setting(default=3_000_000, ge=0)
    """Most Gaussians on the page (0 = all). Where a fit has more, those that the recorded cameras would see smallest
    and faintest are left out."""
    images: int = setting(default=150, ge=0)
    """Most recorded images on the page, taken evenly."""


@settings
class ViewConfig(PageConfig):
    """What ``mudg view`` shows, and where."""

    budget: int = setting(default=0, ge=0)
    """Most Gaussians on the page (0 = all)."""
    port: int = setting(default=0, ge=0, le=65535)
    """Port to listen on (0 = any free one)."""
    host: str = "127.0.0.1"
    """Address to listen on. Any other than this machine's own loopback needs --token."""
    token: str = ""
    """Secret that the address of the page carries; who does not know it gets nothing (empty: a random one on the
    loopback address)."""
    browser: bool = True
    """Open the page in a browser where there is one."""
    repair: bool = False
    """Let the diffusion model make every exact frame once more, and mix both by its confidence: half a second a frame.
    For the drive as it was fitted; frames with edits, or with objects hidden, are as rendered."""
    width_px: int = setting(default=1600, ge=16, le=8192)
    """Widest exact frame, pixels."""
    device: DeviceName = "auto"
    """Device: auto (CUDA if there is one), cpu, cuda, cuda:N."""
