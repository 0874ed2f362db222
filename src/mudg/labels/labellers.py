"""The labellers of ``mudg annotate``.

* ``geometry``: rules on LiDAR, tracked boxes and colour (``by_geometry.py``). No parameters.
* ``embedded``: classes from the small shipped network, which reads image and ``evidence.py`` (``street_net.py``).
* ``network``: classes from a segmentation network in a folder (``segmenters.py``).

Depth and dynamic objects are found in the same way for all three.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from mudg.base.errors import UsageError
from mudg.labels.by_geometry import label_by_geometry, label_by_network
from mudg.labels.inputs import Labeller
from mudg.labels.segmenters import Segmenter
from mudg.labels.street_net import StreetLabeller
from mudg.networks.folders import CPU, Compute


def _network(weights: str, compute: Compute) -> Labeller:
    segmenter = Segmenter.load(weights, compute)
    return lambda given: label_by_network(given, *segmenter.classes(given.rgb))


LABELLERS: Mapping[str, Callable[[str, Compute], Labeller]] = {
    "geometry": lambda *_: label_by_geometry,
    "embedded": StreetLabeller.load,
    "network": _network,
}
"""Name -> what makes a labeller of one image from a folder of weights and a place to compute (unused by those that hold
no parameters)."""


def labeller(name: str, weights: str = "", compute: Compute = CPU) -> Labeller:
    """A labeller of the table, ready for use.

    Raises:
        UsageError: no such labeller. ResourceError: its weights, or the packages that read them, are missing.
    """
    if name not in LABELLERS:
        raise UsageError("there is no such labeller", expected=", ".join(LABELLERS), got=name)
    return LABELLERS[name](weights, compute)
