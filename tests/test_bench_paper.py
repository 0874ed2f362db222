"""``mudg bench paper``: tables as data, equal numbers of views, sets of all logs, logs cut to a table, and the
command."""

import dataclasses
import math

import numpy as np
import pytest
from bench_logs import city_scene, fused
from PIL import Image
from refusals import refused
from tiny_networks import saved_mdm

from mudg.base import config as configuration
from mudg.base import store
from mudg.base.errors import UsageError
from mudg.benchmarks import chain, paper, places
from mudg.benchmarks import run as bench
from mudg.benchmarks.chain import FillViews
from mudg.benchmarks.rows import LONGER, PAPERS, SCENE_LISTS, TABLES, paper_rows, read_papers
from mudg.benchmarks.settings import BenchConfig
from mudg.city import logs as city_logs
from mudg.core import trajectory
from mudg.core.feature_distances import frechet_distance, kernel_distance
from mudg.diffusion.settings import SynthesizeConfig
from mudg.editing.settings import ScoreConfig
from mudg.gaussians.settings import METHODS, FitConfig
from mudg.scene.read import read_scene

PSNR, FID = PAPERS.columns["psnr"], PAPERS.columns["fid"]
TOY_YAML = """
columns:
  fid: {title: FID, better: lower, digits: 2, needs: fid_weights, counts: distribution}
  fvd: {title: FVD, better: lower, digits: 2, needs: fvd_weights, counts: video}
further: {exact: [], measured: []}
places:
  both-2: {name: "2", title: 2 m, shifts_m: [2.0, -2.0]}
  both-3: {name: "3", title: 3 m, shifts_m: [3.0, -3.0]}
scene_lists: {}
tables:
  toy:
    title: Toy & table
    data: twelve_scenes
    places: [both-2, both-3]
    columns: [fid, fvd]
    notes: [Nothing is stated.]
    published:
      - source: a paper
        cells: 2:fid 3:fid
        rows: |
          Paper's method | 50.0 60.5
          Other | - 70.0
"""
TOY = read_papers(TOY_YAML, "toy.yaml").tables["toy"]


# ---- tables as data ------------------------------------------------------------------------------


@pytest.mark.parametrize("table", TABLES.values(), ids=lambda table: table.name)
def test_a_table_is_complete_and_its_rows_change_something(table):
    cells = [(place.name, column.key) for place, column in table.cells()]
    assert {place.name for place in table.places} == {name for name, _ in cells} >= set(table.only)
    assert len(set(cells)) == len(cells) and table.scenes in {"", *SCENE_LISTS}
    assert table.published and {(place, key) for row in table.published for place, key, _ in row.values} <= set(cells)
    assert not (table.virtual_shifts_m and any(any(place.shifts_m) or place.paths for place in table.places))
    names = [row.name for row in paper_rows(BenchConfig(table=table.name), table)]
    assert len(set(names)) == len(names)
    assert {key for keys in PAPERS.further.values() for key in keys} <= set(PAPERS.columns)
    for row in table.rows:
        kind = SynthesizeConfig if METHODS[row.method].made_by == "synthesize" else FitConfig
        usual = kind() if kind is SynthesizeConfig else FitConfig(method=row.method)
        assert (configuration.load(kind, usual, overrides=dict(row.changes)) != usual) == bool(row.changes)


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("better: lower, digits: 2, needs: fid", "better: least, digits: 2, needs: fid", "columns.fid.better"),
        ("digits: 2", "digits: '2'", "digits"),
        ("columns: [fid, fvd]", "columns: [fid, fdv]", "no tables of papers"),
        ("Other | - 70.0", "Other | 70.0", "no tables of papers"),
        ("data: twelve_scenes", "dada: twelve_scenes", "did you mean 'data'"),
    ],
)
def test_what_is_wrong_with_a_file_of_tables_is_said(old, new, what):
    assert old in TOY_YAML
    refused(what, read_papers, TOY_YAML.replace(old, new), "toy.yaml")


