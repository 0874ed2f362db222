"""Every command as a function: paths and keyword settings in, the path of the result out.

    from mudg import verbs

    verbs.fuse("scenes/a", "runs/fused", voxel_m=0.08)
    verbs.fit("scenes/a", "runs/fused", "runs/fit", method="street_gaussians", loss={"lidar_weight": 0.2})

A setting has the name and the default that ``mudg VERB --help`` shows, without the dashes; a group of settings is a dictionary.
``config`` names a YAML file that is read before the keyword settings, as ``--config`` does. Unknown settings, values out of range and
outputs that hold something else are refused as on the command line, with the errors of ``mudg.base.errors``. A finished result of the same
settings and inputs is verified and reused; an interrupted one is resumed. Where a scene, clouds, a fit or views are read, the folder of a
finished ``run`` will do: its own are taken.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from mudg.base import config as configuration
from mudg.base.errors import UsageError
from mudg.stages import config as stage_config
from mudg.stages.editing.runs import parts_of, scene_at, views_at

Config = TypeVar("Config")
AnyPath = str | Path


def ingest(
    log: AnyPath, out: AnyPath, *, overwrite: bool = False, config: AnyPath | None = None, **settings: Any
) -> Path:
    """Turn a driving log, or the built-in ``"city"``, into a scene folder; returns the folder."""
    from mudg.stages import ingest as stage

    return stage.run(_settings(stage_config.IngestConfig, config, settings), log, Path(out), overwrite=overwrite)


def annotate(
    scene: AnyPath, out: AnyPath, *, overwrite: bool = False, config: AnyPath | None = None, **settings: Any
) -> Path:
    """Add dense depth, classes, sky and dynamic objects to a scene, each with a confidence; returns the new scene's folder."""
    from mudg.stages import annotate as stage

    return stage.run(
        _settings(stage_config.AnnotateConfig, config, settings), scene_at(Path(scene)), Path(out), overwrite=overwrite
    )


def fuse(
    scene: AnyPath, out: AnyPath, *, overwrite: bool = False, config: AnyPath | None = None, **settings: Any
) -> Path:
    """Fuse the LiDAR of a scene into coloured clouds, one static and one per object; returns their folder."""
    from mudg.stages import fuse as stage

    return stage.run(_settings(stage_config.FuseConfig, config, settings), scene_at(Path(scene)), Path(out), overwrite=overwrite)


def learn(out: AnyPath, *, overwrite: bool = False, config: AnyPath | None = None, **settings: Any) -> Path:
    """Train a diffusion model; returns the model's folder."""
    from mudg.stages import learn as stage

    return stage.run(_settings(stage_config.LearnConfig, config, settings), Path(out), overwrite=overwrite)


def convert(
    checkpoint: AnyPath, to: AnyPath, *, overwrite: bool = False, config: AnyPath | None = None, **settings: Any
) -> Path:
    """Turn a published checkpoint into a model folder; returns the folder."""
    from mudg.stages import convert as stage

    made = _settings(stage_config.ConvertConfig, config, settings)
    return stage.run(made, Path(checkpoint), Path(to), overwrite=overwrite)


def adapt(
    scene: AnyPath, fused: AnyPath, fitted: AnyPath, out: AnyPath, *,
    overwrite: bool = False, config: AnyPath | None = None, **settings: Any,
) -> Path:  # fmt: skip
    """Adapt the diffusion model to a recorded log, with renders of the scene ``fitted`` to it; returns the model's folder."""
    from mudg.stages import adapt as stage

    made = _settings(stage_config.AdaptConfig, config, settings)
    parts = parts_of({"scene": scene, "fused": fused, "fitted": fitted})
    return stage.run(made, parts["scene"], parts["fused"], parts["fitted"], Path(out), overwrite=overwrite)


def synthesize(
    scene: AnyPath, fused: AnyPath, out: AnyPath, *,
    fitted: AnyPath | None = None, edits: AnyPath | None = None, overwrite: bool = False, config: AnyPath | None = None,
    **settings: Any,
) -> Path:  # fmt: skip
    """Generate colour, depth and classes on shifted trajectories; returns the folder of observation sets.

    Args:
        edits: an edit script; the views are of the drive as it says.
    """
    from mudg.stages import synthesize as stage

    made = _settings(stage_config.SynthesizeConfig, config, settings)
    parts = parts_of({"scene": scene, "fused": fused, "fitted": fitted})
    return stage.run(
        made, parts["scene"], parts["fused"], Path(out), fitted=parts["fitted"], edits=_optional(edits), overwrite=overwrite
    )


