"""Settings of ``mudg serve``."""

from __future__ import annotations

from mudg.base.config import setting, settings
from mudg.base.devices import DeviceName


@settings
class ServeConfig:
    """How a reconstruction is served to simulators."""

    host: str = "127.0.0.1"
    """Address to listen on. Any other than this machine's own loopback needs --token."""
    port: int = setting(default=0, ge=0, le=65535)
    """Port to listen on (0 = any free one)."""
    token: str = ""
    """Secret that clients send as `authorization: Bearer TOKEN` (empty: none, on the loopback address alone)."""
    metrics_port: int = setting(default=-1, ge=-1, le=65535)
    """Port on the loopback address for metrics in Prometheus' format (-1 = none, 0 = any free one)."""
    device: DeviceName = "auto"
    """Device: auto (CUDA if there is one), cpu, cuda, cuda:N."""
