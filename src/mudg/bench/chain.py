"""The fits of benchmarks, made as ``mudg run`` makes them: one on recorded views, and those under virtual views go on with it.

OUT/fit/<method>   every fit      OUT/start/<method>   what a variant with other settings of the first fit goes on with
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mudg.base.errors import UsageError
from mudg.methods import METHODS
from mudg.stages import fit
from mudg.stages.config import FitConfig
from mudg.stages.run import WITHOUT_DIFFUSION, fits_of


def made(make: Callable[[bool], Path], overwrite: bool) -> Path:
    """Make or reuse a folder; what other settings left there is replaced only if that was asked for.

    Args:
        make: called with whether to replace.
    """
    try:
        return make(False)
    except UsageError:
        if not overwrite:
            raise
        return make(True)


def learns_virtual(settings: FitConfig) -> bool:
    """Whether a fit of these settings uses generated views."""
    return "virtual" in METHODS[settings.method].supervision


@dataclass(frozen=True)
class FitChain:
    """The fits of one scene.

    Args:
        out: folder of all. scene, fused: what is fitted.
        usual: settings of the whole chain, as ``mudg run`` takes them; the first fit has them.
        overwrite: replace what other settings left there.
    """

    out: Path
    scene: Path
    fused: Path
    usual: FitConfig
    overwrite: bool

    def first(self) -> Path:
        """The fit on recorded views with the usual settings, made if need be."""
        return self._made(fits_of(self.usual)[0], self.out / "fit" / WITHOUT_DIFFUSION)

    def fitted(self, name: str, settings: FitConfig, virtual: Sequence[Path]) -> Path:
        """The fit of a method, made if need be.

        Args:
            settings: as ``mudg run`` takes them. Where the method learns from ``virtual`` views, it goes on with a fit on recorded views
                of the same settings: the first one, if these are the usual ones but for virtual views.
        """
        out = self.out / "fit" / name
        if not learns_virtual(settings):
            return self._made(settings, out)
        plain, guided = fits_of(settings)
        plain = replace(plain, virtual=self.usual.virtual)
        begun = self.first() if plain == fits_of(self.usual)[0] else self._made(plain, self.out / "start" / name)
        return self._made(guided, out, virtual, begun)

    def _made(self, settings: FitConfig, out: Path, virtual: Sequence[Path] = (), begun: Path | None = None) -> Path:
        def make(overwrite: bool) -> Path:
            return fit.run(
                settings, self.scene, self.fused, out, observations=virtual, start=begun, overwrite=overwrite
            )

        return made(make, self.overwrite)
