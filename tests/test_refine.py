"""The pixel-level part of the diffusion model: what is copied, shapes."""

import pytest
import torch

from mudg.diffusion import network
from mudg.diffusion.network import ConditionPixels, Refiner
from mudg.networks.codec import CodecConfig, PatchCodec


def some(count=4, height=16, width=24, seed=0):
    """A codec, a refiner whose last layer is untouched, latents and a condition of random pixels."""
    generator = torch.Generator().manual_seed(seed)
    codec = PatchCodec(CodecConfig(decoder_width=8, decoder_blocks=1))
    refiner = Refiner(sum(codec.channels.values()), (16, 24), (1, 1))
    latents = {
        m: torch.randn(count, c, height // 2, width // 2, generator=generator) for m, c in codec.channels.items()
    }
    image = lambda c: torch.rand(count, c, height, width, generator=generator) * 2 - 1
    ids = lambda: torch.randint(0, 19, (count, 1, height, width), generator=generator, dtype=torch.uint8)
    given = ConditionPixels(image(3), image(3), image(1), image(1) > 0, image(1) > 0, ids(), ids())
    return codec, refiner, latents, given


def test_open_gates_hand_the_condition_through():
    codec, refiner, latents, given = some()
    with torch.no_grad():
        starts = refiner.leave.bias.split(Refiner.SIZES)
        for number in (1, 4, 6):  # colour, depth and classes of the condition
            starts[number].fill_(30.0)
        made = refiner(codec, latents, given, 4)
        _, _, base = codec.decode_raw(latents)
    assert torch.allclose(made.depth_code, given.depth_code, atol=1e-5)
    assert torch.allclose(
        made.rgb, given.color + torch.sigmoid(torch.tensor(-4.0)) * (given.backdrop - given.color), atol=1e-5
    )
    shown = given.ids.squeeze(1).long()
    gained = (made.scores - base).gather(1, shown.unsqueeze(1))
    assert float(gained.min()) > network.COPY_SCORE - 0.01


def test_shut_gates_leave_what_the_codec_makes():
    codec, refiner, latents, given = some()
    with torch.no_grad():
        starts = refiner.leave.bias.split(Refiner.SIZES)
        for number in (1, 2, 4, 6, 7):
            starts[number].fill_(-30.0)
        made = refiner(codec, latents, given, 4)
    for stated, base in zip((made.rgb, made.depth_code, made.scores), codec.decode_raw(latents)):
        assert torch.allclose(stated, base, atol=1e-5)


def test_shares_of_known_classes():
    ids = torch.tensor([[3, 3, 255, 255], [3, 7, 255, 1]], dtype=torch.uint8).view(1, 1, 2, 4)
    share = network.shares(ids)
    assert share.shape == (1, 19, 1, 2)
    assert share[0, 3, 0].tolist() == [0.75, 0.0]
    assert share[0, 7, 0].tolist() == [0.25, 0.0]
    assert share[0, 1, 0].tolist() == [0.0, 0.25]
    assert float(share.sum()) == pytest.approx(1.25)


def test_a_crop_is_refined_as_in_the_whole_image_away_from_its_border():
    """Training on a rectangle teaches what inference on the whole image does: the receptive field is local."""
    codec, refiner, latents, given = some(2, 48, 48)
    with torch.no_grad():
        refiner.leave.weight.normal_(0, 0.05, generator=torch.Generator().manual_seed(1))
        whole = refiner(codec, latents, given, 2)
        cells, pixels = slice(4, 24), slice(8, 48)
        part = refiner(codec, {m: z[..., cells, cells] for m, z in latents.items()}, given.crop(pixels, pixels), 2)
    assert torch.allclose(part.rgb[..., 14:40, 14:40], whole.rgb[..., 22:48, 22:48], atol=1e-4)
    assert not torch.allclose(part.rgb[..., :4, :4], whole.rgb[..., 8:12, 8:12], atol=1e-4)


def test_class_weights_are_taken_back():
    codec, refiner, latents, given = some()
    weights = torch.linspace(0.5, 3.0, 19)
    with torch.no_grad():
        before = refiner(codec, latents, given, 4)
        refiner.take_back(weights)
        after = refiner(codec, latents, given, 4)
    lost = before.scores - after.scores
    assert torch.allclose(lost, weights.log().view(1, -1, 1, 1).expand_as(lost), atol=1e-5)
    assert torch.equal(before.rgb, after.rgb)
    assert torch.equal(before.depth_code, after.depth_code)
