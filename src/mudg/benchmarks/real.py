"""``mudg bench real``: complete methods on real logs, against what the log recorded and the methods did not see. A
protocol (``places.PROTOCOLS``) says what is hidden and what is scored. Methods are given scenes from which the hidden
part was removed, so they cannot use it. docs/bench_real.md lists the folders."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from mudg.base import store
from mudg.base.html import markdown_table
from mudg.base.layout import SCENE_FILES
from mudg.base.run_folder import RunDir
from mudg.base.types import Scene
from mudg.benchmarks.chain import Chain, compare, refuse, run_step, virtual_fits_of
from mudg.benchmarks.columns import COLUMNS, MakeTargets, ScoreTargets, mean_values, read_targets
from mudg.benchmarks.places import (
    SPLITS,
    HeldOut,
    Protocol,
    Split,
    first_camera,
    held_out,
    imported,
    labelled,
    names_of,
    protocols_of,
)
from mudg.benchmarks.rows import BASE, FILL, Facts, Row, generator_of, method_rows, settings_of
from mudg.benchmarks.settings import BenchConfig
from mudg.editing import render
from mudg.editing.settings import RenderConfig
from mudg.scene.read import read_scene
from mudg.scene.write import write_part
from mudg.steps.engine import Output
from mudg.steps.settings import PresetName


class PartOfScene(Output):
    """A part of a scene that a split shows."""

    verb_name = "part of a scene"
    version, files = 1, SCENE_FILES
    split: str
    shown: tuple[str, ...]
    digests_read: Mapping[str, str]
    write: Callable[[Path], Scene]

    def inputs(self) -> dict[str, str]:
        return dict(self.digests_read)

    def key_settings(self) -> dict[str, Any]:
        return {"split": self.split, "shown": list(self.shown)}

    def make(self, work: RunDir) -> dict[str, Any]:
        scene = self.write(work.path)
        return {"frames": len(scene.frames), "sweeps": len(scene.sweeps)}


def run(
    config: BenchConfig, sources: Sequence[Path], out: Path, *, preset: PresetName = "default", overwrite: bool = False
) -> Path:
    """Compare methods on real logs; returns ``out`` with ``bench.json`` and ``bench.md``; what lies there of the same
    settings is reused, and logs, protocols and methods may be added later. ``sources``: folders of dataset logs, or
    scenes made by ``mudg ingest``. ``preset``: what ``config`` started from. ``overwrite``: replace what other settings
    left in ``out``. UsageError: no log, an unknown method or protocol, a setting that no row uses, two logs of one
    name, or ``out`` holds something else. Whatever a verb raises."""
    rows, protocols = method_rows(config, preset), protocols_of(config.protocols)
    logs, out = names_of(sources), Path(out)
    refuse("real", config, preset, rows, out, read={f"log {name}": path for name, path in logs.items()})
    scenes = {name: imported(config, path, out / name / "scene", overwrite) for name, path in logs.items()}
    own: dict[str, list[Protocol]] = {}
    for protocol in protocols:
        own.setdefault(protocol.split, []).append(protocol)
    jobs = {
        f"{name} {split}": SplitJob(out / name, scene, SPLITS[split], tuple(of), rows, config, overwrite)
        for name, scene in scenes.items()
        for split, of in own.items()
    }
    how = {"shown_cameras": list(config.shown), "resolution": config.resolution, "frames": config.frames}
    how |= {"virtual_shifts_m": list(config.synthesize.shifts_m)}
    settings = settings_of(config, preset, {"protocols": list(config.protocols)}, how)
    methods = [{"name": r.name, "title": r.title, "fit": "" if r.fit is None else r.method} for r in rows]

    def filled(measured: list[dict[str, Any]]) -> dict[str, Any]:
        pairs = list(zip(jobs.values(), measured, strict=True))
        of = lambda name: [result for job, result in pairs if job.out.name == name]
        entries = [_entry(name, scene, of(name)) for name, scene in scenes.items()]
        return document(entries, methods, protocols, settings)

    return compare(out, {title: job.measure for title, job in jobs.items()}, config, filled, markdown)


# ---- one log under one way of hiding ----


@dataclass(frozen=True)
class SplitJob:
    """Everything of one log under one way of hiding."""

    out: Path
    source: Path
    split: Split
    protocols: tuple[Protocol, ...]
    rows: tuple[Row, ...]
    config: BenchConfig
    overwrite: bool

    @property
    def folder(self) -> Path:
        """Of this way of hiding."""
        return self.out / self.split.name

    def chain(self) -> Chain:
        """Its steps, on what the methods see; generated views lie beside the recorded path."""
        scene = self.folder / "scene"
        beside = replace(generator_of(self.config), cameras=(first_camera(read_scene(scene), self.config.shown),))
        return Chain(self.folder, scene, self.config, self.overwrite, beside)

    def measure(self) -> dict[str, Any]:
        """Values by protocol and method, facts, and why protocols were left out."""
        whole = read_scene(self.source)
        held = held_out(whole, self.split, self.config.shown)
        if held.reason:
            left_out = {p.name: {"left_out": held.reason} for p in self.protocols}
            return {"split": self.split.name, "held_out": {}, "protocols": left_out}
        self.write_seen(whole, held)
        chain, cameras = self.chain(), self.cameras(whole, held)
        truths, result = [], {}
        for protocol in self.protocols:
            step = {"log": self.source, "shown": chain.scene, "protocol": protocol, "held": tuple(held.frames)}
            truth = chain.run(MakeTargets(**step, cameras=cameras, out=self.out / "truth" / protocol.name))
            targets = read_targets(truth)
            result[protocol.name] = {"facts": targets.facts, "values": {}}
            if targets.records:
                truths.append((protocol, truth))
            else:
                result[protocol.name]["left_out"] = targets.reason
        if truths:
            chain.fuse()
        for row in self.rows if truths else ():
            views = self.views(row, chain, cameras)
            for protocol, truth in truths:
                step = {"log": self.source, "truth": truth, "views": views, "protocol": protocol}
                out = self.out / "score" / protocol.name / row.name
                scored = chain.run(ScoreTargets(**step, device=self.config.device, out=out))
                result[protocol.name]["values"][row.name] = store.read_json(scored / "metrics.json")
        return {"split": self.split.name, "held_out": dict(held.facts), "protocols": result}

    def write_seen(self, whole: Scene, held: HeldOut) -> None:
        """Write what the methods see: the shown frames and sweeps; these with the labels that they lack; the same with
        the places of held-out frames; and these places alone (``asked``), for rendering."""
        frames = {f.id for f in whole.frames} - set(held.frames)
        sweeps = {s.id for s in whole.sweeps} - set(held.sweeps)
        places, inputs = held.places(whole), {"log": store.digest(self.source)}
        shown = self._write(self.folder / "shown", inputs, lambda root: write_part(whole, root, frames, sweeps))
        labels = labelled(shown, self.folder / "annotate", self.config.device, self.overwrite)
        seen, inputs = read_scene(labels), {"shown": store.digest(labels), **inputs}
        self._write(self.folder / "scene", inputs, lambda root: write_part(seen, root, frames, sweeps, places))
        if places:
            self._write(self.folder / "asked", inputs, lambda root: write_part(whole, root, (), (), places))

    def _write(self, out: Path, inputs: dict[str, str], write: Callable[[Path], Scene]) -> Path:
        """Write a part of a scene as a folder that is verified and reused."""
        part = {"split": self.split.name, "shown": tuple(self.config.shown), "digests_read": inputs, "write": write}
        return run_step(PartOfScene(**part, out=out, overwrite=self.overwrite))

    def cameras(self, whole: Scene, held: HeldOut) -> tuple[str, ...]:
        """The cameras whose views are asked for."""
        if not self.split.all_cameras:
            return (first_camera(whole, self.config.shown),)
        hidden = {frame.view.camera.name for frame in held.places(whole)}
        return tuple(name for name in whole.cameras if name in hidden)

    def views(self, row: Row, chain: Chain, cameras: tuple[str, ...]) -> Path:
        """The folder with a method's views at all places that are asked for, made if need be. Fits learn from generated
        views beside the recorded path, and where views of hidden frames are asked for."""
        places = self.folder / "asked" if (self.folder / "asked").is_dir() else chain.scene
        drawn = RenderConfig(cameras=cameras, shifts_m=self.split.shifts_m, video=False, device=self.config.device)
        if row.name == FILL:
            return chain.filled(render.trajectories(read_scene(places), drawn))
        scored = replace(chain.generator, cameras=cameras, shifts_m=self.split.shifts_m)
        if row.fit is None:
            return chain.generated(scored, self.folder / "generated")
        virtual = list[Path]()
        if row.learns_virtual:
            virtual.append(chain.generated(chain.generator, self.folder / "virtual"))
            if self.split.by_camera or self.split.block:
                virtual.append(chain.generated(scored, self.folder / "generated"))
        return chain.rendered(row, virtual, drawn, places)


# ---- numbers ----


def _entry(name: str, scene: Path, splits: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A log with its facts and all its values."""
    loaded = read_scene(scene)
    sizes = {name: [camera.width, camera.height] for name, camera in loaded.cameras.items()}
    cameras = {camera: {"size_px": of, "frames": len(loaded.frames_of(camera))} for camera, of in sizes.items()}
    names = {"log": name, "id": loaded.id, "dataset": loaded.source.dataset, "digest": store.digest(scene)}
    counts = {"cameras": cameras, "sweeps": len(loaded.sweeps), "tracks": len(loaded.tracks)}
    held_out = {s["split"]: s["held_out"] for s in splits}
    protocols = {protocol: result for s in splits for protocol, result in s["protocols"].items()}
    return {**names, **counts, "held_out": held_out, "protocols": protocols}


