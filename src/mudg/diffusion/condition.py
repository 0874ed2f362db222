"""Conditions of the diffusion model: what a fused cloud and recorded images tell about a path of views
(`build_conditions`).

1. the cloud is projected into every view (z-buffer);
2. far points that shine through gaps between near ones are removed (`core.project`, rule `condition`);
3. pixels without a measured depth get that of a measured one: of the nearest, or, away from measured ones, of the
   nearest of the class that recorded images show there; the sky is far away; the mask of what was measured is kept;
4. every pixel is carried by its depth into recorded images taken at about the same time, and takes the mean colour of
   those in which it is not hidden and that look alike; elsewhere it keeps that of its point, or of the nearest point;
5. the nearest recorded image is also carried over as if everything in it were far away, for what lies above the LiDAR;
   near road users, which stand elsewhere in the view, are filled with what is around them;
6. the classes of labelled points and images travel with their colours;
7. renders of a scene fitted to the recorded images, if there is one, are given too, and in steps 3 to 5 tell the depth
   of what no point was measured on.

Steps 2 to 7 are what the published system does not do; `ConditionRules(published=True)` gives its condition instead:
points only, zero where nothing is known, the reference image in frame 0 being put in by the model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from mudg.base import geometry, memory, palette
from mudg.base.errors import InputError
from mudg.base.types import Condition, FusedCloud, Photo, RenderPlanes, SparseDepth, Track, View
from mudg.base.weather_settings import Conditions
from mudg.core import weather
from mudg.core.pictures import resize_area, to_bytes
from mudg.core.project import ProjectConfig, ProjectedPoints, project_cloud
from mudg.core.weather import ShownView, Surroundings

# vacated ------------------------------------------------------------------------------------------
#
# An edited drive where something stood that is gone. Photographs of other times or places show what is behind it; what
# is left is a hole that continues the colours around it, and nothing in it counts as seen.


GROUND_IDS = torch.tensor([palette.ID[name] for name in ("road", "sidewalk", "terrain")], dtype=torch.uint8)
SKY_ID = palette.ID["sky"]
MOVING_IDS = torch.tensor(palette.DYNAMIC_IDS, dtype=torch.uint8)
KNOWN_SHARE = 0.5
"""A render shows what is there where its certainty is at least this share of the usual one of its view."""


@dataclass(frozen=True, slots=True, eq=False)
class Vacated:
    """Where edits changed a view. mask: pixels bool[H,W] in which something stood that is gone, its shadow included.
    ground: depth f32[H,W] in metres of level ground there, NaN above it. shown: pixels bool[H,W] in which objects are
    new or stand anew. stood: pixels bool[H,W] of the mask in which it stood itself."""

    mask: Tensor
    ground: Tensor
    shown: Tensor
    stood: Tensor

    def known(self, render: RenderPlanes | None) -> Tensor:
        """Pixels bool[H,W] behind what is gone that other photographs determined: the fit knows what is there. Not in
        its shadow, which a fit knows just as well."""
        return torch.zeros_like(self.stood) if render is None else self.stood & determined(render, ~self.mask)


def determined(render: RenderPlanes, usual: Tensor) -> Tensor:
    """Pixels bool[H,W] that photographs determined about as well as the `usual` ones bool[H,W] of the view, by the
    median. A longer fit is more certain everywhere, so only the share counts."""
    covered = (render.alpha[0] > 0.5) & usual
    if not bool(covered.any()):
        return torch.zeros_like(covered)
    return (render.alpha[0] > 0.5) & (render.certainty[0] >= KNOWN_SHARE * render.certainty[0][covered].median())


VacatedAt = Callable[[View], Vacated]


def continued(color: Tensor, ids: Tensor, vacated: Vacated, hole: Tensor) -> tuple[Tensor, Tensor]:
    """Colours f32[3,H,W] and classes u8[H,W] with those of a `hole` bool[H,W] continued smoothly from around it: ground
    from ground, what is above it from what stands there or from the sky, nothing from objects that move."""
    ground, moving = torch.isin(ids, GROUND_IDS), torch.isin(ids, MOVING_IDS)
    low = torch.isfinite(vacated.ground)
    for part, given in ((hole & low, ground), (hole & ~low, ~ground & ~moving)):
        source = given & ~hole
        if bool(part.any()) and bool(source.any()):
            filled = _pulled(color[None] * source, source.float()[None, None])[0]
            color, ids = torch.where(part, filled, color), torch.where(part, ids[nearest_pixels(source)], ids)
    return color, ids


def _pulled(color: Tensor, weight: Tensor) -> Tensor:
    """Colours where weight is 1, continued where it is 0; `color` [1,C,H,W] is 0 there."""
    if min(color.shape[-2:]) <= 2:
        total, share = (x.sum((-2, -1), keepdim=True) for x in (color, weight))
        return (total / share.clamp(min=1e-6)).expand_as(color)
    pool = lambda x: functional.avg_pool2d(x, 2, ceil_mode=True, count_include_pad=False)
    share = pool(weight)
    coarse = pool(color) / share.clamp(min=1e-6)
    coarse = _pulled(coarse * (share > 0), (share > 0).float())
    larger = functional.interpolate(coarse, size=color.shape[-2:], mode="bilinear", align_corners=False)
    return color + (1 - weight) * larger


# condition ----------------------------------------------------------------------------------------


FAR_M = 100.0
"""Farther than this nothing is measured, and what no surface covers is taken to be."""
SAME_TIME_S = 0.06
"""Recorded images nearer in time than this may also colour dynamic objects."""
OTHER_CAMERA_S = 0.1
"""Images of other cameras count as farther away in time by this."""
LEAST_OVERLAP = 0.02
"""Images that show less than this share of a view are not tried."""
BACKDROP_M = 80.0
"""Distance at which the nearest recorded image is put up as a backdrop."""
BEHIND_M = 40.0
"""Road users nearer than this are no part of a backdrop."""
ALIKE, ALIKE_PX = 0.1, 4
"""Recorded images whose means over squares of this side differ by less show the same surface, and are averaged."""
REACH_PX = 4
"""A pixel this near to a measured one takes that one's depth; farther ones take the depth of the render, where there is
one."""
SURE_ALPHA, ANOTHER_SURFACE = 0.9, 0.1
"""A pixel near to a measured one takes the depth of the render all the same where the render covers it by more than the
first and is farther from the measured depth than the second share of it: outlines of surfaces are the render's."""
SOLID_ALPHA = 0.5
"""Coverage from which on a render has a surface; what it covers less is taken to be far away above the horizon."""
GROUND_SLOPE = 0.05
"""Rays that fall at least this much per metre ahead end on a surface, covered by the render or not."""


