"""Scores as a document (metrics.json), as Markdown and as plain text for a terminal. No torch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from mudg.base import html
from mudg.base.errors import plain_lines
from mudg.base.types import Scene
from mudg.gaussians.settings import METHODS

NO_TRUTH: Final = "no truth"
NOT_REQUESTED: Final = "not requested"
NOT_COMPUTED: Final = "not computed"
TOO_FEW: Final = "too few views"
UNEQUAL: Final = "unequal n"
NO_DETECTIONS: Final = "no detections"
WEIGHT_FLAGS: Final = {
    metric: flag
    for flag, metrics in (
        ("--lpips-weights", "lpips"),
        ("--lpips-vgg-weights", "lpips_vgg"),
        ("--fid-weights", "fid kid"),
        ("--fvd-weights", "fvd"),
        ("--detections", "nta_iou"),
        ("--lanes", "ntl_iou"),
    )
    for metric in metrics.split()
}
"""Metric -> the flag of ``mudg score`` that names the weights or files it needs."""
SET_SIZES: Final = {"distribution": ("fid", "kid"), "video": ("fvd",)}
"""Entry of a result with the sizes of its sets -> their metrics."""
SET_METRICS: Final = {metric: f"{entry}s" for entry, metrics in SET_SIZES.items() for metric in metrics}
"""Metric of sets of images or clips -> the entry of metrics.json that says how it was made."""
FLOOR: Final = "Floor: the truth itself"
TITLES: Final[dict[str, str]] = {
    "truth": "Truth",
    "nearest_fill": "Fused points, holes filled",
    **{name: method.title for name, method in METHODS.items()},
    "mudg_f": "Gaussians with diffusion, repaired",
}
TERMINAL_METRICS: Final = ("psnr", "ssim", "perceptual", "abs_rel", "rmse_m", "delta1", "miou")
WITHOUT_TRUTH: Final = ("lidar_abs_rel", "lidar_rmse_m", "lidar_psnr", "agreement", "lane_correlation")
"""Shown in a terminal where no true image exists."""
LIDAR_COLUMNS: Final[Mapping[str, tuple[str, str, int]]] = {
    "median_range_m": ("median range error", "m", 3),
    "chamfer_m": ("chamfer", "m", 3),
    "f1": ("F1 of returns", "", 3),
    "intensity": ("intensity error", "", 3),
}
"""Column -> title, unit, digits."""
LIDAR_TITLES: Final = {"nearest": "nearest sweep, moved"}
LIDAR_RULES: Final = (
    "LiDAR: a beam is right where it returns as in the truth (F1). Errors of range (median) and intensity (mean) are "
    "those of beams that return in both; chamfer is the mean of both directions.",
    "LiDAR on the recorded path: held-out sweeps with their own beams; those without a return are estimated from the "
    "sensor's rows and columns. No row uses the held-out sweeps, but the clouds that the fit started from hold them.",
)
_DIGITS: Final = {
    **dict.fromkeys(("fid", "fvd"), 1),
    **dict.fromkeys(("psnr", "psnr_movers", "flicker", "rmse_m"), 2),
    **dict.fromkeys(("lidar_rmse_m", "lidar_psnr", "lane_psnr", "ntl_iou"), 2),
    **dict.fromkeys(("kid", "warp_error", "temporal_flickering"), 4),
}
"""Digits of metrics that do not have 3."""


def title_of(method: str) -> str:
    """Name of a method for people."""
    return TITLES.get(method, method)


def number_text(metric: str, value: float | str | None) -> str:
    """A metric's value with its usual digits, or the reason why there is none; what needs weights names the flag that
    takes them."""
    if isinstance(value, str):
        return f"{value} ({WEIGHT_FLAGS[metric]})" if value == NOT_COMPUTED and metric in WEIGHT_FLAGS else value
    return "" if value is None else f"{value:.{_DIGITS.get(metric, 3)}f}"


def document(
    scene: Scene,
    exact: bool,
    trajectories: Sequence[Mapping[str, Any]],
    methods: Sequence[str],
    results: Sequence[Mapping[str, Any]],
    rows: Mapping[str, Mapping[str, Any]],
    facts: Mapping[str, Any],
) -> dict[str, Any]:
    """Everything ``metrics.json`` holds. ``exact``: whether truth exists at any view. ``methods``: in the order of the
    tables. ``results``: one entry per method and trajectory. ``rows``: title, unit, better and needs of each metric.
    ``facts``: how the numbers were made: ``depth_limit_m``, ``anchors``, and by metric or entry of ``SET_METRICS`` what
    is known of those that were computed."""
    held_out, limit = len(scene.frames_in("test")), f"{facts['depth_limit_m']:g} m"
    off = "A recorded log has no ground truth off its path: shifted views are shown, not scored."
    no_split = "No frame was held out: on the recorded path the frames that were learned from are scored."
    rules = [
        "All methods are scored at one size, that of the scene's camera unless another was requested; "
        "colour is resized bilinearly, depth and classes take the nearest pixel.",
        "On the recorded path only held-out frames count." if held_out else no_split,
        "Views off the recorded path were never seen by any method." if exact else off,
        f"Depth counts where the truth is known and at most {limit}; where a method gives none, it counts as {limit}.",
        "Class scores are pooled over all views of a trajectory; mIoU is the mean over the classes in its truth.",
        *_further_rules(facts),
        *(LIDAR_RULES if facts.get("sweeps") else ()),
    ]
    return {
        "schema": 1,
        "scene": {
            "id": scene.id,
            "dataset": scene.source.dataset,
            "licence": scene.source.licence,
            "notes": list(scene.source.notes),
            "frames": len(scene.frames),
            "held_out": held_out,
            "cameras": {c.name: [c.width, c.height] for c in scene.cameras.values()},
            "tracks": len(scene.tracks),
        },
        "truth": "exact" if exact else "recorded",
        "rules": rules,
        "methods": [{"name": m, "title": title_of(m)} for m in methods],
        "metrics": [{"name": name, **row} for name, row in rows.items()],
        "trajectories": list(trajectories),
        "results": list(results),
        "by_distance": by_distance(trajectories, methods, results, list(rows)),
        **{name: value for name, value in facts.items() if name != "depth_limit_m" and value},
    }


def _further_rules(facts: Mapping[str, Any]) -> list[str]:
    """One rule for each other metric whose definition has variants."""
    rules = []
    if of := facts.get("distributions"):
        other = f"weights that are not the published file ({of['weights_sha256'][:12]})"
        weights = "the published weights" if of["published_weights"] else other
        rules.append(
            f"FID and KID compare the views of a trajectory with the {of['reference']}, with {weights} and the resize"
            f" rule {of['resize']}. They depend on the number of images: compare methods within a column only, and read"
            " them beside the floor, which the truth itself scores."
        )
    if of := facts.get("videos"):
        rules.append(
            f"FVD compares clips of {of['clip_frames']} views, one at every {of['hop_frames']}th, with those of the"
            f" {of['reference']} (resize rule {of['resize']}, epsilon {of['norm_epsilon']:g}); all views count. With so"
            " few clips it is mostly bias: read it beside the floor."
        )
    if facts.get("lpips"):
        how = "in -1..1" if facts["lpips"]["input"] == "correct" else "unscaled, in 0..1"
        rules.append(f"LPIPS gets its colours {how}.")
    detections = facts.get("detections", {})
    if of := detections.get("nta_iou"):
        of = f"true boxes {of['boxes']}; classes: {of['classes']}; points: {of['points']}"
        rules.append(f"NTA-IoU: {of}. What hides a box is not asked.")
    if "ntl_iou" in detections:
        rules.append(f"NTL-IoU: {detections['ntl_iou']['lines']}. An image without any lane scores 47 to 50.")
    return rules


def by_distance(
    trajectories: Sequence[Mapping[str, Any]],
    methods: Sequence[str],
    results: Sequence[Mapping[str, Any]],
    names: Sequence[str],
) -> list[dict[str, Any]]:
    """Mean over cameras and both sides, per method and distance from the recorded path (metres)."""
    distances = sorted({abs(float(c["shift_m"])) for c in trajectories if c["shift_m"] is not None})
    table = []
    for distance in distances:
        here = [c["name"] for c in trajectories if c["shift_m"] is not None and abs(float(c["shift_m"])) == distance]
        signs = {float(c["shift_m"]) > 0 for c in trajectories if c["name"] in here}
        sides = "recorded" if distance == 0 else "both" if len(signs) == 2 else "left" if signs == {True} else "right"
        uneven = {}
        for kind, own in SET_SIZES.items():
            if len({r[kind]["n"] for r in results if r["trajectory"] in here and kind in r}) > 1:
                uneven |= dict.fromkeys(own, UNEQUAL)
        for method in methods:
            rows = [r for r in results if r["method"] == method and r["trajectory"] in here]
            values = {name: _mean([r["values"].get(name) for r in rows]) for name in names}
            row = {"method": method, "distance_m": distance, "sides": sides}
            here_too = [r["trajectory"] for r in rows]
            table.append({**row, "trajectories": here_too, "values": {**values, **uneven}})
    return table


def _mean(values: Sequence[float | str | None]) -> float | str:
    numbers = [v for v in values if isinstance(v, int | float)]
    if numbers:
        return round(sum(numbers) / len(numbers), 6)
    reasons = [v for v in values if isinstance(v, str)]
    return reasons[0] if reasons else "not produced"


def best_of(better: str, values: Mapping[str, Any], metric: str) -> set[str]:
    """Methods whose shown value is the best one; none when fewer than two have a number."""
    numbers = {m: float(number_text(metric, v)) for m, v in values.items() if isinstance(v, int | float)}
    return set(html.best_of(better, numbers))


def distance_title(document: Mapping[str, Any], distance_m: float) -> str:
    """Heading of a distance."""
    sides = {row["sides"] for row in document["by_distance"] if row["distance_m"] == distance_m}
    if sides == {"recorded"}:
        return f"recorded path, {'held-out' if document['scene']['held_out'] else 'all'} frames"
    return f"{distance_m:g} m to {'either side' if sides == {'both'} else 'the ' + ' and '.join(sorted(sides))}"


def values_by_distance(document: Mapping[str, Any]) -> dict[tuple[str, float], Mapping[str, Any]]:
    """(Method, distance in metres) -> values by metric."""
    return {(row["method"], float(row["distance_m"])): row["values"] for row in document["by_distance"]}


def floors_by_distance(document: Mapping[str, Any]) -> dict[float, dict[str, float | str]]:
    """Distance in metres -> what the truth itself scores in FID, KID and FVD, as the tables by distance average it."""
    found: dict[float, dict[str, float | str]] = {}
    for row in document["by_distance"]:
        for name, entry in SET_METRICS.items():
            floors = document.get(entry, {}).get("floors", [])
            here = [floor for floor in floors if floor["trajectory"] in row["trajectories"]]
            if here:
                value = _mean([f[name] for f in here]) if len({floor["n"] for floor in here}) == 1 else UNEQUAL
                found.setdefault(float(row["distance_m"]), {})[name] = value
    return found


def plain(document: Mapping[str, Any]) -> str:
    """The main numbers for a terminal: one block per distance, best values marked with a star."""
    values_of = values_by_distance(document)
    names = (*TERMINAL_METRICS, *(name for name, entry in SET_METRICS.items() if entry in document))
    floors, lines = floors_by_distance(document), []
    for distance in sorted({d for _, d in values_of}):
        of_methods = {m["name"]: values_of.get((m["name"], distance), {}) for m in document["methods"]}
        for wanted in (names, WITHOUT_TRUTH):
            columns = [m for m in document["metrics"] if m["name"] in wanted]
            if any(isinstance(of.get(m["name"]), float) for of in of_methods.values() for m in columns):
                break
        else:
            lines += [f"{distance_title(document, distance)}: nothing to score against (no truth)", ""]
            continue
        rows = [["", *(f"{m['title']} {m['unit']}".strip() + " " for m in columns)]]
        for method in document["methods"]:
            rows.append([method["title"]])
            for metric in columns:
                across = {name: of.get(metric["name"]) for name, of in of_methods.items()}
                star = "*" if method["name"] in best_of(metric["better"], across, metric["name"]) else " "
                rows[-1].append(number_text(metric["name"], across[method["name"]]) + star)
        if distance in floors:
            rows.append([FLOOR, *(number_text(c["name"], floors[distance].get(c["name"])) + " " for c in columns)])
        lines += [distance_title(document, distance), *_aligned(rows), ""]
    for title, heads, rows in _lidar_tables(document):
        lines += [*_aligned([[title, *heads[1:]], *rows]), ""]
    return plain_lines(lines).rstrip()


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table whose first column stands left, the others right."""
    widths = [max(map(len, column)) + 2 for column in zip(*rows, strict=True)]
    return ["  " + f"{row[0]:<{widths[0]}}" + "".join(f"{c:>{w}}" for c, w in zip(row[1:], widths[1:])) for row in rows]


