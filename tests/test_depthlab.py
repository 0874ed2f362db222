"""DepthLab: the conversion of its published files, what its networks are given, and its denoising against a twin
written out."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_networks
import torch
from PIL import Image
from safetensors.torch import save_file
from test_depth_networks import street
from tiny_networks import package
from torch import Tensor
from toy_scene import ToyStreet

from mudg.base.errors import InputError, IntegrityError, ResourceError, UsageError
from mudg.diffusion.settings import ConvertConfig
from mudg.labels import depthlab
from mudg.labels.depth_networks import kind_of, load_depth_network
from mudg.labels.depthlab import DepthLab, DepthLabSampling, clip_crop, known_depth, linear_fill, prepare
from mudg.labels.inputs import DepthInput
from mudg.labels.settings import AnnotateConfig
from mudg.scene.labels import read_label
from mudg.scene.read import read_scene
from mudg.steps.export import Convert
from mudg.steps.ingest import Annotate

pytestmark = pytest.mark.filterwarnings("ignore")
Published = tuple[Path, dict[str, Any]]
"""DepthLab's files in their layout, and the networks in them."""
SAMPLING = DepthLabSampling(processing_px=48, steps=5)
CLIP = "CLIP-ViT-H-14-laion2B-s32B-b79K"


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Published:
    folder = tmp_path_factory.mktemp("checkpoints")
    return folder, tiny_networks.depthlab(folder)


