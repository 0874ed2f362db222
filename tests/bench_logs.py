"""Short logs of generated cities, as scenes without held-out frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mudg.city.config import CityConfig
from mudg.formats import ingest
from mudg.formats.settings import IngestConfig
from mudg.scene.settings import FuseConfig
from mudg.steps.ingest import Fuse, Ingest


def city_scene(out: Path, **city: Any) -> Path:
    """The scene of a city with these settings."""
    usual = {"seed": 2100000, "width": 64, "height": 48, "cameras": ("front",), "lidar_azimuth_step_deg": 1.0}
    settings = IngestConfig(test_every=0, contact_sheet=False, city=CityConfig(**{**usual, **city}))
    return Ingest(log=ingest.CITY, out=out, settings=settings).run()


def fused(scene: Path, out: Path) -> Path:
    """Its clouds."""
    return Fuse(scene=scene, out=out, settings=FuseConfig()).run()
