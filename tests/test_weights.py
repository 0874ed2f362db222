"""Published checkpoints: names, containers, what is refused, conversion and back."""

import collections
import functools
import gzip
import json
import os
import shutil
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import Asks, refused
from toy_published import TINY, dynamicrafter_checkpoint, scale_table, tiny_checkpoint

from mudg import app
from mudg.base import weights
from mudg.base.errors import IntegrityError, ResourceError, UsageError
from mudg.diffusion import convert, model_files
from mudg.diffusion.published import PublishedConfig
from mudg.diffusion.settings import ConvertConfig

CONFIG = ConvertConfig(resolution="320x512")
ENTER = "model.diffusion_model.input_blocks.0.0.weight"


@pytest.fixture(scope="module")
def complete():
    return tiny_checkpoint()


@pytest.fixture(scope="module")
def whole(complete, tmp_path_factory):
    """Folder of a converted model, the file as Lightning writes it."""
    folder = tmp_path_factory.mktemp("whole")
    converted(folder, containers(complete)["lightning"])
    return folder / "out"


@pytest.fixture(scope="module")
def published_keys():
    path = Path(__file__).parent / "golden" / "published_keys.json.gz"
    return {name: tuple(shape) for name, shape in json.loads(gzip.decompress(path.read_bytes())).items()}


def saved(tmp_path, content, name="model.ckpt"):
    torch.save(content, tmp_path / name)
    return tmp_path / name


def converted(tmp_path, content, config=CONFIG):
    convert.convert_file(config, saved(tmp_path, content), tmp_path / "out", TINY)
    return model_files.load_published(tmp_path / "out")


# names --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wanted():
    """Names and shapes of the full-size network."""
    return convert.wanted_shapes(PublishedConfig())


def test_every_published_tensor_is_accounted_for(published_keys, wanted):
    """The full-size network wants the published names and shapes; the rest is on the list of the unused."""
    published = weights.published_names(wanted)
    assert len(published_keys) == 2524
    used = {name: shape for name, shape in published_keys.items() if name not in weights.UNUSED}
    assert {published[name]: shape for name, shape in wanted.items()} == used
    assert len(published) + len(set(published_keys) & weights.UNUSED) == 2524
    assert len(set(weights.published_names(wanted).values())) == len(wanted)
    refused("lacks a tensor", weights.published_names, ["net.nothing"])
    counts = (("model.diffusion_model.", 1_440_917_060), ("first_stage_model.", 83_653_863))
    for prefix, count in (*counts, ("image_proj_model.", 48_787_456)):
        shapes = [shape for name, shape in published_keys.items() if name.startswith(prefix)]
        assert sum(torch.Size(shape).numel() for shape in shapes) == count


# containers ---------------------------------------------------------------------------------------


def containers(state):
    deep = {"_forward_module." + name: value for name, value in state.items()}
    more = {"epoch": 3, "global_step": 100, "hyper_parameters": {"lr": 1e-5, "names": ["a"]}}
    return {
        "lightning": {"state_dict": state, **more},
        "deepspeed": {"module": deep, "dp_world_size": 8, "mp_world_size": 1, "global_steps": 5, "ds_version": "0.9"},
        "plain": dict(state),
        "compiled": {"state_dict": {"module._orig_mod." + name: value for name, value in state.items()}},
    }


@pytest.mark.parametrize("kind", ["lightning", "deepspeed", "plain", "compiled"])
def test_every_container_gives_the_same_tensors(tmp_path, complete, kind):
    some = {name: complete[name] for name in list(complete)[:20]}
    found = weights.read_checkpoint(saved(tmp_path, containers(some)[kind]))
    assert found.keys() == some.keys()
    assert all(torch.equal(found[name], some[name]) for name in some)


def test_safetensors_and_old_style_files_are_read(tmp_path, complete):
    from safetensors.torch import save_file

    some = {name: complete[name] for name in list(complete)[:5]}
    save_file(some, tmp_path / "m.safetensors")
    torch.save({"state_dict": some}, tmp_path / "m.ckpt", _use_new_zipfile_serialization=False)
    for name in ("m.safetensors", "m.ckpt"):
        found = weights.read_checkpoint(tmp_path / name)
        assert all(torch.equal(found[key], some[key]) for key in some)


def class_of(name, base, monkeypatch):
    """A class that pickles as `name`, whose code fails when it runs."""

    def fail(self, *_):
        raise AssertionError("code of a pickled class ran")

    module_name, _, class_name = name.rpartition(".")
    made = type(class_name, (base,), {"__setstate__": fail, "__module__": module_name})
    parts = module_name.split(".")
    for n in range(1, len(parts) + 1):
        monkeypatch.setitem(sys.modules, ".".join(parts[:n]), types.ModuleType(".".join(parts[:n])))
    setattr(sys.modules[module_name], class_name, made)
    return made