@dataclass(frozen=True, slots=True)
class ConditionRules:
    """How a condition is made. Sizes are those of the model's images."""

    width: int
    height: int
    fine_width: int = 0
    fine_height: int = 0
    """Colours are gathered on this finer grid and averaged (0 = at the condition's own size): that avoids aliasing."""
    images_per_view: int = 6
    """How many recorded images are tried per view, nearest in time (then in place) first. 0: the backdrop alone."""
    hidden_share: float = 0.08
    """A pixel is hidden in a recorded image if a surface there is nearer by this share of its depth plus 0.3 m."""
    warp: bool = True
    """Warp recorded images in; otherwise holes keep the nearest point's colour."""
    occluder_m: float = 0.2
    """Side of the square with which points hide what lies behind them."""
    published: bool = False
    """The published system's condition: points only, 0 where nothing was seen, no filling, no warping. With a fine size
    it is projected at that size (the camera's) and brought down as the published training did: colour by the nearest
    pixel, depth and reference bilinearly, zeros of missing depth mixed in. What the points measured goes beside it
    (`Condition.measured`)."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.width, self.height

    @property
    def fine(self) -> tuple[int, int]:
        """Width and height of the finer grid."""
        return self.fine_width or self.width, self.fine_height or self.height

    def project(self, cloud: FusedCloud, tracks: Sequence[Track], view: View) -> ProjectedPoints:
        """The cloud's points in a view of the condition's resolution."""
        drawn = ProjectConfig(near_m=1.0, far_m=FAR_M, occluder_m=0.0 if self.published else self.occluder_m)
        poses = {track.id: track.pose_at(view.time_s) for track in tracks}
        return project_cloud(cloud, poses, view, drawn, hide=not self.published)


OVERLAP_GRID = 24, 16
"""Columns and rows of the places of a view by which it is told how much of it another image shows."""
BOX_MARGIN_M = 0.2
"""Rendered surfaces this far outside an object's box still count as the object."""
LEAST_FALL = 0.02
"""Metres per metre of depth by which a ray must fall to be followed to the ground."""
RenderAt = Callable[[View], RenderPlanes]
"""What a fitted scene shows at a view, without the leading dimension."""
IdsAt = Callable[[Tensor], Tensor]
"""The classes u8[H,W] that a recorded image shows at a view's pixels, if their surfaces lie at depths f32[H,W]."""