def document(
    logs: Sequence[Facts], rows: Sequence[Facts], protocols: Sequence[Protocol], settings: Facts
) -> dict[str, Any]:
    """Everything ``bench.json`` holds: per protocol, log and method the values by place and their mean; the means over
    the logs that have a number; and differences (or ratios) to the fit without diffusion."""
    names, result = [row["name"] for row in rows], {}
    for protocol in protocols:
        entries = {entry["log"]: entry["protocols"][protocol.name] for entry in logs}
        counted = [entry["values"] for entry in entries.values() if "left_out" not in entry]
        pooled = {name: mean_values([values[name]["mean"] for values in counted], protocol.columns) for name in names}
        against = {}
        for name in names if BASE in names else ():
            if name != BASE:
                of, base = pooled[name], pooled[BASE]
                against[name] = {c: COLUMNS[c].compared(of[c], base[c]) for c in protocol.columns}
        left_out = {log: entry["left_out"] for log, entry in entries.items() if "left_out" in entry}
        row = {"row": asdict(protocol), "logs": entries, "pooled": pooled}
        result[protocol.name] = {**row, "left_out": left_out, "against": against}
    facts = [{key: value for key, value in entry.items() if key != "protocols"} for entry in logs]
    head = {"schema": 1, "bench": "real", "settings": dict(settings), "methods": list(rows)}
    return {**head, "logs": facts, "protocols": result}