def test_harmless_objects_are_ignored_without_their_code(tmp_path, monkeypatch):
    """Objects of training frameworks become stand-ins; the classes they name are not even looked up."""
    with monkeypatch.context() as only_while_saving:
        configuration = class_of("omegaconf.dictconfig.DictConfig", object, only_while_saving)()
        configuration.content = {"lr": 1}
        attributes = class_of("lightning_fabric.utilities.data.AttributeDict", dict, only_while_saving)(a=1)
        content = {
            "state_dict": {"a": torch.ones(2)},
            "hyper_parameters": configuration,
            "more": attributes,
            "lists": collections.defaultdict(list, b=[3]),
            "loss": np.float64(0.5),
        }
        path = saved(tmp_path, content)
    assert torch.equal(weights.read_checkpoint(path)["a"], torch.ones(2))


@pytest.mark.parametrize("where", ["beside", "inside"])
def test_a_pickle_that_runs_code_is_refused(tmp_path, where):
    bad = Asks(os.system, f"touch {tmp_path / 'ran'}")
    content = {"state_dict": {"a": torch.ones(1)}, "x": bad} if where == "beside" else {"state_dict": {"a": bad}}
    refused(r"not loaded(.|\n)*system", weights.read_checkpoint, saved(tmp_path, content))
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.98])
def test_truncated_files_are_refused(tmp_path, complete, share):
    path = saved(tmp_path, {"state_dict": dict(list(complete.items())[:50])})
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    refused("not a readable checkpoint", weights.read_checkpoint, path)


def test_files_without_tensors_are_refused(tmp_path):
    refused("no named tensors", weights.read_checkpoint, saved(tmp_path, {"epoch": 3, "state_dict": {}}))
    refused("no such checkpoint", weights.read_checkpoint, tmp_path / "nothing.ckpt")
    (tmp_path / "text.ckpt").write_text("version https://example.invalid/pointer\n")
    refused("not a readable checkpoint", weights.read_checkpoint, tmp_path / "text.ckpt")


# conversion ---------------------------------------------------------------------------------------


def test_conversion_keeps_every_value(whole, complete):
    model = model_files.load_published(whole)
    state = model.state_dict()
    names = weights.published_names(n for n in state if n not in ("text", "scale"))
    assert all(torch.equal(state[ours], complete[theirs]) for ours, theirs in names.items())
    assert model.text.shape == (2, 77, 16) and not torch.equal(model.text[0], model.text[1])
    assert all(word in (whole / "MODEL_CARD.md").read_text() for word in ("Licence", "Apache-2.0"))


def test_the_files_rescale_wins(tmp_path):
    state = tiny_checkpoint()
    state["scale_arr"] = scale_table(0.35)
    model = converted(tmp_path, {"state_dict": state})
    assert torch.equal(model.schedule.scale, scale_table(0.35)[:1000])
    assert model.config.schedule.base_scale == pytest.approx(0.35)


def test_rescale_stays_exact_in_half_precision(tmp_path, complete, monkeypatch):
    monkeypatch.setattr(model_files, "SHARD_BYTES", 1 << 20)
    model = converted(tmp_path, {"state_dict": complete}, ConvertConfig(resolution="320x512", dtype="bfloat16"))
    assert model.dtype == torch.bfloat16
    assert torch.equal(model.schedule.scale, scale_table()[:1000])
    again = model_files.load_published(tmp_path / "out", dtype=torch.float16)
    assert again.dtype == torch.float16
    assert torch.equal(again.scale, scale_table())
    assert len(list((tmp_path / "out").glob("weights_*.safetensors"))) > 1


def test_dynamicrafter_is_widened_and_the_small_one_refused_with_the_reason(tmp_path):
    state = dynamicrafter_checkpoint()
    model = converted(tmp_path, {"state_dict": state})
    kernel, wide = state[ENTER], model.net.down[0].conv.weight
    assert wide.shape == (32, 12, 3, 3)
    assert torch.equal(wide[:, :8], kernel / 2)
    assert torch.equal(wide[:, 8:], kernel[:, 4:] / 2)
    for name, value in model.net.time.state_dict().items():
        assert torch.equal(model.net.label.state_dict()[name], value)
    assert "12" in json.loads((tmp_path / "out" / "model.json").read_text())["facts"]["adapted"]


