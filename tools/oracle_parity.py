"""Compare the networks and distances of the scores with the packages that published numbers are made with, on made-up
weights.

    python -m venv oracle && oracle/bin/pip install torch numpy scipy pillow tqdm
    oracle/bin/pip install --no-deps torchvision==0.28.0 pytorch-fid==0.3.0 torch-fidelity==0.4.0 lpips==0.1.4
    PYTHONPATH=src:tests oracle/bin/python tools/oracle_parity.py

Nothing is downloaded and no published weight is needed: both sides get the same random weights, so that equal features
mean equal networks. None of these packages is a dependency. Prints a Markdown table; ends with an error if a difference
is larger than expected.
"""

from __future__ import annotations

import importlib.metadata
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import toy_inception

warnings.filterwarnings("ignore")
LIBRARY = torch.library.Library("torchvision", "DEF")  # the CUDA build of torchvision asks for them when it is imported
for name in ("nms", "qnms"):
    LIBRARY.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

TOLERANCE = 1e-5
ROWS: list[tuple[str, str, float, float]] = []


def apart(a: torch.Tensor, b: torch.Tensor) -> float:
    """Largest difference over the largest value."""
    return float((a.double() - b.double()).abs().max() / b.double().abs().max())


def note(what: str, oracle: str, difference: float, limit: float = TOLERANCE) -> None:
    """Keep a row of the table."""
    ROWS.append((what, oracle, difference, limit))


def pictures(count: int, height: int = 128, width: int = 192) -> list[np.ndarray]:
    """Smooth random images u8."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (count, height // 8, width // 8, 3), dtype=np.uint8)
    fine = rng.integers(0, 128, (count, height, width, 3), dtype=np.uint8)
    return [np.kron(a, np.ones((8, 8, 1), np.uint8)) // 2 + b for a, b in zip(coarse, fine, strict=True)]


@torch.no_grad()
def inception() -> None:
    """FID's network, two resize rules, and the distances."""
    import pytorch_fid.fid_score
    import pytorch_fid.inception
    import torch_fidelity.metric_kid
    from torch_fidelity.feature_extractor_inceptionv3 import FeatureExtractorInceptionV3

    from mudg.core import feature_distances
    from mudg.networks import inception as ours

    state = toy_inception.state()
    network = ours.InceptionFeatures(state)
    images = pictures(3)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "weights.pth"
        torch.save(state, path)
        fidelity = FeatureExtractorInceptionV3("inception", ["2048"], feature_extractor_weights_path=str(path))
    given = torch.stack([torch.from_numpy(image) for image in images]).permute(0, 3, 1, 2)
    made = network(torch.stack([ours.prepared(image, "tf1") for image in images]))
    note("Inception, rule tf1", "torch-fidelity", apart(made, fidelity(given)[0]))
    pytorch_fid.inception.load_state_dict_from_url = lambda *_, **__: state
    other = pytorch_fid.inception.InceptionV3([3]).eval()
    made = network(torch.stack([ours.prepared(image, "pytorch-fid") for image in images]))
    found = other(given.float() / 255)[0].mean((2, 3))
    note("Inception, rule pytorch-fid", "pytorch-fid", apart(made, found))
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((300, 64)), 1.2 * rng.standard_normal((280, 64)) + 0.1
    theirs = pytorch_fid.fid_score.calculate_frechet_distance(a.mean(0), np.cov(a.T), b.mean(0), np.cov(b.T))
    note("Frechet distance, 64 values", "pytorch-fid", abs(feature_distances.frechet_distance(a, b) / theirs - 1), 1e-9)
    kernels = [torch_fidelity.metric_kid.kernel_poly(x, y) for x, y in ((a[:280], a[:280]), (a[:280], b), (b, b))]
    found = torch_fidelity.metric_kid.mmd2(*kernels)
    note("kernel distance", "torch-fidelity", abs(feature_distances.kernel_distance(a[:280], b) / found - 1), 1e-9)


@torch.no_grad()
def lpips() -> None:
    """The networks of LPIPS with the heads of the package."""
    import lpips as package

    from mudg.core.metrics import Pair
    from mudg.networks.featnets import TRUNKS, LpipsFeatures, PerceptualDistance

    first, second = (torch.from_numpy(image).permute(2, 0, 1).float() / 255 for image in pictures(2, 96, 120))
    for trunk in TRUNKS:
        torch.manual_seed(0)
        model = package.LPIPS(net=trunk, pnet_rand=True, verbose=False).eval()
        network = LpipsFeatures(model.state_dict(), "package", trunk)
        made = PerceptualDistance(network, network.channel_weights)(Pair(first, None, None, second, None, None, None))
        note(f"LPIPS, {trunk}", "lpips", abs(made / float(model(first[None] * 2 - 1, second[None] * 2 - 1)) - 1))


def main() -> int:
    """Run all comparisons that the installed packages allow."""
    parts: dict[str, Callable[[], None]] = {"inception": inception, "lpips": lpips}
    for part in parts.values():
        part()
    print("| what | oracle | relative difference | limit |\n|---|---|---|---|")
    for what, oracle, difference, limit in ROWS:
        print(f"| {what} | {oracle} | {difference:.1e} | {limit:.0e} |")
    names = ("torch", "torchvision", "pytorch-fid", "torch-fidelity", "lpips")
    print("\n" + ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names))
    return int(any(difference > limit for _, _, difference, limit in ROWS))


if __name__ == "__main__":
    sys.exit(main())