def test_one_sided_places_follow_the_side_of_their_scene():
    (path, left, _, lane), two_sided = TABLES["recondreamer"].places, TABLES["mudg1"].places[0]
    assert two_sided.endings(-1) == ("shift+2.0", "shift-2.0")
    assert (left.endings(1), left.endings(-1)) == (("shift+3.0",), ("shift-3.0",))
    assert (path.endings(), lane.endings()) == (("recorded",), ("lane+0.1", "lane-0.1"))


def test_published_rows_are_read_in_order():
    first, other = TOY.published
    assert (first.title, first.source) == ("Paper's method", "a paper")
    assert (first.values, other.values) == ([("2", "fid", 50.0), ("3", "fid", 60.5)], [("3", "fid", 70.0)])
    mudg = {row.title: row.values for row in TABLES["mudg1"].published}
    assert ("3", "fid", 49.42) in mudg["MuDG, diffusion output"] and ("4", "fvd", 1269.99) in mudg["Street Gaussians"]


def test_methods_are_all_of_this_version_unless_some_are_named():
    names = lambda table, **asked: [row.name for row in paper_rows(BenchConfig(**asked), TABLES[table])]
    assert [name for name in names("mudg1") if name != LONGER] == list(METHODS) and LONGER in names("mudg1")
    assert names("mudg1", methods=("nearest_fill", "gs3d")) == ["gs3d"]
    assert names("mudg3") == ["street_gaussians", "only_I", "only_I_D", "only_I_S", "mudg_s"]
    for method, table, what in (("nerf", "mudg1", "unknown method"), ("gs3d", "mudg3", "rows of its own")):
        refused(what, paper_rows, BenchConfig(methods=(method,)), TABLES[table], raises=UsageError)


def test_how_rows_are_scored(tmp_path):
    plain = places.score_settings(BenchConfig(), TABLES["panda"])
    assert (plain.fid_resize, plain.baseline, plain.perceptual_views) == ("neurad", False, 12)
    score = ScoreConfig(fid_resize="clean", lpips_weights="x")
    asked = places.score_settings(BenchConfig(score=score), TABLES["panda"])
    assert asked.fid_resize == "clean" and asked.perceptual_views > 1000
    (tmp_path / "7.json").write_text("[]")
    (tmp_path / "lanes" / "7").mkdir(parents=True)
    given = ScoreConfig(detections=str(tmp_path), lanes=str(tmp_path / "lanes"))  # every log has its own
    of_7 = dataclasses.replace(given, detections=str(tmp_path / "7.json"), lanes=str(tmp_path / "lanes" / "7"))
    assert (places.of_log(given, "7"), places.of_log(given, "8")) == (of_7, given)
    assert places.of_log(ScoreConfig(), "7") == ScoreConfig()


# ---- numbers -------------------------------------------------------------------------------------


def metrics(values):
    """Contents of a ``metrics.json``: trajectory -> values."""
    row = {"method": "m", "views": 8, "distribution": {"n": 6, "n_reference": 24}}
    results = [{"trajectory": name, "values": of, **row} for name, of in values.items()]
    return {"metrics": [{"name": name} for name in ("psnr", "fid", "fvd", "kid")], "results": results}


NAMES = ("front_shift+2.0", "front_shift-2.0")


def test_a_place_is_the_mean_over_its_trajectories_and_the_sum_of_their_views():
    document = metrics({NAMES[0]: {"psnr": 20.0, "fid": 30.0}, NAMES[1]: {"psnr": 24.0, "fid": 40.0}})
    found = paper.at_place([document], NAMES, (PSNR, FID))
    assert found == {"psnr": {"value": 22.0, "n": 16}, "fid": {"value": 35.0, "n": 12, "n_reference": 48}}
    floors = [{"trajectory": NAMES[0], "fid": 5.0, "n": 4, "n_reference": 4}]
    found = paper.floors_at([{"distributions": {"floors": floors}}], NAMES[:1], (PSNR, FID))
    assert found == {"fid": {"value": 5.0, "n": 4, "n_reference": 4}, "psnr": {"value": "perfect by definition"}}