@dataclass(frozen=True, slots=True, eq=False)
class DriveInputs:
    """What conditions of a drive are made of: its fused cloud (static points in the world, objects in their boxes,
    posed by ``tracks`` at each view's time), recorded images of any cameras, and renders of a fitted scene, if there is
    one; of an edited drive also where something stood that is not there any more, and, for published-type models, its
    weather. ``images``: the recorded ones, as they have been prepared for views of a size."""

    cloud: FusedCloud
    tracks: Sequence[Track]
    recorded: Sequence[Photo]
    render_at: RenderAt | None = None
    vacated_at: VacatedAt | None = None
    weather: InWeather | None = None
    images: dict[tuple[int, int], PreparedImages] = field(default_factory=dict)

    def look(
        self, view: View, rules: ConditionRules, far_ids: Tensor, ids_at: IdsAt, render: RenderPlanes | None = None
    ) -> Surfaces:
        """The surfaces at a view: measured ones, and between them those of the render (None: of `render_at`) or else of
        measured pixels. `far_ids` u8[H,W]: classes of what a recorded image shows in the same direction (255 =
        unknown). `ids_at`: those that it shows at surfaces of a depth.

        Without a render the nearest measured pixel's surface goes on. Away from measured pixels it does so where the
        image, at its depth, shows its class; elsewhere that of the nearest pixel of the class in `far_ids` does, and
        sky is far away. What a render does not cover is taken for sky, unless it lies below the horizon or `far_ids`
        are something else: there a surface stands that no image shows, and the nearest measured pixel stands for it, in
        the render too."""
        sparse = rules.project(self.cloud, self.tracks, view)
        valid, nearest = sparse.valid, nearest_pixels(sparse.valid)
        near = torch.from_numpy(ndimage.binary_dilation(valid.numpy(), iterations=REACH_PX))
        if render is None and self.render_at is not None:
            render = self.render_at(view)
        color, moving, ids = sparse.rgb, sparse.moving, sparse.semantics
        depth, sky = torch.full_like(sparse.depth, FAR_M), torch.zeros_like(valid)
        if bool(valid.any()):
            if render is None:
                ends = ~near & (far_ids != palette.UNLABELLED) & (ids[nearest] != ids_at(sparse.depth[nearest]))
                nearest, sky = _nearest_of_class(nearest, valid, ids, far_ids, ends), ends & (far_ids == SKY_ID)
            here = (..., *nearest)
            color, depth, moving, ids = color[here], sparse.depth[here], moving[here] & ~sky, ids[here]
        depth, ids = torch.where(sky, FAR_M, depth), torch.where(sky, far_ids, ids)
        x, y, z = ray_directions(view)
        # ground goes on at the height, not at the depth, of the nearest measured pixel
        falls = -z
        level = ~valid & torch.isin(ids, GROUND_IDS) & (falls > LEAST_FALL) & (falls[nearest] > LEAST_FALL)
        levelled = (depth * falls[nearest] / falls.clamp(min=LEAST_FALL)).clamp(max=FAR_M)
        levelled = torch.where(level, levelled, depth)
        vacated = None if self.vacated_at is None else self.vacated_at(view)

        def on_ground(depth: Tensor) -> Tensor:
            """The ground's depth where a vacated pixel has no measured surface."""
            if vacated is None:
                return depth
            return torch.where(vacated.mask & ~valid & torch.isfinite(vacated.ground), vacated.ground, depth)

        if render is None:
            return Surfaces(valid, color, on_ground(levelled), moving, ids, None, vacated)
        solid = render.alpha[0] >= SOLID_ALPHA
        # where the render shows another surface, which photographs determined
        sure = (render.alpha[0] > SURE_ALPHA) & determined(render, torch.ones_like(depth, dtype=torch.bool))
        other = sure & ((render.depth[0] - depth).abs() > ANOTHER_SURFACE * depth)
        near &= _among_measured(sparse, depth) | ~other
        surface_seen = (far_ids != SKY_ID) & (far_ids != palette.UNLABELLED)
        hidden = ~solid & ((z < -GROUND_SLOPE * torch.hypot(x, y)) | surface_seen) & bool(valid.any())
        own_color, own_ids = torch.where(hidden, color, render.color), torch.where(hidden, ids, render.semantics)
        render = replace(render, color=own_color, semantics=own_ids)
        shown = torch.where(solid, render.depth[0], torch.full_like(depth, FAR_M)).clamp(max=FAR_M)
        pick = lambda mine, theirs: torch.where(near | hidden, mine, theirs)
        depth = on_ground(pick(levelled, shown))
        moving = (moving & near) | self._in_objects(view, depth, ~near & torch.isin(render.semantics[0], MOVING_IDS))
        color, ids = pick(color, render.color), pick(ids, render.semantics[0])
        return Surfaces(valid, color, depth, moving, ids, render, vacated)

    def _in_objects(self, view: View, depth: Tensor, asked: Tensor) -> Tensor:
        """Which of the `asked` pixels bool[H,W], at `depth` f32[H,W], lie in the box of an object that has a cloud of
        its own."""
        found = torch.zeros_like(asked)
        rows, columns = torch.nonzero(asked, as_tuple=True)
        if not len(rows):
            return found
        rays = torch.stack([axis[rows, columns] for axis in ray_directions(view)], 1).double()
        places = (rays * depth[rows, columns, None]).numpy() + view.center_world
        inside_one = np.zeros(len(places), np.bool_)
        for track in self.tracks:
            pose = track.pose_at(view.time_s) if track.id in self.cloud.objects else None
            if pose is not None:
                own = (places - pose[:3, 3]) @ pose[:3, :3]
                inside_one |= (np.abs(own) <= 0.5 * track.size_m + BOX_MARGIN_M).all(1)
        found[rows, columns] = torch.from_numpy(inside_one)
        return found

    def weathered_points(self, view: View, seen: ProjectedPoints) -> Tensor:
        """Colours f32[3,H,W] of projected points, for the published system: in the drive's weather, each at its own
        distance, with the surfaces of the fitted scene between and behind them. Meaningless where there are none."""
        if self.weather is None or self.render_at is None:
            return seen.rgb
        shown = self.render_at(view)
        ids = torch.where(seen.valid & (shown.semantics == SKY_ID), palette.UNLABELLED, shown.semantics)
        depth = torch.where(seen.valid, seen.depth, shown.depth)
        return self.weather.image(view, torch.where(seen.valid, seen.rgb, shown.color), depth, ids.to(torch.uint8))

    def weathered_photo(self, view: View, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A recorded image u8[H,W,3] in the drive's weather."""
        if self.weather is None or self.render_at is None:
            return rgb
        shown = self.render_at(view)
        return to_bytes(self.weather.image(view, image_tensor(rgb), shown.depth, shown.semantics))


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """What is known of a view before images are warped in: measured bool[H,W]; color f32[3,H,W], depth f32[H,W] m,
    moving bool[H,W] and ids u8[H,W] of every pixel; the render, if there is one; and where something stood that an edit
    took away."""

    measured: Tensor
    color: Tensor
    depth: Tensor
    moving: Tensor
    ids: Tensor
    render: RenderPlanes | None
    vacated: Vacated | None = None

    def with_hole(self, color: Tensor, ids: Tensor, found: Tensor) -> tuple[Surfaces, Tensor, Tensor, Tensor]:
        """These surfaces, colours, classes and `found` bool[H,W] of a view after images were warped in to these pixels:
        what was vacated and not found continues what is around it, and does not count as measured; where objects are
        new the render is all that there is, and counts like a photograph, as it does where it knows what something
        hid."""
        if self.vacated is None:
            return self, color, ids, found
        if self.render is not None:
            shown = (self.vacated.shown & (self.render.alpha[0] > 0.5)) | (self.vacated.known(self.render) & ~found)
            color, ids = torch.where(shown, self.render.color, color), torch.where(shown, self.render.semantics[0], ids)
            found = found | shown
        ground = self.measured & torch.isin(self.ids, GROUND_IDS) & torch.isfinite(self.vacated.ground)
        # what stood there, or its shadow, may have coloured points: of ground, only their place counts
        hole = self.vacated.mask & ~found
        color, ids = continued(color, ids, self.vacated, hole)
        render = self.render
        if render is not None:  # it knows nothing where something stood, but for what other photographs determined
            unknown = self.vacated.mask & ~self.vacated.known(render)
            certainty = torch.where(unknown, torch.zeros_like(render.certainty), render.certainty)
            render = replace(render, color=torch.where(hole, color, render.color), certainty=certainty)
        return replace(self, measured=self.measured & ~(hole & ~ground), render=render), color, ids, found


def nearest_pixels(valid: Tensor) -> tuple[Tensor, Tensor]:
    """Row and column i64[H,W] of the nearest valid pixel for every pixel of bool[H,W]; the pixel itself where nothing
    at all is valid."""
    mask = valid.numpy()
    found: Any = np.indices(mask.shape)
    if mask.any():
        found = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    rows, columns = torch.from_numpy(found.astype(np.int64))
    return rows, columns


def _nearest_of_class(
    nearest: tuple[Tensor, Tensor], valid: Tensor, ids: Tensor, classes: Tensor, mask: Tensor
) -> tuple[Tensor, Tensor]:
    """Rows and columns of the `nearest` valid pixels; where the `mask` bool[H,W] is, those of the nearest one whose
    class in `ids` is the pixel's in `classes` (u8[H,W]), if there is one."""
    rows, columns = nearest
    for class_id in torch.unique(classes[mask]).tolist():
        members, pixels = valid & (ids == class_id), mask & (classes == class_id)
        if bool(members.any()):
            class_rows, class_columns = nearest_pixels(members)
            rows = torch.where(pixels, class_rows, rows)
            columns = torch.where(pixels, class_columns, columns)
    return rows, columns


def filled_depth(measured: SparseDepth, far_m: float = 100.0) -> Tensor:
    """Depth f32[T,1,H,W] with the nearest measured pixel's where nothing was measured; `far_m` in a frame without
    any."""
    filled = [
        image[nearest_pixels(valid)] if bool(valid.any()) else torch.full_like(image, far_m)
        for image, valid in zip(measured.depth[:, 0], measured.valid[:, 0], strict=True)
    ]
    return torch.stack(filled)[:, None]


def turned_rays(view: View, turn: NDArray[np.float64]) -> list[Tensor]:
    """x, y and z, f32[H,W] each, of the pixels' rays, of length 1 along the camera's z, turned by a rotation."""
    camera, m = view.camera, torch.from_numpy(turn.astype(np.float32))
    columns, rows = (torch.arange(count, dtype=torch.float32) + 0.5 for count in (camera.width, camera.height))
    u, v = geometry.pinhole_ray(camera.intrinsics, columns, rows)
    return [m[i, 0] * u[None, :] + m[i, 1] * v[:, None] + m[i, 2] for i in range(3)]


def carry(view: View, depth: Tensor, other: View) -> tuple[Tensor, Tensor, Tensor]:
    """Where the pixels of `view`, at `depth` f32[K,H,W] metres, lie in another view. Returns x, y f32[K,H,W] in pixels
    of the other view and z f32[K,H,W] metres (not positive = behind it)."""
    moved = other.cam_from_world @ view.world_from_cam
    rays, shift = turned_rays(view, moved[:3, :3]), torch.from_numpy(moved[:3, 3].astype(np.float32))
    px, py, pz = (ray * depth + shift[i] for i, ray in enumerate(rays))
    return *geometry.pinhole(other.camera.intrinsics, px, py, pz.clamp(min=0.1)), pz


def ray_directions(view: View) -> list[Tensor]:
    """World x, y and z, f32[H,W] each, of the pixels' rays, of length 1 along the camera's z."""
    return turned_rays(view, view.world_from_cam[:3, :3])


def look_up(image: Tensor, x: Tensor, y: Tensor, mode: str = "bilinear") -> Tensor:
    """Values of `image` f32[C,h,w] at pixel coordinates f32[K,H,W] -> f32[K,C,H,W]; the border is repeated outside."""
    grid = torch.stack([x * (2.0 / image.shape[-1]) - 1, y * (2.0 / image.shape[-2]) - 1], -1)
    rows = grid.flatten(0, 1)[None]
    found = functional.grid_sample(image[None], rows, mode=mode, padding_mode="border", align_corners=False)
    return found[0].unflatten(1, grid.shape[:2]).movedim(0, 1)


def look_up_ids(ids: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Ids of `ids` u8[h,w] in the pixels at coordinates f32[K,H,W] -> u8[K,H,W]; the border is repeated outside."""
    column = x.floor().clamp(0, ids.shape[1] - 1).long()
    return ids[y.floor().clamp(0, ids.shape[0] - 1).long(), column]


def inside(view: View, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Which of the carried pixels lie in front of and inside the other view, bool of their shape."""
    return (z > 0.1) & (x >= 0.5) & (x <= view.camera.width - 0.5) & (y >= 0.5) & (y <= view.camera.height - 0.5)


@dataclass(frozen=True, slots=True, eq=False)
class WarpSource:
    """A recorded image made ready for warping: rgb f32[3,h,w] in common colours (of 0..1 or a little beyond), depth
    f32[h,w] m (filled), moving bool[h,w], semantics u8[h,w] (255 = unknown), usable bool[h,w] or None (all)."""

    view: View
    rgb: Tensor
    depth: Tensor
    moving: Tensor
    semantics: Tensor
    usable: Tensor | None = None

    def warped(self, view: View, depth: Tensor, surface: Tensor, hidden_share: float) -> tuple[Tensor, Tensor, Tensor]:
        """Colours and classes that the pixels of another view, at `depth` f32[H,W], have in the image. `surface`
        f32[h,w]: depth of the nearest surface at its pixels. Returns rgb f32[3,H,W] (bicubic), semantics u8[H,W]
        (nearest) and found bool[H,W]: inside the image, usable and not hidden in it."""
        x, y, z = carry(view, depth[None], self.view)
        in_front = look_up(surface[None], x, y, "nearest")[0, 0]
        found = inside(self.view, x, y, z)[0] & (in_front >= z[0] * (1 - hidden_share) - 0.3)
        if self.usable is not None:
            found &= look_up_ids(self.usable, x, y)[0]
        return look_up(self.rgb, x, y, "bicubic")[0], look_up_ids(self.semantics, x, y)[0], found


def build_conditions(
    drive: DriveInputs,
    views: Sequence[View],
    rules: ConditionRules,
    kept: dict[int, WarpSource] | None = None,
    *,
    among: Sequence[Sequence[int]] | None = None,
) -> tuple[Condition, Condition]:
    """The model's condition for `views` (any path, any size; resized to the rules' size), and the same on the fine
    grid: the same object if there is none. The reference is the recorded image of the first view's camera that is
    nearest in time, black if there is none. InputError: no views. kept: cache of prepared images, by their numbers;
    pass the same dict again for further views with the same renders. Of `PreparedImages` with a folder, fine conditions
    of large views lie in files. among: for each view the numbers of the recorded images that it may know (None:
    all)."""
    if not views:
        raise InputError("a condition needs at least one view", where="build_conditions")
    small = [view.resized(*rules.size) for view in views]
    among = [range(len(drive.recorded))] * len(views) if among is None else among
    reference = _reference(drive, small[0], among[0], rules)
    if rules.published:
        condition = _published_condition(drive, small, reference, rules)
        return condition, condition
    kept = {} if kept is None else kept
    fine_views = tuple(view.resized(*rules.fine) for view in views)
    folder = kept.folder if isinstance(kept, PreparedImages) else None
    made = (_condition_of_view(drive, view, rules, own, kept) for view, own in zip(fine_views, among))
    rows = ((*part, *(getattr(r, x.name) for x in fields(RenderPlanes) if r is not None)) for part, r in made)
    color, depth, valid, warped, backdrop, ids, far_ids, *planes = stacked(rows, len(fine_views), folder)
    renders = RenderPlanes(*planes) if planes else None
    shown = reference if rules.fine == rules.size else backdrop[0]
    fine = Condition(fine_views, color, depth, valid, shown, warped, backdrop, ids, far_ids, renders)
    if rules.fine == rules.size:
        return fine, fine
    reduced = lambda x: functional.interpolate(x.float(), size=rules.size[::-1], mode="area")
    picked = lambda x: functional.interpolate(x, size=rules.size[::-1], mode="nearest-exact")
    if renders is not None:
        how = {"depth": picked, "semantics": picked}
        planes = {x.name: how.get(x.name, reduced)(getattr(renders, x.name)) for x in fields(RenderPlanes)}
        renders = RenderPlanes(**planes)
    warped, ids, far_ids = reduced(warped) > 0.5, picked(ids), picked(far_ids)
    without_renders, own = replace(drive, render_at=None), []
    for n, (view, far, warped_ids, found) in enumerate(zip(small, far_ids, ids, warped, strict=True)):
        render = None if renders is None else renders.map(lambda x, n=n: x[n])
        here = without_renders.look(view, rules, far[0], lambda _, at=warped_ids[0]: at, render)
        own.append(here.with_hole(here.color, here.ids, found[0])[0])
    memory.rest_mapped()
    depth, valid = (torch.stack([getattr(o, name) for o in own])[:, None] for name in ("depth", "measured"))
    color, backdrop = reduced(color), reduced(backdrop)
    return Condition(tuple(small), color, depth, valid, reference, warped, backdrop, ids, far_ids, renders), fine


def _condition_of_view(
    drive: DriveInputs, view: View, rules: ConditionRules, among: Sequence[int], kept: dict[int, WarpSource]
) -> tuple[tuple[Tensor, ...], RenderPlanes | None]:
    """Colour f32[3,H,W], depth f32[1,H,W], valid and warped bool[1,H,W], backdrop f32[3,H,W], classes of the colour and
    of the backdrop u8[1,H,W] of one view, at its size; and its render. Images `among` the recorded ones are used."""

    def source(number: int) -> WarpSource:
        if number not in kept:
            kept[number] = _prepare_source(drive, drive.recorded[number], rules, view)
        return kept[number]

    recorded, shape = drive.recorded, (view.camera.height, view.camera.width)
    if not (rules.warp and among):
        unknown = torch.full(shape, palette.UNLABELLED, dtype=torch.uint8)
        here = drive.look(view, rules, unknown, lambda _: unknown)
        found = torch.zeros_like(here.measured)
        here, color, own_ids, found = here.with_hole(here.color, here.ids, found)
        ids = own_ids[None]
        return (color, here.depth[None], here.measured[None], found[None], color, ids, ids), here.render
    nearest = source(min(among, key=_rank_of_images(view, recorded)))

    def ids_at(depth: Tensor) -> Tensor:
        x, y, _ = carry(view, depth[None], nearest.view)
        return look_up_ids(nearest.semantics, x, y)[0]

    backdrop, far_ids, usable = _backdrop(view, nearest)
    here = drive.look(view, rules, far_ids[0], ids_at)
    color, depth, ids, found = here.color, here.depth, here.ids, torch.zeros_like(here.measured)
    shown = drive.cloud.colors
    backdrop = shown.image_of(view.camera.name, backdrop).clamp(0, 1)
    total, count = torch.zeros_like(color), torch.zeros(shape)
    for number in _order_of_images(view, depth, recorded, among, rules):
        image = source(number)
        fresh = abs(image.view.time_s - view.time_s) <= SAME_TIME_S
        surface = image.depth if fresh else torch.where(image.moving, torch.zeros_like(image.depth), image.depth)
        rgb, labels, visible = image.warped(view, depth, surface, rules.hidden_share)
        rgb = shown.image_of(view.camera.name, rgb).clamp(0, 1)
        visible = visible if fresh else visible & ~here.moving
        new = visible & ~found
        ids = torch.where(new & (labels != palette.UNLABELLED), labels, ids)
        apart = functional.avg_pool2d(rgb - color, ALIKE_PX, ceil_mode=True).abs().amax(0)
        same = (apart < ALIKE).repeat_interleave(ALIKE_PX, 0).repeat_interleave(ALIKE_PX, 1)
        color = torch.where(new, rgb, color)
        alike = new | (visible & same[: shape[0], : shape[1]])
        total, count, found = total + rgb * alike, count + alike, found | new
    color = torch.where(found, total / count.clamp(min=1), color)
    here, color, ids, found = here.with_hole(color, ids, found)
    # what is not usable is not part of the picture any more
    backdrop, far_ids = torch.where(usable, backdrop, color), torch.where(usable, far_ids, ids[None])
    return (color, depth[None], here.measured[None], found[None], backdrop, ids[None], far_ids), here.render


def _backdrop(view: View, image: WarpSource) -> tuple[Tensor, Tensor, Tensor]:
    """Colours f32[3,H,W], common ones, and classes u8[1,H,W] that a recorded image shows of what lies far away in the
    directions of a view; and which of its pixels bool[1,H,W] are usable. Near road users stand elsewhere in the view:
    what is around them is continued."""
    x, y, _ = carry(view, torch.full((1, view.camera.height, view.camera.width), BACKDROP_M), image.view)
    color, ids = look_up(image.rgb, x, y)[0], look_up_ids(image.semantics, x, y)
    users = torch.where(ids == palette.UNLABELLED, look_up_ids(image.moving, x, y), torch.isin(ids, MOVING_IDS))
    users &= look_up(image.depth[None], x, y, "nearest")[0] < BEHIND_M
    usable = torch.ones_like(users) if image.usable is None else look_up_ids(image.usable, x, y)
    ids, around = torch.where(usable, ids, palette.UNLABELLED), usable & ~users
    if bool(users.any()) and bool(around.any()):
        color = torch.where(users, _pulled(color[None] * around, around[None].float())[0], color)
        ids = torch.where(users, ids[0][nearest_pixels(around[0])][None], ids)
    return color, ids, usable


def _among_measured(sparse: ProjectedPoints, depth: Tensor) -> Tensor:
    """Which pixels are measured, or have measured ones of their filled depth f32[H,W] to both sides in some direction,
    at most twice `REACH_PX` away, bool[H,W]: the surface goes on there, whatever a render with holes shows."""
    reach = 2 * REACH_PX
    measured = torch.where(sparse.valid, sparse.depth, torch.inf)
    own = functional.pad(measured, (reach,) * 4, value=torch.inf)
    height, width = depth.shape

    def on_side(down: int, right: int) -> Tensor:
        found = torch.zeros_like(sparse.valid)
        for step in range(1, reach + 1):
            top, left = reach + step * down, reach + step * right
            there = own[top : top + height, left : left + width]
            found |= (there - depth).abs() <= ANOTHER_SURFACE * depth
        return found

    between = sparse.valid.clone()
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        between |= on_side(down, right) & on_side(-down, -right)
    return between


def _published_condition(
    drive: DriveInputs, views: Sequence[View], reference: Tensor, rules: ConditionRules
) -> Condition:
    own, native = rules.size, rules.fine
    seen = views if native == own else [view.resized(*native) for view in views]
    sparse = [rules.project(drive.cloud, drive.tracks, view) for view in seen]
    valid = torch.stack([s.valid for s in sparse])[:, None]
    color = torch.stack([drive.weathered_points(view, s) for view, s in zip(seen, sparse, strict=True)]) * valid
    depth = torch.stack([s.depth for s in sparse])[:, None] * valid
    if native != own:
        color = functional.interpolate(color, size=own[::-1], mode="nearest")
        depth = functional.interpolate(depth, size=own[::-1], mode="bilinear", align_corners=False)
        valid = (color > 0).any(1, keepdim=True) | (depth > 0)
    # what visible points measure, on a grid at least as fine as the camera's and the condition's; each pixel takes the
    # cell in its middle: depth is never mixed, and the nearest of many points in a coarse pixel is not preferred
    visible, grid = replace(rules, published=False), (max(own[0], rules.fine_width), max(own[1], rules.fine_height))
    finer = views if grid == own else [view.resized(*grid) for view in views]
    points = [visible.project(drive.cloud, drive.tracks, view) for view in finer]
    whole = SparseDepth(*(torch.stack([getattr(p, name) for p in points])[:, None] for name in ("depth", "valid")))
    picked = lambda x: functional.interpolate(x.float(), size=own[::-1], mode="nearest-exact").to(x.dtype)
    return Condition(tuple(views), color, depth, valid, reference, measured=whole.map(picked))


def _reference(drive: DriveInputs, view: View, among: Sequence[int], rules: ConditionRules) -> Tensor:
    recorded = [drive.recorded[number] for number in among]
    own = [r for r in recorded if r.view.camera.name == view.camera.name] or recorded
    if not own:
        return torch.zeros(3, *rules.size[::-1])
    nearest = min(own, key=lambda r: abs(r.view.time_s - view.time_s))
    rgb = nearest.rgb
    if nearest.usable is not None and not nearest.usable.all():
        rows, columns = nearest_pixels(torch.from_numpy(nearest.usable))
        rgb = rgb[rows.numpy(), columns.numpy()]
    if rules.published:
        rgb = drive.weathered_photo(nearest.view, rgb)
    if rules.published and rules.fine_width:
        size = rules.size[::-1]
        return functional.interpolate(image_tensor(rgb)[None], size=size, mode="bilinear", align_corners=False)[0]
    return image_tensor(resize_area(rgb, *rules.size))


def image_tensor(rgb: NDArray[np.uint8]) -> Tensor:
    """Image u8[H,W,3] as f32[3,H,W] in [0,1]."""
    return torch.from_numpy(rgb.copy()).permute(2, 0, 1).float().div(255.0).contiguous()


def _rank_of_images(view: View, recorded: Sequence[Photo]) -> Callable[[int], tuple[float, bool, float]]:
    """What sorts recorded images by how well they serve a view: nearest in time first (steps of 20 ms), the same camera
    before others, then by distance."""

    def rank(number: int) -> tuple[float, bool, float]:
        other = recorded[number].view
        distance_m = float(np.linalg.norm(other.center_world - view.center_world))
        elsewhere = other.camera.name != view.camera.name
        return round((abs(other.time_s - view.time_s) + OTHER_CAMERA_S * elsewhere) / 0.02), elsewhere, distance_m

    return rank


def _order_of_images(
    view: View, depth: Tensor, recorded: Sequence[Photo], among: Sequence[int], rules: ConditionRules
) -> list[int]:
    """The images to try for a view of depth f32[H,W], best first; without those that hardly overlap it, but for the
    first."""
    columns, rows = min(view.camera.width, OVERLAP_GRID[0]), min(view.camera.height, OVERLAP_GRID[1])
    coarse = view.resized(columns, rows)
    there = functional.interpolate(depth[None, None], size=(rows, columns), mode="nearest-exact")[0]
    chosen: list[int] = []
    for number in sorted(among, key=_rank_of_images(view, recorded)):
        if len(chosen) == rules.images_per_view:
            break
        other = recorded[number].view
        if not chosen or float(inside(other, *carry(coarse, there, other)).float().mean()) >= LEAST_OVERLAP:
            chosen.append(number)
    return chosen


def _prepare_source(drive: DriveInputs, recorded: Photo, rules: ConditionRules, target: View) -> WarpSource:
    """A recorded image brought to about as many pixels as the target view, with its depth."""
    camera = recorded.view.camera
    scale = (target.camera.width * target.camera.height / (camera.width * camera.height)) ** 0.5
    width, height = max(8, round(camera.width * scale)), max(8, round(camera.height * scale))
    view = recorded.view.resized(width, height)
    own = np.full((height, width), palette.UNLABELLED) if recorded.semantics is None else recorded.semantics
    own = torch.from_numpy(own.astype(np.uint8))[None, None]
    ids = functional.interpolate(own, size=(height, width), mode="nearest-exact")[0, 0]
    here = drive.look(view, rules, ids, lambda _: ids)
    rgb = image_tensor(resize_area(recorded.rgb, width, height))
    common = drive.cloud.colors.image_to_common(camera.name, rgb)
    usable = None
    if recorded.usable is not None:  # pixels that show nothing but usable ones
        spoilt = torch.from_numpy(~recorded.usable).float()[None, None]
        usable = functional.adaptive_max_pool2d(spoilt, (height, width))[0, 0] == 0
    return WarpSource(view, common, here.depth, here.moving, ids, usable)


# views in other weather or light ------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class InWeather:
    """Weather for the views of a drive: settings, light and ground of the drive, seed of drops and patches, and the
    velocity of the cameras at a time."""

    settings: Conditions
    drive: Surroundings
    seed: int
    velocity_at: Callable[[float], tuple[float, float, float]]

    def image(self, view: View, rgb: Tensor, depth: Tensor, ids: Tensor) -> Tensor:
        """Colours f32[3,H,W] in this weather, from depth f32[1,H,W] and classes u8[1,H,W]; sky has no depth."""
        metres = torch.where(ids == SKY_ID, torch.zeros_like(depth), depth)[0].numpy().astype(np.float32)
        shown = ShownView(view, rgb.permute(1, 2, 0).numpy(), metres, ids[0].numpy())
        made = weather.edited_view(shown, self.settings, self.seed, self.drive, self.velocity_at(view.time_s))
        return torch.from_numpy(np.ascontiguousarray(made.transpose(2, 0, 1), np.float32)).clamp(0, 1)


# planes of all views, in memory or in files -------------------------------------------------------


LARGE_PIXELS = 2_500_000
"""Planes of more pixels lie in files where there is a folder for them."""


class PreparedImages(dict[int, WarpSource]):
    """Recorded images made ready for warping, by their numbers, for all windows and trajectories that a process makes;
    colours as bytes where that is exact. folder: where large conditions are kept while they are used, in files without
    names; None: in memory."""

    def __init__(self, folder: Path | None = None) -> None:
        super().__init__()
        self.folder = folder

    def __setitem__(self, number: int, image: WarpSource) -> None:
        coarse = (image.rgb * 255).round().clamp(0, 255).to(torch.uint8)
        exact = torch.equal(coarse.float() / 255, image.rgb)
        super().__setitem__(number, replace(image, rgb=coarse) if exact else image)

    def __getitem__(self, number: int) -> WarpSource:
        image = super().__getitem__(number)
        return image if image.rgb.is_floating_point() else replace(image, rgb=image.rgb.float() / 255)


def stacked(rows: Iterable[Sequence[Tensor]], count: int, folder: Path | None) -> list[Tensor]:
    """``torch.stack`` of every column of ``count`` rows, of which only one is in memory besides. rows: planes ``[...,
    H, W]`` of one view each. folder: where large ones are put into files; None: all stay in memory."""

    def empty(like: Tensor) -> Tensor:
        if folder is None or like.shape[-2] * like.shape[-1] <= LARGE_PIXELS:
            return like.new_empty((count, *like.shape))
        return torch.from_numpy(memory.mapped_array(folder, (count, *like.shape), like.numpy().dtype))

    stacks: list[Tensor] = []
    for number, row in enumerate(rows):
        stacks = stacks or [empty(x) for x in row]
        for stack, x in zip(stacks, row, strict=True):
            stack[number] = x
        memory.rest_mapped()
    return stacks
