"""Weather and light on images of generated cities, against the same cities generated with that weather.

python bench/weather.py                                   all edits, seeds 41 and 42
python bench/weather.py --only fog --fit RUN              with the depth of a fitted scene (folder of mudg demo or mudg
                                                          run)
python bench/weather.py --only none --sheet weather.png   a picture of all effects
python bench/weather.py --seeds 41 --pairs pairs.png      a picture of all edits (above) and the truth (below)
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from city_camera import CityLight, city_light, surfaces

from mudg.base import store
from mudg.base.palette import ID
from mudg.base.types import View
from mudg.base.weather_settings import (
    Conditions,
    FogSettings,
    LightSettings,
    RainSettings,
    SnowSettings,
    WeatherSettings,
)
from mudg.city.config import CityConfig
from mudg.city.world import CityTruth, CityWorld
from mudg.core import weather
from mudg.core.weather import air
from mudg.core.weather import light as relight
from mudg.core.weather.gbuffer import (
    GBuffer,
    OccluderMap,
    Surroundings,
    euclidean_range,
    from_render,
    sun_visibility,
    world_points,
)
from mudg.core.weather.light import srgb_decode, srgb_encode

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]
WET_IDS = (ID["road"], ID["sidewalk"])
Decode = Callable[[NDArray[np.floating]], Picture]


def say(line: str) -> None:
    """One line of the result, at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def psnr(a: NDArray[np.floating], b: NDArray[np.floating], where: Mask) -> float:
    """Of display values, where a mask says."""
    return float(-10 * np.log10(np.mean((a[where].astype(np.float64) - b[where]) ** 2) + 1e-12))


def matched(image: NDArray[np.floating], target: NDArray[np.floating], where: Mask) -> NDArray[np.float64]:
    """Values with the means and deviations per channel of the target, both over a mask."""
    spread = np.maximum(image[where].std(0), 1e-6)
    return (image - image[where].mean(0)) / spread * target[where].std(0) + target[where].mean(0)


def best_transfer(image: Picture, target: Picture, where: Mask) -> float:
    """PSNR of the better of two global colour transfers that know the true target: means and deviations of display
    values, and of l-alpha-beta (Reinhard et al. 2001)."""
    lms = np.array([[0.3811, 0.5783, 0.0402], [0.1967, 0.7244, 0.0782], [0.0241, 0.1288, 0.8444]])
    axes = np.diag([3**-0.5, 6**-0.5, 2**-0.5]) @ np.array([[1, 1, 1], [1, 1, -2], [1, -1, 0]])

    def to(x: Picture) -> NDArray[np.float64]:
        return np.log10(np.maximum(x.astype(np.float64) @ lms.T, 1e-2)) @ axes.T

    moved = 10 ** (matched(to(image), to(target), where) @ np.linalg.inv(axes).T) @ np.linalg.inv(lms).T
    return max(psnr(np.clip(x, 0, 1), target, where) for x in (moved, matched(image, target, where)))


@dataclass(frozen=True)
class Result:
    """Scores as text, and display values of the edit and of the truth."""

    lines: list[str]
    edited: Picture
    truth: Picture


@dataclass(frozen=True)
class Case:
    """A view of a clear city and the light it was made with."""

    world: CityWorld
    view: View
    truth: CityTruth
    light: CityLight

    def gbuffer(self, heights: OccluderMap | None = None, decode: Decode | None = None) -> GBuffer:
        """From the image, exact depth and exact classes; without ``decode``, by the city's own camera."""
        light = (decode or self.light.response.decode)(self.truth.rgb)
        return from_render(self.view, light, self.truth.depth, self.truth.semantics, heights)

    def exact(self) -> GBuffer:
        """With exact normals and visible share of the sky, too."""
        s = surfaces(self.world, self.view)
        return replace(self.gbuffer(), normal=s.normal, openness=s.openness, sunlit=s.sunlit)

    def heights(self) -> OccluderMap:
        """From depth images of all frames and cameras."""
        parts = []
        for name in self.world.cameras():
            for view in self.world.frame_views(name)[1::2]:
                truth = self.world.render(view, supersample=1)
                static = ~truth.sky & ((truth.instance == 0) | (view.time_s == self.view.time_s))
                parts.append(world_points(view, truth.depth)[static])
        return OccluderMap.from_points(np.concatenate(parts), 0.4)