def test_what_does_not_fit_is_listed(tmp_path, complete):
    state = dict(complete)
    for name in list(state)[5:13]:
        del state[name]
    state["something.else"] = torch.zeros(1)
    state[ENTER] = torch.zeros(32, 12, 1, 1)
    text = str(refused(".", converted, tmp_path, {"state_dict": state}))
    assert "8 missing: " in text
    assert list(complete)[5] in text
    assert "1 unexpected: something.else" in text
    assert f"1 of another shape: {ENTER} (32, 12, 1, 1) instead of (32, 12, 3, 3)" in text
    assert list(tmp_path.iterdir()) == [tmp_path / "model.ckpt"]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("scale_arr", torch.full((1400,), -1.0), "out of range"),
        ("alphas_cumprod", torch.full((1000,), 0.005), "keeps signal"),
        (ENTER, torch.full((32, 12, 3, 3), float("nan")), "not finite"),
        (ENTER, torch.zeros(32, 12, 3, 3, dtype=torch.int32), "floating-point"),
    ],
)
def test_impossible_values_are_refused(tmp_path, complete, name, value, message):
    refused(message, converted, tmp_path, {"state_dict": {**complete, name: value}})
    assert not (tmp_path / "out").exists()


def converted_by_process(config: ConvertConfig, path: Path, to: Path, *, overwrite: bool = False) -> Path:
    conversion = functools.partial(convert.of_diffusion, config, path, network=TINY)
    return convert.run(config, path, to, conversion, overwrite=overwrite)


@pytest.mark.slow
def test_conversion_in_its_own_process(tmp_path, complete):
    """The way of the command line: a fresh process with a memory limit."""
    path = saved(tmp_path, {"state_dict": complete}, "512.ckpt")
    assert converted_by_process(ConvertConfig(), path, tmp_path / "model") == tmp_path / "model"
    assert model_files.load_published(tmp_path / "model").config.height == 320
    refused("exists", converted_by_process, ConvertConfig(), path, tmp_path / "model", raises=UsageError)
    (tmp_path / "photos").mkdir()
    again = functools.partial(converted_by_process, overwrite=True)
    refused("do not belong to a model", again, ConvertConfig(), path, tmp_path / "photos", raises=UsageError)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits of address space are a matter of Linux")
def test_the_memory_limit_holds(tmp_path, complete):
    path = saved(tmp_path, {"state_dict": {**complete, "big": torch.zeros(64_000_000)}}, "512.ckpt")
    config = ConvertConfig(memory_gb=0.1)
    refused("memory", converted_by_process, config, path, tmp_path / "model", raises=ResourceError)
    path.write_bytes(path.read_bytes()[:5000])
    refused("not a readable checkpoint", converted_by_process, ConvertConfig(), path, tmp_path / "model")
    assert not (tmp_path / "model").exists()


def test_the_command_says_what_is_wrong(tmp_path, capsys):
    (tmp_path / "512.ckpt").write_bytes(b"x")
    (tmp_path / "there").mkdir()
    cases = (
        (["nothing.ckpt", "--to", "m"], 3, "no such checkpoint"),
        ([str(tmp_path / "512.ckpt"), "--to", str(tmp_path / "there")], 2, "the folder exists"),
        ([str(tmp_path / "512.ckpt"), "--to", str(tmp_path / "there"), "--overwrite"], 2, "do not belong to a model"),
    )
    for words, code, message in cases:
        assert app.main(["convert", *words]) == code
        assert message in capsys.readouterr().err


def test_resolution_is_told_by_the_name_or_asked_for(tmp_path):
    assert convert.resolution(ConvertConfig(), Path("1024-mdm-checkpoint.ckpt")) == (576, 1024)
    assert convert.resolution(ConvertConfig(), Path("DynamiCrafter_512/model.ckpt")) == (320, 512)
    assert convert.resolution(CONFIG, Path("x/1024.ckpt")) == (320, 512)
    refused("--resolution", convert.resolution, ConvertConfig(), Path("x/model.ckpt"), raises=UsageError)


def test_altered_model_folders_are_refused(tmp_path, whole):
    shutil.copytree(whole, tmp_path / "out")
    part = tmp_path / "out" / "weights_00.safetensors"
    content = bytearray(part.read_bytes())
    content[-1] ^= 1
    part.write_bytes(bytes(content))
    refused("altered", model_files.load_published, tmp_path / "out", raises=IntegrityError)
    description = tmp_path / "out" / "model.json"
    values = json.loads(description.read_text())
    values["config"]["net"]["colour"] = 1
    description.write_text(json.dumps(values))
    refused("unknown field 'colour'", model_files.load_published, tmp_path / "out")
