"""``mudg fit``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self, cast, get_args

from mudg.base import config as configuration
from mudg.base.errors import UsageError
from mudg.base.layout import MODEL_FILES
from mudg.steps.engine import Make, Watched, paths_of
from mudg.steps.step import SCENE, Flag, flag_name, hint_of

if TYPE_CHECKING:
    from mudg.base.run_folder import VerbOutput
    from mudg.gaussians.settings import FitConfig


class Fit(Watched):
    """Fit a dynamic 3D Gaussian scene to recorded (and virtual) views."""

    examples = (
        "mudg fit scenes/city --fused runs/fused --method street_gaussians --out runs/plain",
        "mudg fit scenes/city --fused runs/fused --observations runs/virtual --out runs/mudg_s",
        (
            "mudg fit scenes/city --fused runs/fused --observations runs/virtual --start-from runs/plain --iterations"
            " 1000 --out runs/mudg_s"
        ),
    )
    smaller = "smaller images (mudg ingest --resolution), fewer Gaussians (--start.gaussians, --densify.max-gaussians)"
    result = "model"
    choice: ClassVar[str] = "method"
    version = 3
    files = (*MODEL_FILES, "appearance.json", "appearance.safetensors", "field.safetensors", "preview/*.png", "steps/")
    short = ("method", "iterations", "cameras", "width_px", "sh_degree", "seed", "device", "densify.max_gaussians")
    scene: Annotated[Path, SCENE]
    """Scene directory written by ingest or annotate, or folder of mudg run."""
    fused: Annotated[Path | None, Flag("FOLDER", "second", "fused")] = None
    """Point clouds written by fuse; required by every method but emernerf."""
    observations: Annotated[tuple[Path, ...], Flag("FOLDER ...", "", "views")] = ()
    """Virtual views written by synthesize, in one folder or several; required by method mudg_s."""
    start_from: Annotated[Path | None, Flag("FOLDER", "", "start_from")] = None
    """Finished fit of method street_gaussians to the same scene, to continue for `iterations` more steps. Virtual views
    are used from the first of them on."""
    settings: FitConfig

    def required(self) -> tuple[str, ...]:
        alone = self.reads_scene_alone or (self.scene / "scene.json").exists()
        return () if alone else ("fused",)

    @classmethod
    def settings_from(cls, inputs: Mapping[str, Any], file: Path | None, given: Mapping[str, Any]) -> FitConfig:
        """UsageError for a setting that was given and does not apply to the method."""
        settings = super().settings_from(inputs, file, given)
        for name in configuration.dotted(given):
            if not cls.suits(settings.method, name):
                own = [method for method in get_args(hint_of(type(settings), "method")) if cls.suits(method, name)]
                what, remedy = f"this setting does not apply to --method {settings.method}", "leave it out"
                raise UsageError(what, where=flag_name(name), expected=f"one of {', '.join(own)}", remedy=remedy)
        return settings

    @classmethod
    def suits(cls, choice: str, name: str) -> bool:
        """See ``Step``: settings of a method."""
        from mudg.gaussians.settings import has_setting

        return has_setting(choice, name)

    @property
    def reads_scene_alone(self) -> bool:
        """Whether the method has no Gaussians: it starts from no clouds."""
        from mudg.gaussians.settings import METHODS

        return METHODS[self.settings.method].scene == "radiance"

    def output(self) -> VerbOutput:
        """Methods without boxes fuse the clouds again; results of those that took the ones of `mudg fuse` are made
        again."""
        from mudg.gaussians.settings import METHODS

        own = super().output()
        if self.reads_scene_alone or METHODS[self.settings.method].boxes:
            return own
        return replace(own, version=own.version + 1)

    def checked(self) -> Self:
        if self.reads_scene_alone:
            if self.start_from is not None:
                what = f"{self.settings.method} cannot go on with a finished fit"
                raise UsageError(what, remedy="leave --start-from out")
            return self
        from mudg.gaussians import fit

        continued = self.start_from is not None
        fit.check(self.settings, fused=self.fused is not None, virtual=bool(self.observations), continued=continued)
        return self

    def reads(self) -> dict[str, Path | str | None]:
        if self.reads_scene_alone:
            return {"scene": self.scene}
        return super().reads() | {"virtual.lpips-weights": self.settings.virtual.lpips_weights}

    def inputs(self) -> dict[str, str]:
        return self.digests(self.places())

    def places(self) -> dict[str, Path | None]:
        return {"scene": self.scene} if self.reads_scene_alone else {"scene": self.scene, "fused": self.fused}

    def prepare(self, inputs: dict[str, str]) -> Make:
        if self.reads_scene_alone:
            from mudg.base.devices import choose_device
            from mudg.baselines.emernerf import fit_radiance

            return partial(fit_radiance, self.settings, self.scene, choose_device(self.settings.device, "fit"))
        from mudg.core.raster.rasterize import drawing_device
        from mudg.gaussians import fit
        from mudg.gaussians.settings import METHODS
        from mudg.gaussians.storage import StartFit
        from mudg.gaussians.views import virtual_sets

        virtual, begun = {}, None if self.start_from is None else StartFit.of_folder(self.start_from, inputs)
        inputs |= {} if begun is None else {"start": begun.digest}
        if METHODS[self.settings.method].learns_virtual:
            virtual = virtual_sets(self.observations)
            named = {name: path for name, path in paths_of(self).items() if name.startswith("observations")}
            inputs |= self.digests(named)
        inputs |= self.digests({"lpips_weights": self.settings.virtual.lpips_weights})
        drawing_device(self.settings.device, "fit", self.settings.raster)  # refused before anything is written
        given = self.settings, self.scene, cast("Path", self.fused)
        return partial(fit.write_fit, *given, virtual=virtual, start=begun)
