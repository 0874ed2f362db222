"""Training clips of recorded logs: what is truth, what is given, what is held out."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refused
from toy_clips import tiny
from toy_scene import ToyStreet

from mudg.base.errors import InputError, UsageError
from mudg.base.types import Source, View
from mudg.core import losses
from mudg.diffusion import clips, learn, log_clips, model_files, models
from mudg.diffusion.city_clips import HELD_OUT
from mudg.diffusion.log_clips import LogClipRules, LogSource
from mudg.diffusion.model import MDM
from mudg.diffusion.network import PixelTruth
from mudg.diffusion.settings import LearnConfig
from mudg.scene.labels import photographs, read_label
from mudg.scene.read import read_image, read_scene
from mudg.scene.settings import FuseConfig
from mudg.scene.write import SceneWriter
from mudg.steps.ingest import Fuse
from mudg.steps.synthesize import Learn

RULES = LogClipRules(width=48, height=24, window=3, stride=2, held_out_every=4, farthest=2)
FRAMES = 16


def rewritten(scene, folder, *, black="", labels=("semantics", "depth", "sky")):
    """The scene again, one image black, some labels left out."""
    with SceneWriter(folder, "again", Source("toy", "none")) as writer:
        writer.copy_all_but_frames(scene)
        for frame in scene.frames:
            image = read_image(scene, frame)
            kept = {name: read_label(scene, frame, name) for name in frame.labels if name in labels}
            writer.add_frame(frame.id, frame.view, image * 0 if frame.id == black else image, kept)
        writer.finish()


@pytest.fixture(scope="module")
def measured(log, tmp_path_factory):
    """The log without labels of depth: only its sweeps tell."""
    root = tmp_path_factory.mktemp("measured")
    rewritten(read_scene(log[1].scene), root / "scene", labels=("semantics",))
    return log[0], LogSource(root / "scene", log[1].fused)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    root = tmp_path_factory.mktemp("log")
    street = ToyStreet(car_start=(12.0, 3.0), car_velocity=(2.0, 0.0), times=[0.1 * n for n in range(FRAMES)])
    street.write(root / "scene", width=120, height=60)
    Fuse(scene=root / "scene", out=root / "fuse", settings=FuseConfig(min_object_points=1)).run()
    return street, LogSource(root / "scene", root / "fuse")


def test_windows_to_score_share_no_moment_with_those_to_train_on(log):
    scene = read_scene(log[1].scene)
    found = RULES.windows(scene)
    held = {name for w in found if w.held_out for name in w.frames}
    trained = {name for w in found if not w.held_out for name in w.frames}
    assert held and trained and not held & trained
    assert "front/000004" not in held | trained  # the scene holds it out
    assert all(len(w.frames) == 3 for w in found)
    everything = LogClipRules(48, 24, window=3, stride=2, held_out_every=0).windows(scene)
    assert [w.frames[0] for w in everything] == [f"front/{n:06d}" for n in (0, 2, 5, 7, 9, 11, 13)]
    refused("too short", LogClipRules(48, 24, window=30).windows, scene)
    with pytest.raises(InputError, match="too short to hold out"):
        log_clips.plan_shards([log[1]], LogClipRules(48, 24, window=12, stride=1, held_out_every=2), HELD_OUT)


def test_images_that_an_edit_rendered_in_part_are_no_photographs(log):
    scene = read_scene(log[1].scene)
    one = next(f for f in scene.frames if f.id == "front/000006")
    edited = replace(one, labels={**one.labels, "rendered": next(iter(one.labels.values()))})
    changed = replace(scene, frames=tuple(edited if f is one else f for f in scene.frames))
    assert {f.id for f in scene.frames_in("train")} - {f.id for f in photographs(changed)} == {"front/000006"}
    assert all("front/000006" not in w.frames for w in RULES.windows(changed))
    assert any("front/000006" in w.frames for w in RULES.windows(scene))


def test_truth_is_what_was_recorded(measured):
    street, source = measured
    opened = log_clips.OpenLog(source, replace(RULES, width=120, height=60))
    window = next(w for w in RULES.windows(opened.scene) if not w.held_out)
    clip = log_clips.make_clip(opened, window, 0)
    for number, view in enumerate(clip.condition.views):
        _, ids, depth = street.image(view)  # exact, at the clip's size
        known = clip.depth_valid[number, 0].numpy()
        solid = known & np.isfinite(depth)
        relative = np.abs(clip.depth[number, 0].numpy() - depth)[solid] / depth[solid]
        assert np.median(relative) < 0.02  # a point anywhere in a pixel of the slanted ground
        assert (relative < 0.1).mean() > 0.95
        assert 0.1 < solid.mean() < 1.0
        assert (clip.depth[number, 0].numpy()[known & ~np.isfinite(depth)] >= 100).mean() > 0.9
        assert (clip.semantics[number].numpy() == ids).mean() > 0.97
    arrays = clips.pack_clips([clip], gaps=True)
    unknown = (arrays["flags"] & clips.FLAG_DEPTH_UNKNOWN) > 0
    assert np.array_equal(unknown[0], ~clip.depth_valid[:, 0].numpy())
    assert float(arrays["depth"][0][unknown[0]].max()) <= 100  # filled, not far away


def test_a_view_never_sees_its_own_image(log, tmp_path):
    """Paint over one image: the condition of its own view stays as it was, its truth does not."""
    _, source = log
    scene = read_scene(source.scene)
    rules = replace(RULES, farthest=1)  # neighbours' images are given
    opened = log_clips.OpenLog(source, rules)
    window = next(w for w in rules.windows(scene) if not w.held_out)
    painted = window.frames[1]
    rewritten(scene, tmp_path / "scene", black=painted)
    other = log_clips.OpenLog(LogSource(tmp_path / "scene", source.fused), rules)
    clip, again = (log_clips.make_clip(x, window, 0) for x in (opened, other))
    assert torch.equal(clip.condition.color[1], again.condition.color[1])
    assert torch.equal(clip.condition.backdrop[1], again.condition.backdrop[1])
    assert not torch.equal(clip.condition.color, again.condition.color)  # its neighbours do see it
    assert float(again.rgb[1].max()) == 0.0 and torch.equal(clip.rgb[0], again.rgb[0])
    assert bool(clip.condition.warped[1].any())


def depth_term(truth):
    code = truth.depth_code
    return float(losses.depth_code_error(torch.zeros_like(code), code, truth.depth_known, 1.0))


def test_unknown_depth_has_no_part_in_the_loss(measured, tmp_path):
    opened = log_clips.OpenLog(measured[1], replace(RULES, width=64, height=32))
    window = RULES.windows(opened.scene)[0]
    clips.write_shard(tmp_path, 0, [log_clips.make_clip(opened, window, 0)], gaps=True)
    model = MDM(models.model_config(tiny(tmp_path, width=64, height=32, window=3)))
    clip = clips.ShardFolder(tmp_path).clip(0, 0, range(3))
    assert not bool(clip.depth_valid.all())

    def term(depth, known):
        filled = replace(clip, depth=torch.where(known, clip.depth, depth))
        return depth_term(PixelTruth.of([filled], model.codec))

    assert term(torch.tensor(3.0), clip.depth_valid) == term(torch.tensor(90.0), clip.depth_valid)
    assert term(torch.tensor(3.0), ~clip.depth_valid) != term(torch.tensor(90.0), ~clip.depth_valid)
    mirrored = clips.vary(clip, np.random.Generator(np.random.PCG64(1)))
    flipped = not torch.equal(mirrored.depth, clip.depth)
    wanted = clip.depth_valid.flip(-1) if flipped else clip.depth_valid
    assert torch.equal(mirrored.depth_valid, wanted)


def test_a_model_goes_on_learning_on_a_log(log, tmp_path):
    first, run = tmp_path / "first", tmp_path / "run"
    plain = replace(models.model_config(tiny("")), renders=False, finish_widths=(), finish_blocks=())
    model_files.save(MDM(plain), first, "card", {})
    run.mkdir()
    for name, folder in (("scene", log[1].scene), ("fuse", log[1].fused)):
        (run / name).symlink_to(folder)
    cut = {"stride": 2, "held_out_every": 4, "window": 4, "width": 64, "height": 32}
    config = tiny("", start=str(first), scenes=(str(run),), steps=1, score_every=1, log_every=1, **cut)
    made = Learn(out=tmp_path / "tuned", settings=config).run()
    index = json.loads((tmp_path / "tuned" / "clips" / "log_clips.json").read_text())
    assert index["rules"]["width"] == 64 and index["rules"]["height"] == 32  # the camera's aspect of 2
    card = (made / "MODEL_CARD.md").read_text()
    assert "recorded log" in card and "generated cities only" not in card
    scores = json.loads((made.parent / "metrics.json").read_text())
    assert scores["clips"] >= 1 and scores["average"]["psnr"] > 5
    assert (made.parent / "samples" / "0000001.png").is_file()
    facts = json.loads((made / "model.json").read_text())["facts"]
    assert facts["recipe"]["data"]["scenes"] == [str(run)]
    refused("other logs or settings", log_clips.claim_folder, made.parent / "clips", RULES, [log[1]], raises=UsageError)
    with pytest.raises(InputError, match="no scene with a fused cloud"):
        Learn(out=tmp_path / "none", settings=tiny("", start=str(first), scenes=(str(tmp_path),))).run()


@pytest.fixture(scope="module")
def annotated(tmp_path_factory):
    """A street whose frames have made labels: dense depth with a confidence that falls from left to right, twice as far
    as it is, so that it cannot be mistaken for the sweep; the vehicle's bonnet below."""
    root = tmp_path_factory.mktemp("annotated")
    street = ToyStreet(times=[0.1 * n for n in range(8)])
    bare = street.write(root / "bare", width=120, height=60, labels=False)
    with SceneWriter(root / "scene", "toy-street", Source("toy", "none")) as writer:
        writer.copy_all_but_frames(bare)
        for frame in bare.frames:
            _, ids, depth = street.image(frame.view)
            sky, ego = ~np.isfinite(depth), np.zeros(depth.shape, bool)
            ego[-6:] = True
            sure = np.broadcast_to(np.linspace(1, 0, depth.shape[1]), depth.shape)
            labels = {
                "semantics": ids,
                "semantics_confidence": np.where(sky, 0.2, 1.0),
                "depth": np.where(sky, 100.0, 2 * depth),
                "depth_confidence": sure,
                "sky": sky,
                "ego": ego,
            }
            writer.copy_frame(bare, frame, labels)
        writer.finish()
    Fuse(scene=root / "scene", out=root / "fuse", settings=FuseConfig(min_object_points=1)).run()
    return street, LogSource(root / "scene", root / "fuse")


