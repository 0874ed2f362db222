"""Make the pictures of docs/gallery.md from a finished `mudg demo`, and copy its two pages for the site.

mudg demo --out mudg_demo
python tools/gallery.py mudg_demo
python tools/gallery.py mudg_demo --pages docs/live     # before zensical build
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

import mudg
from mudg.core.pictures import class_colors, depth_colors

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
SHIFT_M, FRAME = 2.0, 12
TOP_M, TOP_PX = 40.0, 720
"""Half the side of the ground that the picture of a sweep shows, and its size."""


def labels(view: dict[str, Any]) -> NDArray[np.uint8]:
    """What is known of every pixel of a view: colour with boxes, depth, classes, objects."""
    rgb = (255 * view["rgb"]).round().byte().permute(1, 2, 0).numpy()
    objects, colors = view["instances"].numpy(), np.random.default_rng(5).integers(60, 255, (2**12, 3))
    picture = Image.fromarray(rgb)
    pen = ImageDraw.Draw(picture)
    for box, occluded in zip(view["boxes_2d"].tolist(), view["occlusion"].tolist(), strict=True):
        pen.rectangle(box, outline=(255, 220, 0) if occluded < 0.5 else (255, 120, 0))
    painted = np.where(objects[..., None] > 0, colors[objects % 2**12], rgb // 3).astype(np.uint8)
    depth = depth_colors(np.where(view["depth"][0] > 0, view["depth"][0], np.nan), 2.0, 80.0)
    rows = [np.asarray(picture), depth, class_colors(view["classes"].numpy()), painted]
    return np.vstack([np.hstack(rows[:2]), np.hstack(rows[2:])])


def sweep(view: dict[str, Any]) -> NDArray[np.uint8]:
    """Returns of a simulated sweep from above, the vehicle in the middle, forward to the right; brighter is higher."""
    xyz, intensity = view["points"][:, :3].numpy(), view["points"][:, 3].numpy()
    pixel = np.round((xyz[:, :2] / TOP_M + 1) / 2 * TOP_PX).astype(int)
    shown = ((pixel >= 0) & (pixel < TOP_PX)).all(1)
    order = np.argsort(xyz[shown, 2])
    picture = np.full((TOP_PX, TOP_PX, 3), 16, np.uint8)
    height = depth_colors((2 + 8 * np.clip(xyz[:, 2] + 2, 0, 6))[None], 2.0, 50.0)[0]
    color = (height * (0.45 + 0.55 * np.clip(2 * intensity, 0, 1))[:, None]).astype(np.uint8)
    picture[TOP_PX - 1 - pixel[shown][order, 1], pixel[shown][order, 0]] = color[shown][order]
    return picture


def main() -> None:
    """Write the pictures, or copy the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of mudg demo")
    parser.add_argument("--pages", type=Path, help="folder for report.html and viewer.html, in place of pictures")
    chosen = parser.parse_args()
    if chosen.pages is not None:
        chosen.pages.mkdir(parents=True, exist_ok=True)
        for name in ("report.html", "viewer.html"):
            shutil.copyfile(chosen.run / name, chosen.pages / name)
        return
    views = mudg.as_dataset(chosen.run, cameras="front", shifts_m=(SHIFT_M,), lidar="hdl64")
    view = views[FRAME]
    for name, picture in (("labels_beside", labels(view)), ("sweep_beside", sweep(view))):
        Image.fromarray(picture).save(IMAGES / f"{name}.jpg", quality=85)
        print(IMAGES / f"{name}.jpg")


if __name__ == "__main__":
    main()
