"""Sizes, skip maps and BatchNorm of SVG's convolutions."""

from __future__ import annotations

import re

import pytest
import torch
from torch import nn

from playslot_rl.methods.svg.method import SVGConfig
from playslot_rl.methods.svg.model import SVG, Decoder, Encoder

COMPACT = SVGConfig(channels=(16, 32, 64, 128), convs=(1, 1, 1, 1), features=64, latent_dim=16, hidden=128)


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_parts_have_the_original_number_of_parameters() -> None:
    with torch.device("meta"):
        model = SVG(SVGConfig(), 64)
    counts = [count(part) for part in (model.encoder, model.decoder, model.predictor, model.posterior, model.prior)]
    assert counts == [8_689_600, 11_822_659, 1_134_976, 592_256, 592_256]


@pytest.mark.parametrize(
    ("config", "total"), [(SVGConfig(), 22_831_747), (SVGConfig(latent_dim=10), 22_762_411), (COMPACT, 1_131_507)]
)
def test_the_whole_has_the_known_number_of_parameters(config: SVGConfig, total: int) -> None:
    with torch.device("meta"):
        assert count(SVG(config, 64)) == total


def test_four_skip_maps_go_from_the_full_resolution_to_twice_the_bottom() -> None:
    encoded = Encoder((2, 3, 4, 5), (1, 1, 1, 1), 6)(torch.rand(2, 3, 64, 64))
    assert encoded.code.shape == (2, 6)
    assert [tuple(skip.shape[1:]) for skip in encoded.skips] == [(2, 64, 64), (3, 32, 32), (4, 16, 16), (5, 8, 8)]


@pytest.mark.parametrize("levels", [2, 3, 5])
def test_other_numbers_of_levels_come_back_to_their_resolution(levels: int) -> None:
    sizes = tuple(range(2, 2 + levels)), (1,) * (levels - 1) + (3,), 4
    size = 4 * 2**levels
    encoded = Encoder(*sizes)(torch.rand(2, 3, size, size))
    frames = Decoder(*sizes)(encoded.code, encoded.skips)
    assert frames.shape == (2, 3, size, size)
    assert frames.min() > 0
    assert frames.max() < 1


@pytest.mark.parametrize("size", [32, 48, 60, 128])
def test_an_image_size_that_does_not_end_in_four_pixels_is_refused(size: int) -> None:
    with pytest.raises(ValueError, match=f"image_size: got {size}, expected 64"):
        SVG(COMPACT, size)


def test_frames_of_another_size_are_refused(model: SVG) -> None:
    with pytest.raises(ValueError, match="image_size: got 32, expected 16"):
        model.predict(torch.rand(1, 4, 3, 16, 32), 2)


def test_weights_start_small_and_normally_distributed() -> None:
    torch.manual_seed(0)
    for module in SVG(COMPACT, 64).modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d | nn.Linear):
            spread = float(module.weight.detach().std())
            assert spread == pytest.approx(0.02, rel=5 / module.weight.numel() ** 0.5), re.sub(r"\s+", " ", str(module))
            assert module.bias is not None
            assert not module.bias.any()


def test_a_prediction_does_not_depend_on_the_rest_of_the_batch_in_evaluation_mode(
    model: SVG, frames: torch.Tensor
) -> None:
    torch.testing.assert_close(model.predict(frames[:1], 3), model.predict(frames, 3)[:1])
    generator = torch.Generator
    whole, alone = (model.train()(f, 3, generator().manual_seed(0)) for f in (frames, frames[:1]))
    assert not torch.allclose(whole.predicted[:1], alone.predicted), "training mode takes the batch's statistics"


def test_the_running_statistics_become_those_of_the_frames_of_all_steps() -> None:
    torch.manual_seed(0)
    sizes = (4, 8), (1, 1), 6
    encoder, frames = Encoder(*sizes), torch.rand(6, 3, 16, 16) * torch.linspace(0.1, 1, 6)[:, None, None, None]
    first = encoder.levels[0]
    assert isinstance(first, nn.Sequential)
    norm = first[1]
    assert isinstance(norm, nn.BatchNorm2d)
    with torch.no_grad():
        for _ in range(150):
            trained = encoder(frames).code
        seen = first[0](frames)
        evaluated = encoder.eval()(frames).code
    torch.testing.assert_close(norm.running_mean, seen.mean(dim=(0, 2, 3)), atol=1e-4, rtol=0)
    torch.testing.assert_close(evaluated, trained, atol=0.15, rtol=0)
