"""Dense depth from six sweeps on generated cities, against the nearest measurement and linear interpolation; sky is
given.

python bench/complete.py --seeds 2200100 2200101 --size 640x400
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import griddata

from mudg import native
from mudg.base import geometry
from mudg.base.types import View
from mudg.city.config import CityConfig
from mudg.city.world import CityWorld
from mudg.core.depth import beyond_reach, complete_depth
from mudg.core.fusion import STATIC, FusionRules, SweepShots, judge_track, separate
from mudg.core.project import RULES, visible_depth

FAR_M = 100.0


def say(line: str) -> None:
    """One line of the result, at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def points_at(world: CityWorld, view: View, middle: int, sweeps: int) -> NDArray[np.float32]:
    """Points of ``sweeps`` sweeps around frame ``middle``, movers as they stand at the view's time, f32[N, 3]
    metres."""
    rules = FusionRules()
    movers = [track for track in world.tracks() if judge_track(track, rules).moving]
    parts = []
    for index in range(middle - sweeps // 2, middle - sweeps // 2 + sweeps):
        sweep = world.lidar_sweep(index)
        shots = SweepShots(sweep.time_s, sweep.world_from_lidar, sweep.points, ())
        owner, owned = separate(shots, movers, rules)
        parts.append(geometry.transform_points(sweep.world_from_lidar, sweep.points.xyz)[owner == STATIC])
        for number, local in owned.items():
            pose = movers[number].pose_at(view.time_s)
            if pose is not None:
                parts.append(geometry.transform_points(pose, local))
    return np.concatenate(parts).astype(np.float32)


def scores(depth: NDArray[np.floating], truth: NDArray[np.floating], where: NDArray[np.bool_]) -> NDArray[np.float64]:
    """AbsRel, RMSE in metres and the share within a quarter, f64[3]; NaN where there is nothing."""
    if not where.any():
        return np.full(3, np.nan)
    found, true = np.minimum(depth[where], FAR_M).astype(np.float64), truth[where].astype(np.float64)
    ratio = np.maximum(found / true, true / found)
    return np.array([np.abs(found / true - 1).mean(), np.sqrt(((found - true) ** 2).mean()), (ratio < 1.25).mean()])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[2_200_000])
    parser.add_argument("--size", default="640x400")
    parser.add_argument("--sweeps", type=int, default=6)
    options = parser.parse_args()
    width, height = (int(side) for side in options.size.split("x"))
    native.set_threads(1)
    rows: dict[str, list[NDArray[np.float64]]] = {}
    for seed in options.seeds:
        config = CityConfig(seed=seed, n_frames=24, width=width, height=height)
        world = CityWorld(config)
        view = world.frame_views("front")[12]
        recorded = world.render(view, sensor_noise=True)
        xyz = points_at(world, view, 12, options.sweeps)
        started = time.process_time()
        measured = visible_depth(view, xyz, RULES["sweep"])
        beyond = beyond_reach(view, measured, np.deg2rad(config.lidar_upper_deg))
        dense = complete_depth(recorded.rgb_u8, measured, recorded.sky, beyond)
        worked = time.process_time() - started
        known = np.isfinite(measured) & ~recorded.sky
        index = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
        nearest = measured[index[0], index[1]]
        linear = griddata(np.argwhere(known), measured[known], tuple(np.indices(known.shape)))
        near = ~recorded.sky & (recorded.depth <= FAR_M)
        top = np.where(known.any(0), known.argmax(0), height)
        above = near & (np.arange(height)[:, None] < top)
        found = {"ours": dense.depth, "nearest": nearest, "linear": np.where(np.isfinite(linear), linear, nearest)}
        for name, depth in found.items():
            rows.setdefault(name, []).append(
                np.r_[scores(depth, recorded.depth, near), scores(depth, recorded.depth, above)]
            )
        say(
            f"seed {seed}: {100 * known.mean():.0f} % measured, {worked:.2f} s of processor time, AbsRel "
            + ", ".join(f"{name} {row[-1][0]:.4f}" for name, row in rows.items())
        )
    say("mean             AbsRel  RMSE m  delta1 | above the beams: AbsRel  RMSE m  delta1")
    for name, row in rows.items():
        mean = np.nanmean(np.stack(row), 0)
        say(f"{name:16s} {mean[0]:.4f}  {mean[1]:6.2f}  {mean[2]:.4f} | {mean[3]:24.4f}  {mean[4]:6.2f}  {mean[5]:.4f}")


if __name__ == "__main__":
    main()
