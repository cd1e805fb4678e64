"""Action prototypes: nearest code, gradients, loss, EMA update, revival, usage."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from playslot_rl.modules.quantizer import ActionQuantizer, usage

CODEBOOK = torch.tensor([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])


def quantizer(
    decay: float = 0.9, dead_threshold: float = 0.0, size: float = 10.0, beta: float = 0.25
) -> ActionQuantizer:
    """A quantiser with a known codebook, whose codes have all been hit `size` times."""
    model = ActionQuantizer(2, 3, decay=decay, dead_threshold=dead_threshold, commitment=beta)
    book = model.vq._codebook
    book.initted.fill_(True)
    book.embed.data.copy_(CODEBOOK[None])
    book.cluster_size.data.fill_(size)
    book.embed_avg.data.copy_(CODEBOOK[None] * size)
    return model


def near(code: int, n: int) -> Tensor:
    offsets = torch.randn(n, 2, generator=torch.Generator().manual_seed(code)) * 0.3
    return CODEBOOK[code] + offsets


def test_the_prototype_is_the_nearest_code() -> None:
    model = quantizer().eval()
    z = torch.tensor([[[1.0, 0.5], [3.0, 1.0]], [[0.5, 3.0], [-9.0, -9.0]]])
    p, code, _ = model(z)
    assert code.tolist() == [[0, 1], [2, 0]]
    torch.testing.assert_close(p, CODEBOOK[code])
    torch.testing.assert_close(model.prototypes, CODEBOOK)


@pytest.mark.parametrize("training", [True, False])
def test_the_gradient_goes_straight_through(training: bool) -> None:
    model = quantizer().train(training)
    z = near(1, 5).requires_grad_()
    p, _, _ = model(z)
    weights = torch.randn(5, 2)
    (p * weights).sum().backward()
    torch.testing.assert_close(z.grad, weights)


@pytest.mark.parametrize("beta", [0.25, 1.5])
def test_the_loss_is_the_weighted_commitment_and_pulls_z_to_its_code(beta: float) -> None:
    model = quantizer(beta=beta)
    z = near(2, 6).requires_grad_()
    _, code, loss = model(z)
    error = z.detach() - CODEBOOK[code]
    torch.testing.assert_close(loss.detach(), beta * error.square().mean())
    loss.backward()
    torch.testing.assert_close(z.grad, beta * 2 * error / error.numel())


def test_the_codebook_follows_the_moving_average_of_its_latents() -> None:
    decay, size = 0.9, 10.0
    model = quantizer(decay, size=size).train()
    z = torch.cat((near(0, 3), near(1, 7)))
    model(z)
    hits = torch.tensor([3.0, 7.0, 0.0])
    sums = torch.stack((z[:3].sum(0), z[3:].sum(0), torch.zeros(2)))
    counts = decay * size + (1 - decay) * hits
    expected = (decay * size * CODEBOOK + (1 - decay) * sums) / counts[:, None]
    torch.testing.assert_close(model.prototypes, expected, rtol=1e-4, atol=1e-4)
    assert not torch.allclose(model.prototypes[:2], CODEBOOK[:2], atol=1e-3)
    torch.testing.assert_close(model.prototypes[2], CODEBOOK[2], rtol=1e-4, atol=1e-4)  # unused: it stays, not shrinks


def test_evaluation_leaves_the_codebook_alone() -> None:
    model = quantizer(dead_threshold=1.0).eval()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    model(near(0, 20))
    assert all(torch.equal(before[name], value) for name, value in model.state_dict().items())


def test_the_codebook_has_no_gradient() -> None:
    assert list(quantizer().parameters()) == []


def test_a_dead_code_is_revived_as_a_latent_of_the_batch() -> None:
    torch.manual_seed(0)
    model = quantizer(decay=0.9, dead_threshold=1.0, size=1.05).train()
    for buffer in (model.vq._codebook.cluster_size, model.vq._codebook.embed_avg):
        buffer.data[0, :2] *= 50.0  # the other two are well used
    z = torch.cat((near(0, 4), near(1, 4)))
    model(z)  # code 2 falls to 0.945 hits
    distance = (z - model.prototypes[2]).norm(dim=1).min()
    assert distance < 1e-5, "the dead code has not moved onto a latent"
    assert (model.prototypes[:2] - CODEBOOK[:2]).norm(dim=1).max() < 0.5, "living codes must not jump"


@pytest.mark.parametrize(("dead_threshold", "fraction"), [(0.5, 1.0), (0.0, 1 / 3)])
def test_codes_far_from_all_latents_come_into_use_by_revival_only(dead_threshold: float, fraction: float) -> None:
    torch.manual_seed(1)
    model = quantizer(dead_threshold=dead_threshold, size=1.0).train()
    for buffer in (model.vq._codebook.embed, model.vq._codebook.embed_avg):
        buffer.data[0, 1:] += 100.0
    z = torch.cat([near(code, 10) for code in range(3)])
    for _ in range(12):
        model(z)
    _, code, _ = model.eval()(z)
    assert usage(code, 3)[0].item() == pytest.approx(fraction)


@pytest.mark.parametrize(
    ("code", "fraction", "perplexity"),
    [([0, 1, 2, 3], 1.0, 4.0), ([2, 2, 2], 0.25, 1.0), ([0, 0, 1], 0.5, math.exp(math.log(3) - math.log(4) / 3))],
)
def test_usage_and_perplexity(code: list[int], fraction: float, perplexity: float) -> None:
    used, got = usage(torch.tensor(code), 4)
    assert used.item() == pytest.approx(fraction)
    assert got.item() == pytest.approx(perplexity, rel=1e-5)