def config_of(seed: int, size: tuple[int, int], **changes: object) -> CityConfig:
    """Seven frames in a second, with the middle one looked at."""
    plain = CityConfig(seed=seed, n_frames=7, rate_hz=2.0, width=size[0], height=size[1], light="day")
    return replace(plain, **changes)


def case_of(config: CityConfig) -> Case:
    """The middle frame of the front camera."""
    world = CityWorld(config)
    view = world.frame_views("front")[config.n_frames // 2]
    return Case(world, view, world.render(view), city_light(config))


def foggy(case: Case, gbuffer: GBuffer, visibility_m: float, light: Surroundings, recorded_m: float) -> Picture:
    """Linear light in fog."""
    settings = WeatherSettings(fog=FogSettings(visibility_m=visibility_m), recorded_visibility_m=recorded_m)
    return weather.apply(gbuffer, Conditions(weather=settings), case.view, case.view.time_s, 0, light)


def score_fog(
    case: Case, visibility_m: float = 150.0, fitted: tuple[Picture, NDArray[np.float32]] | None = None
) -> Result:
    """Right curve and plain sRGB curve, exact depth and depth of a fitted scene."""
    truth = CityWorld(replace(case.world.config, fog_visibility_m=visibility_m)).render(case.view)
    solid = ~truth.sky
    own, around = case.light.response, case.light.surroundings
    lines = [f"unedited {psnr(case.truth.rgb, truth.rgb, solid):.1f}"]
    exact = case.gbuffer()
    best = own.encode(foggy(case, exact, visibility_m, around, case.light.visibility_m))
    lines.append(f"city's curve, exact depth {psnr(best, truth.rgb, solid):.1f}")
    generic = case.gbuffer(None, srgb_decode)
    guess = weather.estimate_surroundings([(case.view, generic)])
    lines.append(
        f"sRGB, exact depth {psnr(srgb_encode(foggy(case, generic, visibility_m, guess, 0.0)), truth.rgb, solid):.1f}"
    )
    share = np.exp(-air.extinction(visibility_m) * np.where(truth.sky, 0, exact.depth).astype(np.float64))
    shown = air.veiled(case.truth.rgb, share, srgb_encode(guess.airlight[None])[0])
    lines.append(f"display values and camera z {psnr(shown, truth.rgb, solid):.1f}")
    if fitted is not None:
        rgb, depth = fitted
        depth = np.where(truth.sky, np.inf, np.where(np.isfinite(depth), depth, 200.0)).astype(np.float32)
        for name, colors in (("recorded image", case.truth.rgb), ("rendered image", rgb)):
            with_own = replace(exact, color=own.decode(colors), depth=depth)
            with_srgb = replace(exact, color=srgb_decode(colors), depth=depth)
            a = psnr(own.encode(foggy(case, with_own, visibility_m, around, case.light.visibility_m)), truth.rgb, solid)
            b = psnr(srgb_encode(foggy(case, with_srgb, visibility_m, guess, 0.0)), truth.rgb, solid)
            lines.append(
                f"fitted depth, {name}: city's curve {a:.1f}, sRGB {b:.1f} (unedited"
                f" {psnr(colors, case.truth.rgb, solid):.1f})"
            )
    return Result(lines, np.where(solid[..., None], best, case.truth.rgb), truth.rgb)


def score_light(case: Case, name: str) -> Result:
    """Another light against a global colour transfer that knows the target's statistics."""
    config = replace(case.world.config, light=name)
    world = CityWorld(config)
    truth, target = world.render(case.view), city_light(config)
    solid = ~truth.sky
    there = target.response
    lines = [
        f"unedited {psnr(case.truth.rgb, truth.rgb, solid):.1f}",
        f"global transfer {best_transfer(case.truth.rgb, truth.rgb, solid):.1f}",
    ]
    heights = case.heights()
    around, goal = case.light.surroundings, target.surroundings
    estimated = case.gbuffer(heights)
    estimated = replace(
        estimated,
        sunlit=sun_visibility(estimated, case.view, heights, around.sun_direction),
        new_sunlit=sun_visibility(estimated, case.view, heights, goal.sun_direction),
    )
    exact = replace(case.exact(), new_sunlit=surfaces(world, case.view).sunlit)
    for label, gbuffer in (("exact surfaces", exact), ("height map", estimated)):
        clear = np.exp(
            -air.extinction(case.light.visibility_m) * np.where(truth.sky, 0, euclidean_range(case.view, gbuffer.depth))
        )
        gbuffer = replace(gbuffer, color=air.unveiled(gbuffer.color, clear, around.airlight))
        lit = relight.relit(gbuffer, case.view, around, goal)
        hazy = np.exp(
            -air.extinction(target.visibility_m) * np.where(truth.sky, 0, euclidean_range(case.view, gbuffer.depth))
        )
        shown = there.encode(air.veiled(lit, np.where(truth.sky, 1, hazy), goal.airlight))
        lines.append(f"{label} {psnr(shown, truth.rgb, solid):.1f}")
    return Result(lines, shown, truth.rgb)


def score_wet(case: Case) -> Result:
    """Road and sidewalk, mirrored in the image itself."""
    config = replace(case.world.config, wet=1.0, puddles=0.35)
    truth = CityWorld(config).render(case.view)
    where = np.isin(truth.semantics, WET_IDS)
    light = relight.wet_ground(case.gbuffer(), case.view, case.light.surroundings, 1.0, 0.35, config.seed)
    shown = case.light.response.encode(light)
    lines = [
        f"{name} {psnr(rgb, truth.rgb, where):.1f}" for name, rgb in (("unedited", case.truth.rgb), ("wet", shown))
    ]
    return Result(lines, shown, truth.rgb)


def score_snow(case: Case, cover: float = 0.7) -> Result:
    """Where snow lies, and the image."""
    config = replace(case.world.config, snow_cover=cover)
    world = CityWorld(config)
    truth, lies = world.render(case.view), surfaces(world, case.view).snow > 0.5
    own, around = case.light.response, case.light.surroundings
    solid = ~truth.sky
    heights = case.heights()
    estimated = case.gbuffer(heights)
    estimated = replace(estimated, sunlit=sun_visibility(estimated, case.view, heights, around.sun_direction))
    lines = [f"unedited {psnr(case.truth.rgb, truth.rgb, solid):.1f}", f"covered {lies.mean():.2f}"]
    for label, gbuffer in (("exact surfaces", case.exact()), ("height map", estimated)):
        found = relight.snow_cover(gbuffer, case.view, cover, config.seed)
        iou = ((found > 0.5) & lies).sum() / max(((found > 0.5) | lies).sum(), 1)
        sunlit = relight.sunlit_of(gbuffer, around)
        light = gbuffer.color + (relight.snow_light(gbuffer, around, sunlit) - gbuffer.color) * found[..., None]
        shown = own.encode(light)
        lines.append(f"{label}: IoU {iou:.3f}, PSNR {psnr(shown, truth.rgb, solid):.1f}")
    return Result(lines, shown, truth.rgb)


def fitted_view(run: Path, size: tuple[int, int]) -> tuple[Case, tuple[Picture, NDArray[np.float32]]]:
    """The city of a run and what its fitted scene shows of a recorded view."""
    from mudg.scene.read import read_scene
    from mudg.steps.fitted import FittedScene

    scene = read_scene(run / "scene")
    world = CityWorld.from_source(scene.source)
    views = world.frame_views("front")
    view = views[len(views) // 2].resized(*size)
    folder = next(p for name in ("mudg_s", "street_gaussians") if (p := run / "fit" / name).is_dir())
    shown = FittedScene.read(folder, "cpu").render(view.camera, view.world_from_cam, view.time_s)
    case = Case(world, view, world.render(view), city_light(world.config))
    return case, ((shown.rgb / 255).astype(np.float32), shown.depth_m)


SHEET: dict[str, Conditions] = {
    "as recorded": Conditions(),
    "fog, 100 m": Conditions(weather=WeatherSettings(fog=FogSettings(visibility_m=100))),
    "overcast, rain 25 mm/h": Conditions(
        weather=WeatherSettings(rain=RainSettings(mm_h=25), wet=1.0, puddles=0.35),
        light=LightSettings(time="overcast", exposure_ev=-0.3),
    ),
    "overcast, snow": Conditions(
        weather=WeatherSettings(snow=SnowSettings(cover=0.85, mm_h=2)),
        light=LightSettings(time="overcast", exposure_ev=-0.7),
    ),
    "dusk": Conditions(light=LightSettings(time="dusk", sun_azimuth_deg=60)),
    "wet night": Conditions(
        weather=WeatherSettings(wet=1.0, puddles=0.3), light=LightSettings(time="night", exposure_ev=1.0)
    ),
}


def write_picture(path: Path, rows: list[Picture]) -> None:
    """Rows of display values as one image."""
    store.write_image(path, (np.clip(np.concatenate(rows, 0), 0, 1) * 255 + 0.5).astype(np.uint8), optimize=True)


def sheet(case: Case, path: Path) -> None:
    """All effects on one view, two rows of three."""
    own, heights = case.light.response, case.heights()
    gbuffer = case.gbuffer(heights)
    gbuffer = replace(
        gbuffer, sunlit=sun_visibility(gbuffer, case.view, heights, case.light.surroundings.sun_direction)
    )
    shown = [
        own.encode(weather.apply(gbuffer, c, case.view, case.view.time_s, 1, case.light.surroundings))
        for c in SHEET.values()
    ]
    rows = [np.concatenate(shown[i : i + 3], 1) for i in (0, 3)]
    write_picture(path, rows)
    say(f"{path}: " + ", ".join(SHEET))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="*", default=[41, 42])
    parser.add_argument("--size", default="240x160")
    parser.add_argument("--only", nargs="+", default=["fog", "dusk", "overcast", "wet", "snow"])
    parser.add_argument("--fit", type=Path)
    parser.add_argument("--sheet", type=Path)
    parser.add_argument("--pairs", type=Path)
    options = parser.parse_args()
    width, height = (int(n) for n in options.size.split("x"))
    scores: dict[str, Callable[[Case], Result]] = {"fog": score_fog, "wet": score_wet, "snow": score_snow}
    scores |= {name: lambda case, name=name: score_light(case, name) for name in ("dusk", "overcast")}
    if options.fit is not None:
        case, fitted = fitted_view(options.fit, (width, height))
        say(f"fog, {options.fit}: " + "; ".join(score_fog(case, fitted=fitted).lines))
    for seed in options.seeds:
        case = case_of(config_of(seed, (width, height)))
        results: dict[str, Result] = {}
        for name in options.only:
            if name in scores:
                begin = time.perf_counter()
                results[name] = scores[name](case)
                say(
                    f"seed {seed} {name}: " + "; ".join(results[name].lines) + f" ({time.perf_counter() - begin:.0f} s)"
                )
        if options.sheet is not None:
            sheet(case, options.sheet)
        if options.pairs is not None:
            rows = [
                np.concatenate([getattr(result, kind) for result in results.values()], 1)
                for kind in ("edited", "truth")
            ]
            write_picture(options.pairs, rows)
            say(f"{options.pairs}: " + ", ".join(results))


if __name__ == "__main__":
    main()