@pytest.mark.parametrize("published", [False, True])
def test_annotated_depth_is_learned_with_its_confidence(annotated, tmp_path, published):
    """Exact depth where the sweep measured, labelled depth elsewhere; none of the bonnet's."""
    street, source = annotated
    rules = LogClipRules(120, 60, window=3, held_out_every=0, published=published)
    opened, alone = log_clips.OpenLog(source, rules), log_clips.OpenLog(source, rules)
    bare = lambda frame: replace(frame, labels={name: ref for name, ref in frame.labels.items() if name != "depth"})
    alone._frames = [bare(frame) for frame in alone._frames]
    window = rules.windows(opened.scene)[0]
    clips.write_shard(tmp_path, 0, [log_clips.make_clip(opened, window, 0)], gaps=True)
    clip, sweep = clips.ShardFolder(tmp_path).clip(0, 0, range(3)), log_clips.make_clip(alone, window, 0)
    assert sweep.depth_confidence is None and 0.05 < float(sweep.depth_valid.float().mean()) < 0.8
    measured = sweep.depth_valid
    assert torch.allclose(clip.depth[measured], sweep.depth[measured], rtol=1e-3)
    assert bool((clip.depth_weight[measured] == 1).all())
    for number, view in enumerate(clip.condition.views):
        time_s = opened.frame(window.frames[number]).view.time_s
        _, _, exact = street.image(View(view.camera, view.world_from_cam, time_s))
        guessed = torch.from_numpy(np.isfinite(exact)) & ~measured[number, 0]
        guessed[-6:], guessed[:, -1] = False, False  # where nothing is known
        assert torch.allclose(clip.depth[number, 0][guessed], 2 * torch.from_numpy(exact).float()[guessed], rtol=1e-3)
        column = torch.linspace(1, 0, 120).expand(60, 120)
        assert torch.allclose(clip.depth_weight[number, 0][guessed], column[guessed], atol=0.003)
        bonnet = ~measured[number, 0] & (torch.arange(60)[:, None] >= 54)
        assert bool(bonnet.any()) and not bool(clip.depth_weight[number, 0][bonnet].any())
        sky = torch.from_numpy(~np.isfinite(exact)) & ~measured[number, 0]
        assert bool((clip.depth[number, 0][sky & (column > 0.1)] == clips.FAR_M).all())
    varied = (clips.vary(clip, np.random.default_rng(n)) for n in range(20))
    turned = next(one for one in varied if not torch.equal(one.depth, clip.depth))
    assert torch.equal(turned.depth_weight, clip.depth_weight.flip(-1))


def test_points_are_left_out_but_of_published_type_clips():
    least = [learn.rules_of_size(LearnConfig(), (64, 32), alone).least_points for alone in (False, True)]
    assert least == [0.3, 1.0]
