"""The path of the full-size model, from a published checkpoint to a table of the paper, on toys: one command line after
another."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from test_score_metrics import lpips_state
from toy_published import TINY, tiny_checkpoint

from mudg.base import store
from mudg.diffusion import convert, model_files
from mudg.scene.observations import list_observation_sets, read_observations
from mudg.steps.settings import PRESETS

TOY = "from toy_published import TINY; from mudg.diffusion import convert; convert.PublishedConfig = lambda: TINY\n"
"""Before `convert` alone: checkpoints hold the toy network. Everything else is told by the model's folder."""
MAIN = "from mudg.app import main; import sys; sys.exit(main(sys.argv[1:]))"
OWN = {"synthesize.model", "fit.iterations", "fit.virtual.lpips_weights"}
"""What the command line of the table gives itself."""


@pytest.fixture
def mudg(tmp_path):
    """A function that runs one command line below a folder, to a good end."""
    tests = str(Path(__file__).parent)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([tests, *(path for path in sys.path if path)])}

    def run(line, before=""):
        words = [sys.executable, "-c", before + MAIN, *line.split()]
        how = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True, "timeout": 1800}
        done = subprocess.run(words, **how)
        assert done.returncode == 0, done.stderr + done.stdout

    return run


@pytest.mark.slow
def test_from_a_published_checkpoint_to_a_table_of_the_paper(mudg, tmp_path):
    torch.save({"state_dict": tiny_checkpoint()}, tmp_path / "512-mdm-checkpoint.ckpt")
    lpips = {name: value.numpy() for name, value in lpips_state().items()}
    store.write_safetensors(tmp_path / "lpips.safetensors", lpips)
    city = "--city.n-frames 6 --city.width 64 --city.height 48 --city.cameras front --city.lidar-azimuth-step-deg 1"
    mudg(f"ingest city log/scene {city}")
    mudg("fuse log/scene --out log/fuse")

    mudg("convert 512-mdm-checkpoint.ckpt --to models/start --dtype bfloat16", TOY)
    start = model_files.load_published(tmp_path / "models" / "start")
    assert (start.config.width, start.config.height) == (512, 320) and start.config.net == TINY.net

    training = (
        "--data.scenes log --data.window 4 --data.stride 2 --data.held-out-every 0 --data.no-augment --steps 1"
        " --score.every 100 --optimizer.batch-frames 4 --optimizer.full-window-share 1 --optimizer.lr 1e-5"
        " --compute.workers 0 --precision float32"
    )
    mudg(f"learn --start models/start --data.width 32 --data.height 32 {training} --out one")
    frozen = "--data.width 36 --data.height 32 --frozen temporal_transformers"
    mudg(f"learn --start one/model {frozen} {training} --out two")
    one, two = (model_files.load_published(tmp_path / name / "model") for name in ("one", "two"))
    assert ((one.config.width, one.config.height), (two.config.width, two.config.height)) == ((32, 32), (36, 32))
    first, before, after = (model.float().state_dict() for model in (start, one, two))
    moved = lambda old, new: {name for name in old if not torch.equal(old[name], new[name])}
    trained = set(two.trained_part().state_dict())
    assert moved(first, before) == trained  # stage 1 moves all of the network, stage 2 not the temporal transformers
    assert moved(before, after) == trained - two.temporal_parameters("transformers") < trained
    assert not torch.equal(after["net.label.0.weight"], after["net.time.0.weight"])
    assert torch.equal(two.schedule.scale, start.schedule.scale)
    assert (tmp_path / "two" / "model" / "MODEL_CARD.md").read_text().rstrip().endswith(convert.LICENCE)

    sampling = "--model two/model --steps 50 --overlap 2 --shifts-m 2 --no-full-size"
    mudg(f"synthesize log/scene --fused log/fuse {sampling} --out virtual")
    (views,) = list_observation_sets(tmp_path / "virtual").values()
    seen = read_observations(views)
    assert len(seen) == 6
    for frame in (seen[n] for n in range(6)):
        assert (frame.rgb.shape, frame.depth.shape, frame.semantics.shape) == ((3, 32, 36), (1, 32, 36), (32, 36))
        assert bool(torch.isfinite(frame.rgb).all()) and float(frame.rgb.std()) > 0.01
    assert [bool(seen[n].mask.any()) for n in range(6)] == [False] + [True] * 5  # frame 0 shows the recorded pose

    guided = "--observations virtual --method mudg_s --iterations 10 --start.gaussians 500"
    mudg(f"fit log/scene --fused log/fuse {guided} --out fit")
    assert store.read_json(tmp_path / "fit" / "run.json")["summary"]["steps"] == 10

    mudg(
        "bench paper city:development --table mudg3 --preset paper --model two/model --fit.virtual.lpips-weights"
        " lpips.safetensors --iterations 10 --logs 1 --frames 0:5 --resolution 64x48 --no-videos --processes 1"
        " --out table"
    )
    document = store.read_json(tmp_path / "table" / "bench.json")
    for row in ("street_gaussians", "only_I", "only_I_D", "only_I_S", "mudg_s"):
        assert document["cells"][row]["0"]["psnr"]["mean"] > 5.0
    settings = document["settings"]
    assert settings["preset"] == "paper" and settings["guided_share"] == 1.0 and settings["iterations"] == 10
    (log,) = (tmp_path / "table" / entry["log"] for entry in document["logs"])
    folders = {"fuse": "fuse", "fit": "fit/mudg_s", "synthesize": "virtual"}
    ran = {group: yaml.safe_load((log / folder / "run.yaml").read_text()) for group, folder in folders.items()}
    for name, value in PRESETS["paper"].items():
        group, _, rest = name.partition(".")
        if group in ran and name not in OWN:
            for record in (settings[group], ran[group]):
                for part in rest.split("."):
                    record = record[part]
                assert record == value, name
    generated, virtual = settings["synthesize"], settings["fit"]["virtual"]
    assert (generated["steps"], generated["guidance"], virtual["probability"]) == (50, 7.5, 0.2)
    assert dataclasses.replace(two.config, width=1, height=1) == dataclasses.replace(start.config, width=1, height=1)
