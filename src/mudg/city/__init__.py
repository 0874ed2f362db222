"""The procedural city: a driving log with exact truth at any view.

    world = CityWorld(CityConfig(seed=7))
    truth = world.render(view)          # any pose and size, any time of the log
    scene = write_city(CityConfig(seed=7), Path("scene"))

Importing this loads neither torch nor the native library.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mudg.city.config import CityConfig

if TYPE_CHECKING:
    from mudg.city.logs import write_city
    from mudg.city.world import CitySweep, CityTruth, CityWorld

__all__ = ["CityConfig", "CitySweep", "CityTruth", "CityWorld", "write_city"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from mudg.city import logs, world

    return getattr(logs if name == "write_city" else world, name)