def test_every_cell_without_a_number_has_its_reason():
    fids = dict(zip(NAMES, ("not computed", 3.0)))
    document = metrics({name: {"psnr": "no truth", "fid": fid} for name, fid in fids.items()})
    found = paper.at_place([document], NAMES, (PSNR, FID, PAPERS.columns["nta_iou"]))
    assert {key: of["value"] for key, of in found.items()} == {
        "psnr": "no truth off the path on a recorded log",
        "fid": "no weights: --score.fid-weights",
        "nta_iou": "no score of this version",
    }
    assert paper.at_place([metrics({})], NAMES, (PSNR,))["psnr"]["value"] == "not produced"


ROWS = [
    {"name": "gs3d", "title": "3D Gaussians (gs3d)", "method": "gs3d", "changes": {}},
    {"name": "mudg_s", "title": "With diffusion (mudg_s)", "method": "mudg_s", "changes": {}},
]
SETTINGS = {"list": "city:reported", "missing_scenes": [], "iterations": 10, "seed": 0}
SETTINGS |= {"guided_share": 1.5}
FIDS = {"truth": [5.0, 7.0], "nearest_fill": [90.0, 110.0], "gs3d": [40.0, 60.0], "mudg_s": [40.0, 50.0]}


def toy_logs(fids, exact=False):
    """Logs with FID by row at 2 m (and one more at 3 m), and no FVD."""
    logs, without = [], {"value": "no weights: --score.fvd-weights"}
    facts = {"dataset": "city", "cameras": ["front"], "frames": 24, "size": "384x256", "held_out": 6, "tracks": 2}
    facts |= {"note": "", "made": {}, "features": {}}
    for number in range(len(fids["gs3d"])):
        fid = lambda row, more, n=number: {"value": fids[row][n] + more, "n": 12, "n_reference": 48}
        values = {row: {p: {"fid": fid(row, m), "fvd": without} for p, m in (("2", 0), ("3", 1))} for row in fids}
        seconds = {"fuse": 1.0, "fit/gs3d": 2.0}
        logs.append({"log": str(number), **facts, "exact": exact, "values": values, "seconds": seconds})
    return logs


def test_means_and_standard_errors_by_hand():
    document = paper.document(TOY, toy_logs({name: [*of, of[0]] for name, of in FIDS.items()}), ROWS, SETTINGS)
    cell = document["cells"]["gs3d"]["3"]["fid"]
    assert cell["mean"] == pytest.approx(np.mean([41, 61, 41]))
    assert cell["standard_error"] == pytest.approx(np.std([41, 61, 41], ddof=1) / math.sqrt(3))
    assert (cell["logs"], cell["n"], cell["n_reference"]) == (3, [12, 12, 12], [48, 48, 48])
    assert (document["best"]["2"]["fid"], document["best"]["2"]["fvd"]) == (["mudg_s"], [])
    alone = paper.document(TOY, toy_logs({name: of[:1] for name, of in FIDS.items()}), ROWS, SETTINGS)
    assert alone["cells"]["gs3d"]["2"]["fid"]["standard_error"] is None
    assert alone["best"]["2"]["fid"] == ["gs3d", "mudg_s"]


def test_different_numbers_of_views_are_refused_and_such_a_floor_is_not_in_the_table():
    logs = toy_logs(FIDS)
    logs[0]["values"]["truth"]["2"]["fid"]["n"] = 6
    document = paper.document(TOY, logs, ROWS, SETTINGS)
    cell = document["cells"]["truth"]["2"]["fid"]
    assert cell["reason"] == "other n" and cell["floor"]["mean"] == 6.0
    assert "mean" in document["cells"]["truth"]["3"]["fid"]
    logs[1]["values"]["gs3d"]["2"]["fid"] = {"value": "too few views"}  # a mean is over all logs, or there is none
    cell = paper.document(TOY, logs, ROWS, SETTINGS)["cells"]["gs3d"]["2"]["fid"]
    assert cell == {"reason": "too few views (1 of 2 logs)"}
    logs[1]["values"]["mudg_s"]["3"]["fid"]["n"] = 11
    refused("different numbers of views", paper.document, TOY, logs, ROWS, SETTINGS)