# ---- text ----


def table_of(doc: Facts, protocol: str, values: Mapping[str, Facts]) -> list[str]:
    """Lines of a table of methods' values, each in brackets with its comparison with the fit without diffusion."""
    columns = doc["protocols"][protocol]["row"]["columns"]
    rows, base = [], values.get(BASE)
    for method, of in values.items():
        against = {} if base is None or method == BASE else base
        more = {name: COLUMNS[name].compared_text(of[name], against.get(name)) for name in columns}
        texts = [COLUMNS[name].text(of[name]) + (f" ({more[name]})" if more[name] else "") for name in columns]
        rows.append([method, *texts])
    return markdown_table(["method", *(COLUMNS[name].title for name in columns)], rows)


def notes_of(doc: Facts, protocol: str) -> list[str]:
    """Sentences about a protocol: what was held out of each log, how much of it was seen, and what was left out."""
    result, lines = doc["protocols"][protocol], []
    for log in doc["logs"]:
        name, split = log["log"], result["row"]["split"]
        if name in result["left_out"]:
            lines.append(f"{name} is left out: {result['left_out'][name]}.")
            continue
        held, facts = log["held_out"].get(split, {}), result["logs"][name]["facts"]
        words = [f"{count} view{'' if count == 1 else 's'} of {place}" for place, count in facts["views"].items()]
        if "blocks" in held:
            blocks = ", ".join(f"{a}" if a == b else f"{a} to {b}" for a, b in held["blocks"])
            words.append(f"held out of {held['moments']} frames: {blocks}")
        for place, share in facts["seen_share"].items():
            words.append(f"{share:.0%} of {place} was seen, {facts['weight'].get(place, 0):.0%} of all seen pixels")
        words += [f"{place} is left out ({reason})" for place, reason in facts["left_out"].items()]
        lines.append(f"{name}: {'; '.join(words)}.")
    return lines


def markdown(doc: Facts) -> str:
    """The tables for people; those of single places stand only where a log has several."""
    settings, logs = doc["settings"], []
    for log in doc["logs"]:
        cameras = log["cameras"]
        sizes = dict.fromkeys("{}x{}".format(*of["size_px"]) for of in cameras.values())
        frames = dict.fromkeys(str(of["frames"]) for of in cameras.values())
        counts = str(log["sweeps"]), str(log["tracks"])
        logs.append([log["log"], log["dataset"], *map(", ".join, (cameras, frames, sizes)), *counts])
    lines = [
        "# Real logs",
        "",
        f"{settings['iterations']} iterations per fit, {virtual_fits_of(settings)}; seed {settings['seed']}. In"
        f" brackets: difference to {BASE}, or the ratio (x) where lower is better. Perceptual: features of the shipped"
        " codec, not LPIPS.",
        "",
        *markdown_table(["log", "dataset", "cameras", "frames", "size", "sweeps", "tracked boxes"], logs),
        "",
    ]
    for name, result in doc["protocols"].items():
        counted = {log: entry["values"] for log, entry in result["logs"].items() if "left_out" not in entry}
        notes = [f"* {note}" for note in notes_of(doc, name)]
        lines += [f"## {name}: {result['row']['title']}", "", *notes, ""]
        if counted:
            lines += [*table_of(doc, name, result["pooled"]), ""]
        for log, values in counted.items():
            places = dict.fromkeys(place for of in values.values() for place in of["places"])
            for place in places if len(places) > 1 else ():
                table = table_of(doc, name, {method: of["places"][place] for method, of in values.items()})
                lines += [f"### {name}, {log}, {place}", "", *table, ""]
    return "\n".join(lines)