def markdown(document: Mapping[str, Any]) -> str:
    """All trajectories and metrics as Markdown, with the rules."""
    lines = [f"# Scores of {document['scene']['id']}", "", *(f"* {rule}" for rule in document["rules"])]
    missing = lambda metric: all(r["values"].get(metric["name"]) == NOT_COMPUTED for r in document["results"])
    absent = [metric for metric in document["metrics"] if missing(metric)]
    names = [m["name"] for m in document["metrics"] if m not in absent]
    if absent and document["results"]:
        of_flag: dict[str, list[str]] = {}
        for metric in absent:
            of_flag.setdefault(WEIGHT_FLAGS.get(metric["name"], ""), []).append(metric["title"])
        texts = (f"{', '.join(titles)} ({flag})" if flag else ", ".join(titles) for flag, titles in of_flag.items())
        lines.append(f"* Not computed: {'; '.join(texts)}.")
    for trajectory in document["trajectories"]:
        results = [r for r in document["results"] if r["trajectory"] == trajectory["name"]]
        unknown = [n for n in names if results and all(r["values"].get(n) == NO_TRUTH for r in results)]
        shown = [n for n in names if n not in unknown]
        texts = lambda values: (number_text(name, values.get(name)) for name in shown)  # noqa: B023
        rows = [[title_of(r["method"]), str(r["views"]), *texts(r["values"])] for r in results]
        lines += ["", f"## {trajectory['name']}", ""]
        if any(isinstance(r["values"].get(n), float) for r in results for n in shown):
            lines += html.markdown_table(["method", "views", *shown], rows)
            lines += ["", f"No truth here for {', '.join(unknown)}."] if unknown else []
        else:
            lines.append("Nothing to score against: there is no truth here.")
        lines += [*_lines_of_sets(document, trajectory["name"]), *_lines_of_anchors(document, trajectory["name"])]
    for title, heads, rows in _lidar_tables(document):
        lines += ["", f"## LiDAR: {title}", "", *html.markdown_table(heads, rows)]
    return "\n".join(lines) + "\n"