def fit(
    scene: AnyPath, fused: AnyPath | None, out: AnyPath, *,
    observations: AnyPath | Sequence[AnyPath] = (), start_from: AnyPath | None = None, overwrite: bool = False,
    config: AnyPath | None = None, **settings: Any,
) -> Path:  # fmt: skip
    """Fit a dynamic Gaussian scene to recorded and, with ``observations``, generated views; returns the model's folder.

    Args:
        fused: point clouds of fuse; None for method emernerf, which does not read them.
        start_from: a finished fit of ``street_gaussians`` to the same scene, to go on with for ``iterations`` more steps.
    """
    from mudg.stages import fit as stage

    made = _settings(stage_config.FitConfig, config, settings)
    parts = parts_of({"scene": scene, "fused": fused, "start_from": start_from})
    return stage.run(
        made, parts["scene"], parts["fused"], Path(out),
        observations=tuple(map(views_at, _several(observations))), start=parts["start_from"], overwrite=overwrite,
    )  # fmt: skip


def render(
    scene: AnyPath, model: AnyPath, out: AnyPath, *,
    edits: AnyPath | None = None, fused: AnyPath | None = None, overwrite: bool = False, config: AnyPath | None = None,
    **settings: Any,
) -> Path:  # fmt: skip
    """Render a fitted scene on recorded and shifted trajectories; returns the folder of observation sets and videos.

    Args:
        edits: an edit script to carry out before.
        fused: point clouds of fuse, for settings of ``harmonize``.
    """
    from mudg.stages import render as stage

    made = _settings(stage_config.RenderConfig, config, settings)
    parts = parts_of({"scene": scene, "model": model, "fused": fused})
    return stage.run(made, parts["scene"], parts["model"], Path(out), edits=_optional(edits), fused=parts["fused"], overwrite=overwrite)


def page(
    run: AnyPath, out: AnyPath, *, scene: AnyPath | None = None, compare: AnyPath | None = None,
    overwrite: bool = False, config: AnyPath | None = None, **settings: Any,
) -> Path:  # fmt: skip
    """Write a fitted scene as one HTML page; returns the page (``index.html`` of a folder above 32 MB).

    Args:
        scene: the log of a fit; a run has its own. compare: a second run or fit of the same log.
    """
    from mudg.stages.viewing import view as stage

    made = _settings(stage_config.PageConfig, config, settings)
    return stage.run_page(made, Path(run), Path(out), scene=_optional(scene), compare=_optional(compare), overwrite=overwrite)["page"]


def report(runs: Sequence[AnyPath], out: AnyPath, *, overwrite: bool = False) -> Path:
    """Write one page over finished folders of ``run``, ``score`` or ``bench``; returns the page."""
    from mudg.stages.viewing import gallery as stage

    return stage.run([Path(run) for run in runs], Path(out), overwrite=overwrite)["page"]


def edit(
    source: AnyPath, script: AnyPath, out: AnyPath, *,
    scene: AnyPath | None = None, fused: AnyPath | None = None, overwrite: bool = False,
    config: AnyPath | None = None, **settings: Any,
) -> Path:  # fmt: skip
    """Change a fit, or a whole run, as an edit script says; returns the folder of the edited one.

    Args:
        source: folder of a fit or of ``run``. scene, fused: of a fit, its scene and clouds; a run has its own.
    """
    from mudg.stages import edit as stage

    made = _settings(stage_config.EditConfig, config, settings)
    return stage.run(
        made, Path(source), Path(script), Path(out), scene=_optional(scene), fused=_optional(fused), overwrite=overwrite
    )


def export_asset(
    source: AnyPath, track_id: str, out: AnyPath, *, scene: AnyPath | None = None, overwrite: bool = False
) -> Path:
    """Write an object of a fit, or of a run, to a file that edit scripts can insert; returns the file."""
    from mudg.stages.editing import assets

    return assets.run_export(Path(source), track_id, Path(out), _optional(scene), overwrite)


def import_asset(
    file: AnyPath, out: AnyPath, *, overwrite: bool = False, config: AnyPath | None = None, **settings: Any
) -> Path:
    """Make an asset, or with ``kind="scene"`` the folder of a fit, of a file of Gaussians from another program; returns it."""
    from mudg.stages.exporting import imports

    return imports.run(_settings(stage_config.ImportConfig, config, settings), Path(file), Path(out), overwrite=overwrite)


def export(
    format: str, source: AnyPath, out: AnyPath, *,
    scene: AnyPath | None = None, edits: AnyPath | None = None, overwrite: bool = False,
    config: AnyPath | None = None, **settings: Any,
) -> Path:  # fmt: skip
    """Write a fitted scene, or the cameras of its log, for other programs; returns the file or folder.

    Args:
        format: ``ply``, ``spz``, ``usdz``, ... (``docs/export.md``). source: folder of a fit, of ``run``, or of a scene.
    """
    from mudg.stages.exporting import export as stage

    made = _settings(stage_config.ExportConfig, config, settings)
    return stage.run(made, format, Path(source), Path(out), scene=_optional(scene), edits=_optional(edits), overwrite=overwrite)


