"""Lists of scenes: what is drawn, what is kept, what is left out."""

import collections
import os
import shutil
import threading

import numpy as np
import pytest
import torch
from refusals import refused
from toy_clips import interrupted_at, losses_of, tiny, write_clips

from mudg import app
from mudg.base import seeds, store
from mudg.base.errors import IntegrityError, UsageError
from mudg.base.location import Location
from mudg.diffusion import learn, log_clips, shard_sources
from mudg.diffusion.shard_sources import (
    FolderOfShards,
    ListedScene,
    ListedShards,
    SceneList,
    ShardCache,
    is_list,
    read_list,
)
from mudg.steps.synthesize import Learn


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("clips") / "clips")


@pytest.fixture(scope="module")
def address(clips, tmp_path_factory):
    """The clips in the object store that lives in memory."""
    place = Location.of(f"memory://{tmp_path_factory.mktemp('bucket').name}/clips")
    place.push(clips)
    return place


def rng(step):
    return seeds.numpy_rng(0, step, "test")


def test_scenes_are_drawn_by_the_weights_of_their_data_sets():
    scenes = [ListedScene(path=f"a{n}", data_set="a") for n in range(30)]
    scenes += [ListedScene(path="b0", data_set="b"), ListedScene(path="b1", data_set="b", weight=3.0)]
    scenes += [ListedScene(path="c", data_set="c", weight=0.0), ListedScene(path="h", data_set="b", held_out=True)]
    listed = SceneList(scenes, {"a": 1.0, "b": 3.0}, 5, "list")
    assert listed.shares == {"a": 0.25, "b": 0.75} and listed.scored == [33]
    count = 6000
    drawn = collections.Counter(listed.draw(rng(n)) for n in range(count))
    assert set(drawn) == set(range(32))  # neither the one without weight nor the held-out one
    wanted = np.array([0.25 / 30] * 30 + [0.75 / 4, 0.75 * 3 / 4]) * count
    got = np.array([drawn[n] for n in range(32)])
    assert ((got - wanted) ** 2 / wanted).sum() < 61.1  # chi-square, 31 degrees of freedom: 0.999
    assert [listed.draw(rng(7)) for _ in range(3)] == [listed.draw(rng(7))] * 3


def test_lists_are_read_in_two_formats(tmp_path):
    (tmp_path / "l.yaml").write_text(
        "data_sets: {k: 2.0}\nscenes:\n- a\n- {path: b, data_set: k, weight: 2, held_out: true}\n- {path: c, data_set:"
        " k}\n"
    )
    (tmp_path / "l.json").write_text('["a", {"path": "b", "data_set": "k"}]')
    a, b = (read_list(str(tmp_path / f"l.{end}")) for end in ("yaml", "json"))
    assert a.shares == {"scenes": 1 / 3, "k": 2 / 3} and a.scored == [1]
    assert [s.path for s in b.scenes] == ["a", "b"]
    assert is_list([str(tmp_path / "l.json")]) and not is_list(["runs/a"]) and not is_list([])
    for content, words in (
        ("[]", "scenes"),
        ('[{"path": "a", "wieght": 1}]', "did you mean 'weight'"),
        ('{"data_sets": {"x": 1}, "scenes": ["a"]}', "without scenes"),
        ('[{"path": "a", "weight": 0}]', "no scene"),
    ):
        (tmp_path / "bad.json").write_text(content)
        refused(words, read_list, str(tmp_path / "bad.json"))


def listed(tmp_path, paths):
    """A list of these folders or addresses, the first one held out, in two data sets by turns."""
    entries = [{"path": str(path), "data_set": "ab"[n % 2], "held_out": n == 0} for n, path in enumerate(paths)]
    store.write_json(tmp_path / "list.json", {"scenes": entries, "data_sets": {"a": 1.0, "b": 2.0}})
    return str(tmp_path / "list.json")


def listed_folder(clips, tmp_path, count=6, bad=()):
    """A list of folders with one shard each; `bad`: missing ones."""
    folders = [tmp_path / "scenes" / f"{n}" for n in range(count)]
    for n in set(range(count)) - set(bad):
        folders[n].mkdir(parents=True)
        shutil.copy(clips / f"city_{n % 3:07d}.safetensors", folders[n] / "city_0000000.safetensors")
    return listed(tmp_path, folders)


def from_list(text, **changes):
    return tiny("", scenes=(text,), **{"log_every": 1, "checkpoint_every": 1, "steps": 2, **changes})


