"""The latent codec: exact where it promises to be, close elsewhere, honest about what is missing."""

import math

import pytest
import torch

from mudg.base.errors import UsageError
from mudg.networks.codec import CodecConfig, PatchCodec, code_to_depth, depth_to_code, semantic_shares


def smooth_images(count=6, height=16, width=24, seed=0):
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(count, 3, 3, 4, generator=generator)
    return torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)


def test_depth_code_and_its_inverse():
    config = CodecConfig()
    depth = torch.tensor([2.0, 3.0, 10.0, 55.5, 100.0])
    assert torch.allclose(code_to_depth(depth_to_code(depth, config), config), depth, rtol=1e-5)
    assert float(depth_to_code(torch.tensor(100.0), config)) == pytest.approx(1.0)
    assert float(depth_to_code(torch.tensor(1e9), config)) == pytest.approx(1.0)


def decoded(codec, **given):
    """Pixels of some modalities' latents; the others are zeros."""
    some = next(iter(given.values()))
    zeros = {m: some.new_zeros(*some.shape[:-3], c, *some.shape[-2:]) for m, c in codec.channels.items()}
    return codec.decode({**zeros, **given})


def test_depth_code_known_values():
    assert float(depth_to_code(torch.tensor(2.0), CodecConfig())) == pytest.approx(-1.0)
    middle = math.sqrt(2.0 * 100.0)
    assert float(depth_to_code(torch.tensor(middle), CodecConfig())) == pytest.approx(0.0, abs=1e-6)


def test_depth_survives_the_codec_exactly():
    codec = PatchCodec(CodecConfig()).eval()
    depth = 2.0 + 90 * torch.rand(3, 1, 16, 24, generator=torch.Generator().manual_seed(0))
    codec.fit_depth(depth)
    with torch.no_grad():
        back = decoded(codec, depth=codec.encode_depth(depth)).depth
    assert torch.allclose(back, depth, rtol=1e-4)


def test_colour_basis_keeps_smooth_images_and_whitens():
    codec = PatchCodec(CodecConfig()).eval()
    images = smooth_images(40)
    codec.fit_color(images)
    z = codec.encode_rgb(images)
    assert z.shape == (40, 4, 8, 12)
    deviation = z.std((0, 2, 3))
    assert float(deviation[0]) == pytest.approx(1.0, abs=0.02)
    assert float(deviation[2]) == pytest.approx(1 / 1.5, abs=0.02)
    with torch.no_grad():
        back = decoded(codec, rgb=z).rgb
    assert float((back - images).square().mean()) < 2e-3


def test_colour_latent_is_blind_to_nothing_constant():
    codec = PatchCodec(CodecConfig()).eval()
    codec.fit_color(smooth_images(40))
    flat = torch.tensor([0.2, 0.5, 0.8]).view(1, 3, 1, 1).expand(1, 3, 16, 24)
    with torch.no_grad():
        back = decoded(codec, rgb=codec.encode_rgb(flat)).rgb
    assert float((back - flat).abs().max()) < 0.05


def test_shares_count_labelled_pixels_only():
    ids = torch.tensor([[0, 0, 10, 255], [0, 13, 255, 255]])
    shares = semantic_shares(ids)
    assert shares.shape == (19, 1, 2) and float(shares[0, 0, 0]) == pytest.approx(0.75)
    assert float(shares[13, 0, 0]) == pytest.approx(0.25) and float(shares[10, 0, 1]) == 1.0
    assert float(semantic_shares(torch.full((2, 2), 255)).sum()) == 0.0


def test_uniform_classes_survive():
    codec = PatchCodec(CodecConfig()).eval()
    for label in range(19):
        ids = torch.full((1, 4, 4), label)
        with torch.no_grad():
            made = decoded(codec, semantics=codec.encode_semantics(ids))
        assert torch.equal(made.semantics, ids)


def test_a_single_frame_without_leading_axes_is_fine():
    codec = PatchCodec(CodecConfig()).eval()
    with torch.no_grad():
        made = decoded(codec, depth=codec.encode_depth(torch.full((1, 8, 8), 7.0)))
    assert made.depth.shape == (1, 8, 8)


def test_leading_axes_are_kept():
    codec = PatchCodec(CodecConfig()).eval()
    rgb, depth = torch.rand(2, 3, 3, 8, 8), torch.full((2, 3, 1, 8, 8), 9.0)
    ids = torch.zeros(2, 3, 8, 8, dtype=torch.long)
    latents = {"rgb": codec.encode_rgb(rgb), "depth": codec.encode_depth(depth)}
    latents["semantics"] = codec.encode_semantics(ids)
    with torch.no_grad():
        made = codec.decode(latents)
    assert made.rgb.shape == rgb.shape and made.depth.shape == depth.shape and made.semantics.shape == ids.shape


def test_an_empty_depth_range_is_refused():
    with pytest.raises(UsageError):
        CodecConfig(near_m=5.0, far_m=5.0)