def score(
    scene: AnyPath, views: Mapping[str, AnyPath], out: AnyPath, *,
    fused: AnyPath | None = None, overwrite: bool = False, config: AnyPath | None = None, **settings: Any,
) -> Path:  # fmt: skip
    """Score views of several methods (name -> folder) against truth where there is some; returns the folder of ``metrics.json``."""
    from mudg.stages import score as stage

    made = _settings(stage_config.ScoreConfig, config, settings)
    if not isinstance(views, Mapping):
        raise UsageError(
            "views are names with their folders", where="views", expected="{name: folder}", got=repr(views)
        )
    folders = {name: views_at(Path(folder), name) for name, folder in views.items()}
    parts = parts_of({"scene": scene, "fused": fused})
    return stage.run(made, parts["scene"], folders, Path(out), fused=parts["fused"], overwrite=overwrite)


def run(
    log: AnyPath, out: AnyPath, *,
    preset: stage_config.PresetName | None = None, fast: bool = False, seed: int | None = None, overwrite: bool = False,
    config: AnyPath | None = None, **settings: Any,
) -> dict[str, Any]:  # fmt: skip
    """Run the whole chain on a driving log, a scene or ``"city"``.

    Args:
        preset: ``fast``, ``default``, ``quality`` or ``paper``: what the settings start from. fast: the same as ``preset="fast"``.
        seed: of the city and of every random draw.
        settings: one dictionary per verb, and ``cameras`` and ``shifts_m`` (metres, positive to the left) for all of them.

    Returns:
        Paths of the report and of what each verb made, and the closing table as ``text``.
    """
    from mudg.stages import run as stage

    base = stage_config.run_preset(stage_config.chosen_preset(preset, fast))
    common = {"seed": seed, **{name: settings.pop(name, None) for name in ("cameras", "shifts_m")}}
    given = {name: value for name, value in common.items() if value is not None}
    checked = configuration.load(stage_config.SynthesizeConfig, overrides=given)
    if seed is not None:
        base = stage_config.with_seed(base, checked.seed)
    cameras = checked.cameras if "cameras" in given else None
    shifts_m = checked.shifts_m if "shifts_m" in given else None
    made = _settings(stage_config.RunConfig, config, settings, base)
    return stage.run_chain(
        stage_config.with_lines(made, cameras=cameras, shifts_m=shifts_m), log, Path(out), overwrite=overwrite
    )


def bench(
    name: str, out: AnyPath, *,
    sources: Sequence[AnyPath] = (), overwrite: bool = False, preset: stage_config.PresetName = "default",
    config: AnyPath | None = None, **settings: Any,
) -> Path:  # fmt: skip
    """Run a benchmark; returns the folder of ``bench.json``.

    Args:
        name: ``mdm``, ``poses``, ``edit`` or ``shift``, against exact truth, ``real`` or ``paper``. sources: logs or scenes, for ``real``
            and ``paper`` (which also takes ``city:reported``); finished runs, for ``edit``. preset: settings that ``shift``, ``real`` and
            ``paper`` start from.
    """
    from mudg.bench import run as stage

    made = _settings(stage_config.BenchConfig, config, settings, stage_config.bench_preset(preset))
    return stage.run(name, made, Path(out), sources=[Path(source) for source in sources], preset=preset, overwrite=overwrite)


def doctor(scene: AnyPath | None = None) -> dict[str, Any]:
    """Say what this machine offers or, with a scene, what is wrong with it."""
    from mudg.stages import doctor as stage

    return stage.report_machine() if scene is None else stage.report_scene(Path(scene))


def _settings(
    kind: type[Config], file: AnyPath | None, settings: Mapping[str, Any], preset: Config | None = None
) -> Config:
    return configuration.load(kind, preset, _optional(file), _with_text_paths(settings))


def _with_text_paths(value: Any) -> Any:
    """Settings hold paths as text, in files as here."""
    if isinstance(value, Mapping):
        return {name: _with_text_paths(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_with_text_paths(inner) for inner in value]
    return str(value) if isinstance(value, Path) else value


def _several(paths: AnyPath | Sequence[AnyPath]) -> tuple[Path, ...]:
    return (Path(paths),) if isinstance(paths, (str, Path)) else tuple(map(Path, paths))


def _optional(path: AnyPath | None) -> Path | None:
    return None if path is None else Path(path)