def _lidar_tables(document: Mapping[str, Any]) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """Title, heads and cells of the tables of simulated sweeps, one per trajectory."""
    heads = ["method", *(f"{title} {unit}".strip() for title, unit, _ in LIDAR_COLUMNS.values())]
    sweeps = document.get("sweeps", ())
    for name in dict.fromkeys(row["trajectory"] for row in sweeps):
        own = [row for row in sweeps if row["trajectory"] == name]
        cells = []
        for row in own:
            numbers = ((row["values"].get(column), digits) for column, (_, _, digits) in LIDAR_COLUMNS.items())
            texts = ["none" if value is None else f"{value:.{digits}f}" for value, digits in numbers]
            cells.append([LIDAR_TITLES.get(row["method"], row["method"]), *texts])
        yield f"{name}, {own[0]['sweeps']} sweeps", heads, cells


def _lines_of_sets(document: Mapping[str, Any], trajectory: str) -> list[str]:
    """Sizes of the sets behind FID and KID of a trajectory, errors of KID, and the floor."""
    rows = [r for r in document["results"] if r["trajectory"] == trajectory and "distribution" in r]
    lines = []
    for row in rows[:1]:
        of = row["distribution"]
        lines += ["", f"* FID and KID: {of['n']} views of every method against {of['n_reference']} recorded frames."]
    errors = {title_of(r["method"]): r["distribution"]["kid_standard_error"] for r in rows}
    known = [f"{title} {error:.4f}" for title, error in errors.items() if error is not None]
    lines += [f"* Standard error of KID: {', '.join(known)}."] if known else []
    for row in [r for r in document["results"] if r["trajectory"] == trajectory and "video" in r][:1]:
        of, first = row["video"], [] if lines else [""]
        lines += [*first, f"* FVD: {of['n']} clips of every method against {of['n_reference']} recorded clips."]
    titles = {m["name"]: m["title"] for m in document["metrics"]}
    for entry in dict.fromkeys(SET_METRICS.values()):
        for floor in document.get(entry, {}).get("floors", []):
            if floor["trajectory"] == trajectory:
                texts = [f"{titles[name]} {number_text(name, floor[name])}" for name in SET_METRICS if name in floor]
                sizes = f"{floor['how']}, {floor['n']} against {floor['n_reference']}"
                lines.append(f"* {FLOOR}: {', '.join(texts)} ({sizes}).")
    return lines


def _lines_of_anchors(document: Mapping[str, Any], trajectory: str) -> list[str]:
    """What true and recorded images and the baseline score on a trajectory."""
    titles = {m["name"]: m["title"] for m in document["metrics"]}
    places = {"truth": "true images", "recorded": "recorded images at their own views"}
    places["nearest_fill"] = title_of("nearest_fill").lower()
    lines = []
    for anchor in document.get("anchors", []):
        texts = {key: number_text(anchor["metric"], anchor[key]) for key in places if key in anchor}
        found = [f"{places[key]} {text}" for key, text in texts.items()]
        if anchor["trajectory"] == trajectory and found:
            lines.append(f"* {titles[anchor['metric']]}: {', '.join(found)}.")
    return ["", *lines] if lines else []