# ---- sets of all logs ----------------------------------------------------------------------------


def log_of(out, number, entries=paper.POOLED):
    """Scores of one method on one log, with files of features; and these by name."""
    rng = np.random.default_rng(number)
    kept = {name: rng.normal(number, 1, (12, 6)).astype(np.float32) for name in (*NAMES, "reference")}
    folder = out / f"log{number}" / "score" / "a"
    for name, rows in kept.items():
        store.write_safetensors(folder / "features" / f"{name}.safetensors", {"features": rows})
    of = {"method": "a", "reference": "reference.safetensors"}
    sets = [{"trajectory": name, "made": f"{name}.safetensors", **of} for name in NAMES]
    return {folder: {entry: {"sets": sets} for entry in entries}}, kept


def test_views_of_all_logs_are_one_set(tmp_path):
    logs, parts = [], []
    for number in range(2):
        documents, kept = log_of(tmp_path, number)
        files = paper.files_at(documents, NAMES, tmp_path)
        assert files["distributions"]["reference"] == [f"log{number}/score/a/features/reference.safetensors"]
        half = {"distributions": {"made": [], "reference": files["distributions"]["reference"]}}
        logs.append({"features": {"a": {"2": files}, "truth": {"2": half}}})
        parts.append(kept)
    found, made_of = paper.pooled(logs, tmp_path), lambda kept: [kept[name] for name in NAMES]
    made = np.concatenate([rows for kept in parts for rows in made_of(kept)])
    reference = np.concatenate([kept["reference"] for kept in parts])
    means = {name: cell["mean"] for name, cell in found["a"]["2"].items()}
    fid, kid = frechet_distance(made, reference), kernel_distance(made, reference)
    assert means == pytest.approx({"fid": fid, "kid": kid, "fvd": fid}, abs=1e-5)
    singles = [frechet_distance(np.concatenate(made_of(kept)), kept["reference"]) for kept in parts]
    assert abs(means["fid"] - np.mean(singles)) > 0.01  # not the mean over logs
    one, other = (np.concatenate([kept["reference"][start::2] for kept in parts]) for start in (0, 1))
    assert found["truth"]["2"]["fid"]["mean"] == pytest.approx(frechet_distance(one, other), abs=1e-5)
    part, _ = log_of(tmp_path, 2, ("distributions",))  # a log without features of videos takes fvd from the table
    logs.append({"features": {"a": {"2": paper.files_at(part, NAMES, tmp_path)}}})
    assert set(paper.pooled(logs, tmp_path)["a"]["2"]) == {"fid", "kid"}
    assert paper.files_at(part, (*NAMES, "front_shift+3.0"), tmp_path) == {}


def test_the_table_prints_the_pooled_number_and_ranks_by_it():
    together = {"gs3d": {"2": {"fid": {"mean": 30.0, "standard_error": None}}}}
    document = paper.document(TOY, toy_logs(FIDS), ROWS, SETTINGS, together)
    found = document["cells"]["gs3d"]["2"]["fid"]
    assert (found["mean"], found["mean_over_logs"], found["standard_error"]) == (30.0, 50.0, None)
    assert (found["n"], found["logs"]) == ([12, 12], 2)
    assert document["best"]["2"]["fid"] == ["gs3d"] and "mean_over_logs" not in document["cells"]["mudg_s"]["2"]["fid"]


# ---- texts ---------------------------------------------------------------------------------------

GOLDEN = """\
|  | FID ↓, 2 m | FVD ↓, 2 m | FID ↓, 3 m | FVD ↓, 3 m |
|---|---|---|---|---|
| Paper's method (published: a paper) | 50.00 |  | 60.50 |  |
| Other (published: a paper) |  |  | 70.00 |  |
| the truth itself | 6.00 (1.00) | - | 7.00 (1.00) | - |
| fused points, holes filled | 100.00 (10.00) | - | 101.00 (10.00) | - |
| 3D Gaussians (gs3d) | 50.00 (10.00) | - | 51.00 (10.00) | - |
| With diffusion (mudg_s) | **45.00 (5.00)** | - | **46.00 (5.00)** | - |
| n | 24 against 96 | - | 24 against 96 | - |
"""