def test_bad_scenes_are_left_out_up_to_a_limit(clips, tmp_path, capsys):
    text = listed_folder(clips, tmp_path, bad=(3,))
    (tmp_path / "scenes" / "4" / "city_0000000.safetensors").write_bytes(b"damaged")

    def opened(limit=0.4):
        return learn.listed_clips(from_list(text, bad_scenes=limit), 8, False, tmp_path / "out")

    def colors(source, steps=12):
        return [clip.rgb for step in range(steps) for clip in source.draw(step, 2, 2, "batch")]

    one, knowing = opened(), opened()
    first = colors(one)
    assert {n // 100_000_000 for n in one.shards.bad} == {3, 4}
    said = capsys.readouterr().err
    assert said.count("scenes/3") >= 1 and said.count("left out") == 2
    colors(knowing)
    assert all(map(torch.equal, first, colors(knowing)))  # what was known before changes nothing
    parts = [opened().draw(5, 4, 2, "batch", slice(n, n + 1))[0].rgb for n in range(4)]
    assert all(map(torch.equal, parts, [c.rgb for c in one.draw(5, 4, 2, "batch")]))
    refused("too many scenes", colors, opened(0.2), 40, raises=UsageError)


def test_a_training_on_a_list_resumes_bit_equal(clips, tmp_path):
    text = listed_folder(clips, tmp_path)
    Learn(out=tmp_path / "whole", settings=from_list(text)).run()
    with interrupted_at(0), pytest.raises(KeyboardInterrupt):
        Learn(out=tmp_path / "parts", settings=from_list(text)).run()
    Learn(out=tmp_path / "parts", settings=from_list(text)).run()
    assert losses_of(tmp_path / "whole") == losses_of(tmp_path / "parts")
    whole, parts = (
        {path.name: path.read_bytes() for path in (tmp_path / name / "model").glob("*.safetensors")}
        for name in ("whole", "parts")
    )
    assert whole and whole == parts
    assert not (tmp_path / "whole" / "cache").exists()
    inside = Learn(out=tmp_path / "scenes" / "1" / "out", settings=from_list(text))
    refused("lies in an input", inside.run, raises=UsageError)
    both = Learn(out=tmp_path / "both", settings=tiny(clips, scenes=(text,)))
    refused("list of scenes says", both.run, raises=UsageError)


def test_clips_at_an_address_give_the_same_losses(clips, address, tmp_path, capsys):
    for name, place in (("local", clips), ("streamed", address)):
        text = listed(tmp_path, [clips, place])
        settings = from_list(text, cache=str(tmp_path / "cache"), cache_gb=1e-6)
        Learn(out=tmp_path / name, settings=settings).run()
    assert losses_of(tmp_path / "local") == losses_of(tmp_path / "streamed")
    assert len(list((tmp_path / "cache").rglob("*.safetensors"))) == 1  # all others had to go
    for setting in ("textures", "clips"):
        words = ["learn", f"--data.{setting}", "s3://bucket/here", "--out", str(tmp_path / "c"), "--quiet"]
        assert app.main(words) == 2
        assert "a path of this machine" in capsys.readouterr().err


def test_the_least_recently_used_clips_leave_the_cache(tmp_path):
    cache = ShardCache(tmp_path, 250)

    def get(name, when):
        path = cache.get(f"{name}.safetensors", lambda at: store.atomic_write(at, bytes(100)))
        os.utime(path, ns=(when, when))
        return {p.stem for p in tmp_path.glob("*.safetensors")}

    assert [get("a", 1), get("b", 2), get("a", 3)][-1] == {"a", "b"}
    assert get("c", 4) == {"a", "c"}
    assert get("b", 5) == {"b", "c"}
    small = ShardCache(tmp_path / "small", 10)
    assert small.get("x.safetensors", lambda at: store.atomic_write(at, bytes(100))).is_file()


def test_what_arrives_is_verified(clips, address, tmp_path):
    folder = FolderOfShards(address)
    assert folder.numbers[:3] == [0, 1, 2] and len(folder.sums) == 4
    folder.bring(1, tmp_path / "one")
    assert (tmp_path / "one").read_bytes() == (clips / "city_0000001.safetensors").read_bytes()
    folder.sums["city_0000001.safetensors"] = "0" * 64
    refused("not what was uploaded", folder.bring, 1, tmp_path / "two", raises=IntegrityError)
    assert not (tmp_path / "two").exists()
    assert FolderOfShards(Location.of(f"{address}")).key == folder.key


def test_drawing_ahead_draws_what_would_be_drawn(clips, tmp_path):
    """The same clips, whether drawn before or at their step; nothing is drawn ahead that would be waited for."""
    source = learn.clips_of_cities(tiny(clips), clips)
    plain, asked = [source.draw(step, 4, 2, "batch") for step in range(4)], []

    def draw(step):
        asked.append((step, threading.current_thread() is threading.main_thread()))
        return [source.draw(step, 4, 2, "batch")]

    with learn.DrawingAhead(draw, lambda step: step != 2, 2, 4) as ahead:
        taken = [ahead.take(step)[0] for step in range(4)]
    assert sorted(asked) == [(0, True), (1, False), (2, True), (3, False)]
    for some, others in zip(taken, plain, strict=True):
        assert all(torch.equal(a.rgb, b.rgb) for a, b in zip(some, others, strict=True))
    assert source.ready(0) and not learn.clips_of_cities(tiny(clips), tmp_path / "none yet").ready(0)


def test_a_listed_log_is_cut_once_when_it_is_drawn(tmp_path, monkeypatch):
    calls = collections.Counter()
    windows = [log_clips.LogWindow(("a",), False)] * 3
    monkeypatch.setattr(shard_sources.log_clips, "log_source", lambda text: log_clips.LogSource(tmp_path, tmp_path))
    monkeypatch.setattr(shard_sources.store, "digest", lambda path: "content")
    monkeypatch.setattr(shard_sources, "read_scene", lambda path: None)
    monkeypatch.setattr(log_clips.LogClipRules, "windows", lambda rules, scene: windows)

    def write_log(source, rules, chosen, folder):
        calls.update(["write"])
        for number, _ in chosen:
            store.atomic_write(folder / f"city_{number:07d}.safetensors", b"x")

    monkeypatch.setattr(shard_sources.log_clips, "write_log", write_log)
    scenes = SceneList([ListedScene(path="log=fused")], {}, 0, "list")

    def make() -> ListedShards:
        return ListedShards(scenes, ShardCache(tmp_path / "cache", 10**9), log_clips.LogClipRules(48, 32), 0.0)

    shards = make()
    assert len(shards.opened(0).shards) == 3 and not calls
    assert all(path.is_file() for path in (shards.path(2), shards.path(1), make().path(3))) and calls["write"] == 1
