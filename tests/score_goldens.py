"""Features of the networks of the scores on made-up weights and three made-up images, as the recorded file holds them.

``PYTHONPATH=src:tests python tests/score_goldens.py`` writes ``tests/golden/score_networks.safetensors`` anew.
tools/oracle_parity.py holds the same networks against the packages of published numbers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import toy_inception
from test_i3d import made_up

from mudg.base import store
from mudg.networks import i3d, inception

PATH = Path(__file__).parent / "golden" / "score_networks.safetensors"
KEPT = 48
"""Values of each feature vector that are recorded."""


def pictures() -> list[np.ndarray]:
    """Three images u8[96, 160, 3]: coarse blocks under noise."""
    rng = np.random.default_rng(7)
    coarse = rng.integers(0, 128, (3, 12, 20, 3), dtype=np.uint8)
    fine = rng.integers(0, 128, (3, 96, 160, 3), dtype=np.uint8)
    return [np.kron(a, np.ones((8, 8, 1), np.uint8)) + b for a, b in zip(coarse, fine, strict=True)]


@torch.no_grad()
def inception_values() -> dict[str, np.ndarray]:
    """Features of FID's network, and the lengths of the rows of its last layer."""
    state = toy_inception.state()
    found = inception.InceptionFeatures(state)(torch.stack([inception.prepared(p, "pytorch-fid") for p in pictures()]))
    rows = state["fc.weight"].norm(dim=1).numpy()
    return {"inception.2048": found[:, :KEPT].numpy(), "inception.fc_row_norms": rows}


@torch.no_grad()
def i3d_values() -> dict[str, np.ndarray]:
    """FVD's features of a clip of nine frames."""
    frames = torch.stack([i3d.prepared_frame(pictures()[n % 3], "videogpt") for n in range(9)], 1)
    return {"i3d.400": i3d.I3DFeatures(made_up())(frames[None])[:, : 4 * KEPT].numpy()}


if __name__ == "__main__":
    torch.set_num_threads(1)
    store.write_safetensors(PATH, {**inception_values(), **i3d_values()})