def test_the_forms_of_a_table():
    logs = toy_logs(FIDS, exact=True)
    for entry in logs:
        for row, of in entry["values"].items():
            of["2"]["psnr"] = {"value": 20.0 if row == "gs3d" else 18.0, "n": 12}
    toy = paper.document(TOY, logs, ROWS, SETTINGS)
    assert toy["cells"]["gs3d"]["3"]["psnr"] == {"reason": "no score of this version"}
    text = paper.markdown(toy)
    assert GOLDEN in text and text.startswith("# Toy & table, on 2 logs of generated cities (city:reported)\n")
    assert "generated cities, not the paper's data" in text and "## Exact truth: 2 m" in text
    assert "on 2 logs recorded" in paper.markdown({**toy, "settings": {**SETTINGS, "list": ""}})


# ---- logs ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A scene of 8 frames and two cameras, whose folder bears the name of a segment."""
    out = tmp_path_factory.mktemp("logs") / "segment-12820461091157089924_with_camera_labels"
    return city_scene(out, n_frames=8, cameras=("front", "front_left"))


def test_lists_of_cities_and_folders(recorded):
    config = BenchConfig(logs=2, resolution="96x64", frames="0:6")
    logs = places.logs_of(config, ("city:reported",), TABLES["recondreamer"])
    assert [log.source.seed for log in logs] == list(city_logs.REPORTED[:2])
    assert (logs[0].source.n_frames, logs[0].source.width, logs[0].source.cameras) == (6, 96, ("front",))
    (log,) = places.logs_of(BenchConfig(), (recorded,), TABLES["drivedreamer4d"])
    assert (log.frames, log.note, log.side) == ((0, 39), "", 1)
    assert len(places.missing_scenes(TABLES["drivedreamer4d"], [log])) == 7
    (log,) = places.logs_of(BenchConfig(), (recorded,), TABLES["recondreamer"])
    assert log.note == "not in the table's list B"
    for changes, sources, what in (
        ({}, (), "no logs"),
        ({}, ("city:nowhere",), "no such list"),
        ({}, ("city:reported", recorded), "stands alone"),
        ({"frames": "2:6"}, ("city:reported",), "from 0 on"),
        ({"logs": 2}, (recorded,), "counted by naming them"),
    ):
        refused(what, places.logs_of, BenchConfig(**changes), sources, TABLES["mudg1"], raises=UsageError)


def test_a_recorded_log_is_cut_to_the_table(recorded, tmp_path):
    table = TABLES["streetcrafter"].model_copy(update={"front_only": True})
    (log,) = places.logs_of(BenchConfig(frames="2:7"), (recorded,), table)
    scene = read_scene(places.make_scene(log, table, tmp_path, "cpu", False))
    frames = read_scene(recorded).frames_of("front")[2:7]
    assert [frame.id for frame in scene.frames] == [frame.id for frame in frames]
    assert [frame.id for frame in scene.frames_in("test")] == [frames[2].id, frames[4].id]
    assert len(scene.sweeps) == 5 and scene.source.recipe is None
    more = dataclasses.replace(log, frames=(0, 39))
    refused("fewer frames", places.make_scene, more, table, tmp_path / "more", "cpu", False)


def test_pictures_without_truth(recorded, tmp_path):
    """Rows of colour and depth alone, all columns; nothing for a column without the trajectory."""
    scene = read_scene(recorded)
    paths = [trajectory.shifted(scene, "front", 2.0), trajectory.named(scene, "front", "lane+0.1")]
    given = {"scene": recorded, "fused": fused(recorded, tmp_path / "fused")}
    fill = lambda n: FillViews(**given, paths=tuple(paths[:n]), out=tmp_path / f"fill{n}").run()
    out = chain.Film(views={"one": (fill(1),), "both": (fill(2),)}, paths=tuple(paths), out=tmp_path / "film").run()
    assert sorted(path.name for path in out.glob("*.jpg")) == ["front_lane+0.1.jpg", "front_shift+2.0.jpg"]
    with Image.open(out / "front_lane+0.1.jpg") as picture:
        seen = np.asarray(picture.convert("L"))
    assert seen.shape == (48, 64) and seen[:, :30].max() < 40 < seen[:, 35:].max()


