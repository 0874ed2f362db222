"""The latent codec: exact where it promises to be, close elsewhere, honest about what is missing."""

import math

import pytest
import torch

from mudg.base import palette
from mudg.base.errors import UsageError
from mudg.models.mdm.codec import CodecConfig, build_codec, code_to_depth, depth_to_code, semantic_shares


def smooth_images(count=6, height=16, width=24, seed=0):
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(count, 3, 3, 4, generator=generator)
    return torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)


@pytest.mark.parametrize("code", ["log", "linear"])
def test_depth_code_and_its_inverse(code):
    config = CodecConfig(depth_code=code)
    depth = torch.tensor([2.0, 3.0, 10.0, 55.5, 100.0])
    assert torch.allclose(code_to_depth(depth_to_code(depth, config), config), depth, rtol=1e-5)
    assert float(depth_to_code(torch.tensor(100.0), config)) == pytest.approx(1.0)
    assert float(depth_to_code(torch.tensor(1e9), config)) == pytest.approx(1.0)


def test_depth_code_known_values():
    assert float(depth_to_code(torch.tensor(2.0), CodecConfig())) == pytest.approx(-1.0)
    middle = math.sqrt(2.0 * 100.0)
    assert float(depth_to_code(torch.tensor(middle), CodecConfig())) == pytest.approx(0.0, abs=1e-6)
    assert float(depth_to_code(torch.tensor(25.0), CodecConfig(depth_code="linear"))) == pytest.approx(-0.5)


def test_depth_survives_the_codec_exactly():
    codec = build_codec(CodecConfig()).eval()
    depth = 2.0 + 90 * torch.rand(3, 1, 16, 24, generator=torch.Generator().manual_seed(0))
    codec.fit_depth(depth)
    with torch.no_grad():
        back = codec.decode({"depth": codec.encode_depth(depth)}).depth
    assert torch.allclose(back, depth, rtol=1e-4)


def test_colour_basis_keeps_smooth_images_and_whitens():
    codec = build_codec(CodecConfig()).eval()
    images = smooth_images(40)
    codec.fit_colour(images)
    z = codec.encode_rgb(images)
    assert z.shape == (40, 4, 8, 12)
    deviation = z.std((0, 2, 3))
    assert float(deviation[0]) == pytest.approx(1.0, abs=0.02)
    assert float(deviation[2]) == pytest.approx(1 / 1.5, abs=0.02)
    with torch.no_grad():
        back = codec.decode({"rgb": z}).rgb
    assert float((back - images).square().mean()) < 2e-3


def test_colour_latent_is_blind_to_nothing_constant():
    codec = build_codec(CodecConfig()).eval()
    codec.fit_colour(smooth_images(40))
    flat = torch.tensor([0.2, 0.5, 0.8]).view(1, 3, 1, 1).expand(1, 3, 16, 24)
    with torch.no_grad():
        back = codec.decode({"rgb": codec.encode_rgb(flat)}).rgb
    assert float((back - flat).abs().max()) < 0.05


def test_shares_count_labelled_pixels_only():
    ids = torch.tensor([[0, 0, 10, 255], [0, 13, 255, 255]])
    shares = semantic_shares(ids)
    assert shares.shape == (19, 1, 2)
    assert float(shares[0, 0, 0]) == pytest.approx(0.75)
    assert float(shares[13, 0, 0]) == pytest.approx(0.25)
    assert float(shares[10, 0, 1]) == 1.0
    assert float(semantic_shares(torch.full((2, 2), 255)).sum()) == 0.0


def test_uniform_classes_survive():
    codec = build_codec(CodecConfig()).eval()
    for label in range(19):
        ids = torch.full((1, 4, 4), label)
        with torch.no_grad():
            decoded = codec.decode({"semantics": codec.encode_semantics(ids)})
        assert torch.equal(decoded.semantics, ids)
        assert float(decoded.margin.min()) > 0.5


def test_palette_code_decodes_every_class():
    codec = build_codec(CodecConfig(semantics_code="palette")).eval()
    codec.fit_colour(smooth_images(40))
    ids = torch.arange(19).repeat_interleave(2).repeat(2, 1)[None]
    with torch.no_grad():
        decoded = codec.decode({"semantics": codec.encode_semantics(ids)})
    assert float((decoded.semantics == ids).float().mean()) > 0.9
    assert palette.CLASSES[int(decoded.semantics[0, 0, 0])] == "road"


def test_a_single_frame_without_leading_axes_is_fine():
    codec = build_codec(CodecConfig()).eval()
    with torch.no_grad():
        decoded = codec.decode({"depth": codec.encode_depth(torch.full((1, 8, 8), 7.0))})
    assert decoded.depth.shape == (1, 8, 8)


def test_leading_axes_are_kept():
    codec = build_codec(CodecConfig()).eval()
    rgb, depth, ids = torch.rand(2, 3, 3, 8, 8), torch.full((2, 3, 1, 8, 8), 9.0), torch.zeros(2, 3, 8, 8, dtype=torch.long)
    latents = {"rgb": codec.encode_rgb(rgb), "depth": codec.encode_depth(depth), "semantics": codec.encode_semantics(ids)}
    with torch.no_grad():
        decoded = codec.decode(latents)
    assert decoded.rgb.shape == rgb.shape
    assert decoded.depth.shape == depth.shape
    assert decoded.semantics.shape == ids.shape
    assert codec.decode({"rgb": latents["rgb"]}).semantics is None


def test_missing_codec_and_bad_range_are_refused():
    with pytest.raises(UsageError, match="kl"):
        build_codec(CodecConfig(kind="kl"))
    with pytest.raises(UsageError):
        CodecConfig(near_m=5.0, far_m=5.0)
