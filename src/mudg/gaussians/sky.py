"""The sky of a scene: a panorama of all directions, visible where no Gaussian covers it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from mudg.base import geometry
from mudg.base.types import View
from mudg.core.table import Table


class SkyNode:
    """Colour of the sky by direction: a longitude-latitude panorama, seen wherever nothing covers it.

    Column ``panorama`` ``[1, 3, Hs, 2 Hs]``, colours around [0, 1] (raw; clamped when an image is written). Row 0 looks
    straight up, the last row straight down; the columns run from longitude -pi to pi (world x axis in the middle).
    """

    kind = "sky"

    def __init__(self, panorama: Table) -> None:
        self.table = panorama

    @classmethod
    def uniform(cls, rows: int, rgb: Sequence[float] = (0.6, 0.7, 0.8)) -> SkyNode:
        """A sky of one colour with ``rows`` rows of texels."""
        color = torch.tensor(list(rgb), dtype=torch.float32)
        return cls(Table({"panorama": color.view(1, 3, 1, 1).expand(1, 3, rows, 2 * rows).contiguous()}))

    @property
    def rows(self) -> int:
        """Rows of the panorama."""
        return int(self.table["panorama"].shape[2])

    def coarse_picture(self, view: View) -> Tensor:
        """Sky colour ``[3, h, w]`` on a coarse grid of a view's pixels; differentiable in the panorama.

        The panorama is far coarser than an image, so it is sampled for every s-by-s block of pixels (s chosen such that
        samples stay denser than texels), to be interpolated between them.
        """
        camera = view.camera
        texel_rad = np.pi / self.rows
        stride = int(np.clip(0.7 * texel_rad * min(camera.fx, camera.fy), 1, 8))
        height, width = -(-camera.height // stride), -(-camera.width // stride)
        here = self.table.device.type == "cpu"
        grid = torch.from_numpy(self._grid(view, height, width)) if here else self._grid_there(view, height, width)
        grid = grid.to(self.table["panorama"].dtype)
        padded = F.pad(self.table["panorama"], (1, 1, 0, 0), mode="circular")
        return F.grid_sample(padded, grid[None], mode="bilinear", padding_mode="border", align_corners=False)[0]

    def _grid(self, view: View, height: int, width: int) -> NDArray[np.float32]:
        """Sampling positions in the padded panorama, ``f32[height, width, 2]`` in [-1, 1]."""
        x, y = geometry.pixel_rays(view.camera.resized(width, height))
        # Written out: a matrix product of this shape wakes the threads of BLAS at every step of a fit.
        right, down, ahead = view.world_from_cam[:3, 0], view.world_from_cam[:3, 1], view.world_from_cam[:3, 2]
        rays = x[None, :, None] * right + (y[:, None, None] * down + ahead)
        return self.panorama_grid(rays, padding=1)

    def _grid_there(self, view: View, height: int, width: int) -> Tensor:
        """As ``_grid``, computed where the panorama is, from plain numbers: nothing is copied there."""
        camera, device = view.camera.resized(width, height), self.table.device
        columns, rows = (torch.arange(n, dtype=torch.float64, device=device) + 0.5 for n in (width, height))
        across, down = geometry.pinhole_ray(camera.intrinsics, columns, rows)
        pose = view.world_from_cam[:3, :3].tolist()
        x, y, z = (across * right + (down[:, None] * below + ahead) for right, below, ahead in pose)
        span = 2 * self.rows / (2 * self.rows + 2)
        longitude, elevation = torch.atan2(y, x), torch.atan2(z, torch.hypot(x, y))
        return torch.stack([(longitude / np.pi) * span, -2 * elevation / np.pi], -1)

    def panorama_grid(self, directions_world: NDArray[np.float64], padding: int = 0) -> NDArray[np.float32]:
        """Directions ``[..., 3]`` to panorama positions ``[..., 2]`` in [-1, 1] (x: longitude, y: from up to down)."""
        longitude = np.arctan2(directions_world[..., 1], directions_world[..., 0])
        elevation = np.arctan2(directions_world[..., 2], np.hypot(directions_world[..., 0], directions_world[..., 1]))
        columns = 2 * self.rows
        x = (longitude / np.pi) * columns / (columns + 2 * padding)
        return np.stack([x, -2 * elevation / np.pi], -1).astype(np.float32)

    def fill(self, measured: Iterable[tuple[NDArray[np.float64], NDArray[np.float32]]]) -> None:
        """Start from measured sky colours: mean per texel; texels nobody saw take the nearest seen one's colour.

        Args:
            measured: portions of directions in the world ``[M, 3]`` and their colours f32[M, 3] in [0, 1]. How they are
                divided makes no difference.
        """
        rows, columns = self.rows, 2 * self.rows
        total, count = np.zeros((3, rows * columns)), np.zeros(rows * columns)
        for directions_world, rgb in measured:
            grid = self.panorama_grid(directions_world)
            column = np.clip(((grid[:, 0] + 1) / 2 * columns).astype(np.int64), 0, columns - 1)
            row = np.clip(((grid[:, 1] + 1) / 2 * rows).astype(np.int64), 0, rows - 1)
            texel = row * columns + column
            count += np.bincount(texel, minlength=rows * columns)
            for channel in range(3):  # one after the other, as a single sum over all portions would be
                np.add.at(total[channel], texel, rgb[:, channel].astype(np.float64))
        if not count.any():
            return
        mean = total / np.maximum(count, 1)
        rows_of, columns_of = _nearest((count > 0).reshape(rows, columns))
        filled = mean.reshape(3, rows, columns)[:, rows_of, columns_of]
        self.table.columns["panorama"].detach().copy_(torch.from_numpy(filled).float()[None])

    def continued(self, unknown: NDArray[np.bool_], seen: NDArray[np.bool_]) -> SkyNode:
        """The same sky with unknown texels bool[Hs, 2 Hs] in the colour of the nearest seen one; itself where none
        is."""
        if not unknown.any() or not seen.any():
            return self
        rows_of, columns_of = (torch.from_numpy(index).to(self.table.device) for index in _nearest(seen))
        panorama = self.table["panorama"].detach()
        chosen = torch.from_numpy(unknown).to(panorama.device)
        return SkyNode(Table({"panorama": torch.where(chosen, panorama[:, :, rows_of, columns_of], panorama)}))

    def to(self, device: torch.device) -> SkyNode:
        """The same sky on a device."""
        return SkyNode(self.table.to(device))

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """What rebuilds the sky: plain JSON values and tensors."""
        return {"name": "sky"}, self.table.state()

    @classmethod
    def from_state(cls, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> SkyNode:
        """Inverse of ``state``."""
        return cls(Table.from_state(tensors))


def _nearest(seen: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row and column i64[H, W] of the nearest texel that was seen; longitude wraps round."""
    columns = seen.shape[1]
    nearest = distance_transform_edt(~np.tile(seen, 3), return_distances=False, return_indices=True)
    middle = np.asarray(nearest, np.int64)[:, :, columns : 2 * columns]
    return middle[0], middle[1] % columns