# ---- the command ---------------------------------------------------------------------------------


def test_the_command_writes_every_form_of_the_table(tmp_path, monkeypatch):
    def stand_in(job):
        cell = lambda: {"fid": {"value": 3.0, "n": 4, "n_reference": 4}, "fvd": {"value": "x"}}
        names = ("truth", *(row.name for row in job.rows))
        values = {name: {place: cell() for place in "234"} for name in names}
        return {**toy_logs(FIDS)[0], "log": job.log.name, "values": values}

    monkeypatch.setattr(paper.PaperLog, "measure", stand_in)
    config = BenchConfig(logs=1, methods=("gs3d",), processes=1, videos=False)
    out = bench.run("paper", config, tmp_path / "out", sources=("city:development",))
    assert {path.name for path in out.iterdir()} == set(chain.PAGES)
    document = store.read_json(out / "bench.json")
    assert [row["name"] for row in document["rows"]] == ["truth", "nearest_fill", "gs3d"]
    assert document["settings"]["score"]["fid_resize"] == "pytorch-fid"
    absent = dataclasses.replace(config, score=ScoreConfig(fid_weights=str(tmp_path / "absent.pth")))
    given = {"sources": ("city:development",)}
    refused("no such file", bench.run, "paper", absent, tmp_path / "other", **given)
    assert not (tmp_path / "other").exists()
    other = dataclasses.replace(config, table="spvc")
    refused("do not belong", bench.run, "paper", other, out, **given, raises=UsageError)


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    model = saved_mdm(tmp_path_factory.mktemp("model") / "model")
    size = {"logs": 2, "processes": 1, "videos": False, "resolution": "96x64", "frames": "0:5"}
    methods = ("street_gaussians", "mudg_r", "mudg_s")
    config = BenchConfig(**size, iterations=20, model=str(model), methods=methods)
    return bench.run("paper", config, tmp_path_factory.mktemp("paper") / "out", sources=("city:development",)), config


@pytest.mark.slow
def test_a_table_on_cities_end_to_end(filled):
    out, config = filled
    document = store.read_json(out / "bench.json")
    seed, _ = (entry["log"] for entry in document["logs"])
    for row in ("nearest_fill", "street_gaussians", "mudg_r", "mudg_s"):
        cell = document["cells"][row]["3"]["psnr"]
        assert cell["n"] == [10, 10] and cell["standard_error"] > 0
        assert document["cells"][row]["3"]["fid"] == {"reason": "no weights: --score.fid-weights"}
    assert document["cells"]["truth"]["3"]["flicker"]["mean"] == pytest.approx(1.0)
    assert not (out / seed / "film").exists()
    stamps = lambda: [
        (out / seed / n / "run.json").stat().st_mtime_ns for n in ("fit/mudg_s", "virtual", "score/mudg_s")
    ]
    before = stamps()
    more = dataclasses.replace(config, methods=("gs3d", LONGER, "mudg_s"))
    bench.run("paper", more, out, sources=("city:development",))
    rows = [row["name"] for row in store.read_json(out / "bench.json")["rows"]]
    assert stamps() == before and rows == ["truth", "nearest_fill", "gs3d", LONGER, "mudg_s"]


@pytest.mark.slow
def test_a_table_on_a_recorded_log(recorded, filled, tmp_path):
    _, config = filled
    config = dataclasses.replace(config, logs=8, resolution="", methods=("street_gaussians",), frames="")
    document = store.read_json(bench.run("paper", config, tmp_path / "out", sources=(recorded,)) / "bench.json")
    assert "kid" in {column["key"] for column in document["further"]} and not document["exact"]
    assert document["cells"]["street_gaussians"]["2"]["fid"] == {"reason": "no weights: --score.fid-weights"}