@pytest.fixture(scope="module")
def converted(published: Published, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The converted folder, with a sampling for small images."""
    to = tmp_path_factory.mktemp("weights") / "depthlab"
    depthlab.convert_folder(published[0], to, None, 20_000)
    assert json.loads((to / "model.json").read_text())["sampling"] == asdict(DepthLabSampling())
    return describe(to, sampling=asdict(SAMPLING))


def describe(folder: Path, **other: object) -> Path:
    """The folder with other entries in its description."""
    file = folder / "model.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **other}))
    return folder


# --- conversion -----------------------------------------------------------------------------------


def test_conversion_keeps_every_value(published: Published, converted: Path) -> None:
    made = published[1]
    told = json.loads((converted / "model.json").read_text())
    assert kind_of(converted) == told["kind"] == "depthlab"
    model = DepthLab(converted)
    found = {**model.networks, "mapping_layer": model.mapping}
    for name in ("denoising_unet", "vae"):
        assert same(found[name].state_dict(), made[name].state_dict())
    assert same(found["mapping_layer"], made["mapping_layer"].state_dict())
    spare, reference = ("conv_norm_out", "conv_out"), found["reference_unet"].state_dict()
    given = {k: v for k, v in made["reference_unet"].state_dict().items() if not k.startswith(spare)}
    assert all(torch.equal(reference[name], value) for name, value in given.items())
    assert not any(value.any() for name, value in reference.items() if name.startswith(spare))
    vision = {k: v for k, v in made["clip"].state_dict().items() if k.startswith(("vision_model", "visual_projection"))}
    assert same(found["image_encoder"].state_dict(), vision)
    image = torch.rand(1, 3, 28, 28, generator=torch.Generator().manual_seed(0))
    expected = made["clip"].visual_projection(made["clip"].vision_model(image).pooler_output)
    assert torch.allclose(found["image_encoder"](image).image_embeds, expected, atol=1e-6)
    assert [found[name].config.in_channels for name in ("denoising_unet", "reference_unet")] == [12, 4]
    assert len(list((converted / "denoising_unet").glob("*.safetensors"))) > 1  # cut to the size that was asked for
    listed = {source["file"] for source in told["facts"]["sources"]}
    assert {f"DepthLab/{part}.pth" for part in ("denoising_unet", "reference_unet", "mapping_layer")} < listed
    assert all(len(source["sha256"]) == 64 for source in told["facts"]["sources"])
    assert {path.suffix for path in converted.rglob("*") if path.is_file()} == {".safetensors", ".json", ".md"}


def same(found: dict[str, Tensor], expected: dict[str, Tensor]) -> bool:
    return found.keys() == expected.keys() and all(torch.equal(found[name], expected[name]) for name in found)


def test_files_of_other_ages_give_the_same(published: Published, tmp_path: Path) -> None:
    """A CLIP that says a default twice; the autoencoder's attention under its old names; half precision."""
    folder, made = tmp_path / "copy", published[1]
    shutil.copytree(published[0], folder)
    told = json.loads((folder / CLIP / "config.json").read_text())
    inner = {**told["vision_config"], "projection_dim": 512, "num_beams": 1, "torch_dtype": None}
    (folder / CLIP / "config.json").write_text(json.dumps({**told, "vision_config": inner}))
    renamed = {}
    for name, value in made["vae"].state_dict().items():
        for new, old in (("to_q", "query"), ("to_k", "key"), ("to_v", "value"), ("to_out.0", "proj_attn")):
            name = name.replace(f".{new}.", f".{old}.")
        renamed[name] = value
    file = folder / "marigold-depth-v1-0" / "vae" / "diffusion_pytorch_model.safetensors"
    save_file(renamed, file, metadata={"format": "pt"})
    depthlab.convert_folder(folder, tmp_path / "out", torch.float16, 1 << 20)
    networks = DepthLab(tmp_path / "out").networks
    rounded = {name: value.half().float() for name, value in made["vae"].state_dict().items()}
    assert renamed.keys() != rounded.keys() and same(networks["vae"].state_dict(), rounded)
    found = networks["image_encoder"].visual_projection.weight
    assert torch.equal(found, made["clip"].visual_projection.weight.half().float())


@pytest.mark.slow
def test_the_command_converts_in_a_process_of_its_own(published: Published, tmp_path: Path) -> None:
    to = Convert(checkpoint=published[0], to=tmp_path / "out", settings=ConvertConfig()).run()
    assert isinstance(load_depth_network(to), DepthLab)


def test_flags_that_mean_nothing_for_a_folder_are_refused(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    config = ConvertConfig(resolution="320x512")
    with pytest.raises(UsageError, match="does not apply to a DepthLab folder"):
        Convert(checkpoint=tmp_path / "in", to=tmp_path / "out", settings=config).run()
    with pytest.raises(InputError, match="a part of DepthLab is missing"):
        Convert(checkpoint=tmp_path / "in", to=tmp_path / "out", settings=ConvertConfig()).run()
    assert not (tmp_path / "out").exists()


class Hostile:
    """Runs code when it is unpickled, unless somebody takes care."""

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return os.mkdir, ("harm",)


def edited(file: str, edit: Callable[[dict[str, Tensor]], object]) -> Callable[[Path], None]:
    """A change of the tensors in one of the pickles."""

    def change(folder: Path) -> None:
        state = torch.load(folder / "DepthLab" / file, weights_only=True)
        edit(state)
        torch.save(state, folder / "DepthLab" / file)

    return change


def json_edit(file: str, **values: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / file).write_text(json.dumps({**json.loads((folder / file).read_text()), **values}))

    return change


def without(file: str) -> Callable[[Path], None]:
    return lambda folder: (folder / file).unlink()


BAD = {
    "a missing file": (without("DepthLab/reference_unet.pth"), r"missing[\s\S]*reference_unet\.pth"),
    "no base": (without("marigold-depth-v1-0/unet/config.json"), r"is missing[\s\S]*marigold-depth-v1-0"),
    "no encoder weights": (without(f"{CLIP}/model.safetensors"), r"CLIPModel"),
    "code": (edited("mapping_layer.pth", lambda s: s.update(x=Hostile())), r"was not loaded[\s\S]*mkdir"),
    "a missing tensor": (edited("denoising_unet.pth", lambda s: s.pop("conv_out.bias")), r"1 missing: conv_out\.bias"),
    "an unknown tensor": (edited("reference_unet.pth", lambda s: s.update(x=torch.ones(4))), "1 unexpected: x"),
    "another shape": (
        edited("denoising_unet.pth", lambda s: s.update({"conv_in.weight": torch.ones(8, 8, 3, 3)})),
        r"conv_in\.weight \(8, 8, 3, 3\) instead of \(8, 12, 3, 3\)",
    ),
    "no number": (edited("mapping_layer.pth", lambda s: s["mapping_layer.bias"].fill_(math.nan)), "not finite"),
    "a later schedule": (
        json_edit("marigold-depth-v1-0/scheduler/scheduler_config.json", rescale_betas_zero_snr=True),
        "later Marigold",
    ),
    "another scale": (json_edit("marigold-depth-v1-0/vae/config.json", scaling_factor=0.13), "scaling_factor"),
    "no such network": (
        json_edit("marigold-depth-v1-0/unet/config.json", down_block_types=["Odd", "Odd"]),
        "description of a network",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_not_depthlab_is_refused(
    name: str, published: Published, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil, message = BAD[name]
    shutil.copytree(published[0], tmp_path / "from")
    monkeypatch.chdir(tmp_path)
    spoil(tmp_path / "from")
    with pytest.raises(InputError, match=message):
        depthlab.convert_folder(tmp_path / "from", tmp_path / "out", None, 1 << 20)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["from"]


def test_a_converted_folder_that_changed_or_lacks_a_package_is_refused(
    converted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(converted, folder)
    file = next((folder / "vae").iterdir())
    content = file.read_bytes()
    file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(IntegrityError, match="altered"):
        load_depth_network(folder)
    file.write_bytes(content)
    told = json.loads((folder / "model.json").read_text())
    for other, message in (
        ({"schema": 1}, "not a DepthLab model of this version"),
        ({"sampling": {"steps": 50}}, "the field 'processing_px' is missing"),
        ({"files": None}, "a DepthLab model"),
    ):
        (folder / "model.json").write_text(json.dumps({**told, **other}))
        with pytest.raises(InputError, match=message):
            load_depth_network(folder)
    schedule = folder / "scheduler" / "scheduler_config.json"
    schedule.write_text(json.dumps({"_class_name": "LCMScheduler"}))
    files = {name: sha256 for name, sha256 in told["files"].items() if not name.startswith("scheduler")}
    with pytest.raises(InputError, match="LCMScheduler"):
        load_depth_network(describe(folder, **{**told, "files": files}))
    tiny_networks.hide(monkeypatch, "diffusers")
    with pytest.raises(ResourceError, match=r"mudg\[models\]"):
        load_depth_network(folder)


# --- what the networks are given ------------------------------------------------------------------


def test_known_depth_at_another_size_is_the_nearest_return_there() -> None:
    measured = np.full((4, 6), np.nan, np.float32)
    measured[0, 0], measured[1, 1], measured[3, 5] = 9, 4, 7
    assert np.array_equal(known_depth(measured, (4, 6)), measured, equal_nan=True)
    small = known_depth(measured, (2, 3))
    assert small[0, 0] == 4 and small[1, 2] == 7 and np.isfinite(small).sum() == 2
    large = known_depth(measured, (8, 12))
    assert (large[6:, 10:] == 7).all() and np.isfinite(large).sum() == 12


def test_linear_interpolation_is_exact_on_planes_and_zero_outside() -> None:
    v, u = np.mgrid[0:12, 0:16]
    plane = (0.3 * u - 0.2 * v + 1).astype(np.float32)
    known = np.full_like(plane, np.nan)
    for row, column in ((2, 2), (2, 12), (9, 2), (9, 12), (5, 6)):
        known[row, column] = plane[row, column]
    inside = (v >= 2) & (v <= 9) & (u >= 2) & (u <= 12)
    filled = linear_fill(known)
    assert np.abs(filled - plane)[inside].max() < 1e-5 and (filled[~inside] == 0).all()
    line = np.full_like(plane, np.nan)
    line[3] = plane[3]
    assert np.array_equal(linear_fill(line)[3], plane[3]) and not linear_fill(line)[[2, 4]].any()


def test_what_is_prepared_spans_the_known_depth() -> None:
    given, _ = street(30, 50)
    made = prepare(given, 48, 4, 28)
    assert made.size == (28, 48) and made.image.shape == (1, 3, 28, 48)
    seen = np.isfinite(given.measured) & ~given.sky
    assert (made.low_m, made.high_m) == (given.measured[seen].min(), given.measured[seen].max())
    known = made.missing == 0
    for plane in (made.nearest, made.linear):
        assert float(plane[known].min()) == pytest.approx(-1, abs=1e-5)
        assert float(plane[known].max()) == pytest.approx(1, abs=1e-5)
    assert torch.equal(made.nearest[known], made.linear[known]) and set(made.missing.unique().tolist()) == {0.0, 1.0}
    same_size = prepare(given, 50, 8, 28)
    assert same_size.image.shape == (1, 3, 32, 56)
    assert torch.equal(same_size.image[..., :30, 50:], same_size.image[..., :30, 49:50].expand(-1, -1, -1, 6))
    assert np.array_equal(same_size.missing[0, 0, :30, :50].numpy() == 0, seen)
    assert np.array_equal(((same_size.image[0, :, :30, :50].permute(1, 2, 0) + 1) * 127.5).round().numpy(), given.rgb)
    in_the_sky = np.where(given.sky, np.float32(50), np.float32(np.nan))  # is not known
    with pytest.raises(InputError, match="LiDAR"):
        prepare(DepthInput(given.rgb, in_the_sky, given.filled, given.sky), 48, 2, 28)


@pytest.mark.parametrize(("height", "width"), [(48, 72), (90, 40), (10, 12)])
def test_the_image_encoders_image_is_the_packages(height: int, width: int) -> None:
    transformers = package("transformers")
    processor = (getattr(transformers, "CLIPImageProcessorPil", None) or transformers.CLIPImageProcessor)()
    rgb = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    expected = processor(images=Image.fromarray(rgb), return_tensors="pt")["pixel_values"]
    np.testing.assert_allclose(clip_crop(rgb, 224).numpy(), expected.numpy(), atol=1e-5)


# --- denoising ------------------------------------------------------------------------------------


def attend(attn: Any, x: Tensor, context: Tensor) -> Tensor:
    """Attention of one layer of diffusers, written out."""
    parts = (attn.to_q(x), attn.to_k(context), attn.to_v(context))
    q, k, v = (y.unflatten(-1, (attn.heads, -1)).transpose(1, 2) for y in parts)
    share = torch.softmax(q @ k.transpose(-1, -2) / q.shape[-1] ** 0.5, -1)
    return attn.to_out[0]((share @ v).transpose(1, 2).flatten(2))


def spelled_out(unet: Any, bank: dict[str, Tensor], *, reads: bool) -> Any:
    """A U-Net whose transformer blocks are written out: one that fills the bank, or one whose second half of a batch
    reads it."""
    for name, block in unet.named_modules():
        if type(block).__name__ != "BasicTransformerBlock":
            continue

        def forward(
            x: Tensor, *_: object, encoder_hidden_states: Tensor, at: str = name, b: Any = block, **__: object
        ) -> Tensor:
            seen = b.norm1(x)
            if reads:
                half = len(x) // 2
                alone = attend(b.attn1, seen[:half], seen[:half])
                both = attend(b.attn1, seen[half:], torch.cat([seen, bank[at]], 1)[half:])
                x = x + torch.cat([alone, both])
            else:
                bank[at] = seen
                x = x + attend(b.attn1, seen, seen)
            x = x + attend(b.attn2, b.norm2(x), encoder_hidden_states)
            return x + b.ff(b.norm3(x))

        block.forward = forward
    return unet


def twin(made: dict[str, Any], inputs: depthlab.Prepared, noise: Tensor, sampling: DepthLabSampling) -> Tensor:
    """The published algorithm in float64, both guidance passes in one batch, its noise schedule as formulas."""
    nets = {name: made[name].double() for name in ("denoising_unet", "reference_unet", "vae", "clip", "mapping_layer")}
    bank: dict[str, Tensor] = {}
    writer = spelled_out(nets["reference_unet"], bank, reads=False)
    reader = spelled_out(nets["denoising_unet"], bank, reads=True)

    def encode(plane: Tensor) -> Tensor:
        moments = nets["vae"].quant_conv(nets["vae"].encoder(plane.double().repeat(1, 3 // plane.shape[1], 1, 1)))
        return moments.chunk(2, 1)[0] * 0.18215

    pooled = nets["clip"].vision_model(inputs.crop.double()).pooler_output
    vector = nets["mapping_layer"](nets["clip"].visual_projection(pooled)[:, None])
    both = torch.cat([torch.full_like(vector, 0.3), vector])  # what the half without image is told does not matter
    writer(encode(inputs.image).repeat(2, 1, 1, 1), torch.tensor(0), encoder_hidden_states=both)
    depth, known, mask = encode(inputs.nearest), encode(inputs.linear), encode(inputs.missing * 2 - 1)
    cell = inputs.missing.shape[2] // noise.shape[2]
    missing = inputs.missing[..., ::cell, ::cell].double()
    kept = torch.cumprod(1 - torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2, 0)
    stride = 1000 // sampling.steps
    first = sampling.steps - int(sampling.steps * sampling.strength)
    times = [1000 - n * stride - 1 for n in range(sampling.steps)][first:]
    noise = noise.double()
    noisy = lambda t: kept[t].sqrt() * depth + (1 - kept[t]).sqrt() * noise
    x = noisy(times[0])
    for t, after in zip(times, [*times[1:], None]):
        out = reader(torch.cat([x, mask, known], 1).repeat(2, 1, 1, 1), torch.tensor(t), encoder_hidden_states=both)
        without, with_image = out.sample.chunk(2)
        v = without + 1.0 * (with_image - without)
        clean = kept[t].sqrt() * x - (1 - kept[t]).sqrt() * v
        rest = kept[t].sqrt() * v + (1 - kept[t]).sqrt() * x
        to = kept[max(t - stride, 0)]
        x = to.sqrt() * clean + (1 - to).sqrt() * rest
        if after is not None:
            x = missing * x + (1 - missing) * noisy(after)
    decoded = nets["vae"].decoder(nets["vae"].post_quant_conv(x / 0.18215)).mean(1, keepdim=True)
    return ((decoded + 1) / 2)[..., : inputs.size[0], : inputs.size[1]]


def test_denoising_is_that_of_a_twin_written_out(converted: Path, tmp_path: Path) -> None:
    made = tiny_networks.depthlab(tmp_path)
    model = DepthLab(converted)
    given, _ = street(30, 50, measured=0.4)  # 28 x 48 of processing: odd sizes on the way down
    inputs = prepare(given, SAMPLING.processing_px, 2, 28)
    noise = torch.randn(1, 4, 14, 24, generator=torch.Generator().manual_seed(1))
    found = model.predict(inputs, noise)
    with torch.no_grad():
        expected = twin(made, inputs, noise, SAMPLING)
    assert found.shape == expected.shape == (1, 1, 28, 48) and float(expected.std()) > 1e-2
    np.testing.assert_allclose(found.numpy(), expected.numpy(), atol=2e-5)


def test_answers_are_of_the_images_size_and_always_the_same(converted: Path) -> None:
    given, _ = street(30, 50)
    model = load_depth_network(converted)
    first, second = model(given), model(given)
    assert first.space == "depth" and first.values.shape == (30, 50) and first.values.dtype == np.float32
    assert float(first.values.min()) >= 0 and np.array_equal(first.values, second.values)
    assert np.array_equal(first.values, load_depth_network(converted)(given).values)
    other = DepthInput(given.rgb, given.measured * 2, given.filled, given.sky)
    np.testing.assert_allclose(model(other).values, 2 * first.values, rtol=1e-3, atol=1e-3)  # metres in, metres out


def test_the_number_of_steps_is_honoured(converted: Path) -> None:
    given, _ = street(12, 16)
    for steps, made in ((0, 4), (2, 1), (10, 8)):
        model = load_depth_network(converted, steps=steps)
        assert isinstance(model, DepthLab)
        calls: list[int] = []
        model.networks["denoising_unet"].register_forward_pre_hook(lambda _, __, calls=calls: calls.append(1))
        model(given)
        assert len(calls) == made
    for steps, message in ((1, "at least 2"), (2000, "<= 1000")):
        with pytest.raises(UsageError, match=message):
            load_depth_network(converted, steps=steps)


def test_annotate_reads_a_converted_folder(converted: Path, tmp_path: Path) -> None:
    """A random network: its depth is refused or aligned frame by frame, and the notes name it either way."""
    street_ = ToyStreet(car_start=(11, 1.0), car_velocity=(2, 0), times=(0.0, 0.1))
    street_.write(tmp_path / "plain", labels=False, width=96, height=48)
    config = AnnotateConfig(depth_network=str(converted), depth_steps=2, processes=1)
    scene = read_scene(Annotate(scene=tmp_path / "plain", out=tmp_path / "out", settings=config).run())
    for frame in scene.frames:
        depth = read_label(scene, frame, "depth")
        assert depth.shape == (48, 96) and np.isfinite(depth).all()
    (note,) = [note for note in scene.source.notes if note.startswith("depth of 2 frames")]
    assert "network 'depthlab' in folder 'depthlab' (sha256 " in note
