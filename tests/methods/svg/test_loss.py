"""SVG's objective: the divergence, where gradients go, the estimate from few decoded frames."""

from __future__ import annotations

from itertools import combinations

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal, kl_divergence

from playslot_rl.losses.common import draw_frames
from playslot_rl.methods.svg.model import SVG, Gaussian
from playslot_rl.methods.svg.training import gaussian_kl, svg_objective


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_gaussian(seed: int) -> Gaussian:
    return Gaussian(*(torch.randn(4, 5, 6, generator=generator(seed + i), dtype=torch.float64) for i in (0, 1)))


def test_the_divergence_is_that_of_torch() -> None:
    q, p = random_gaussian(0), random_gaussian(2)
    one, two = (Independent(Normal(g.mean, (0.5 * g.log_variance).exp()), 1) for g in (q, p))
    torch.testing.assert_close(gaussian_kl(q, p), kl_divergence(one, two))
    assert not torch.allclose(gaussian_kl(q, p), gaussian_kl(p, q))


def test_a_gaussian_has_no_divergence_from_itself() -> None:
    torch.testing.assert_close(
        gaussian_kl(random_gaussian(0), random_gaussian(0)), torch.zeros(4, 5, dtype=torch.float64)
    )


def test_samples_have_the_gaussians_moments() -> None:
    mean, log_variance = torch.tensor([-1.0, 2.0]), torch.tensor([-2.0, 1.0])
    drawn = Gaussian(mean.expand(50_000, 2), log_variance.expand(50_000, 2)).sample(generator())
    torch.testing.assert_close(drawn.mean(dim=0), mean, atol=0.03, rtol=0)
    torch.testing.assert_close(drawn.var(dim=0), log_variance.exp(), atol=0, rtol=0.05)


def test_the_loss_is_a_sum_over_steps_of_means_over_pixels_and_sums_over_latents(model: SVG, frames: Tensor) -> None:
    out = model(frames, 3, generator())
    terms = svg_objective(out, frames, kl_weight=0.1)
    image = sum((out.predicted[:, i] - frames[:, i + 1]).square().mean() for i in range(5))
    one, two = (Normal(g.mean, (0.5 * g.log_variance).exp()) for g in (out.posterior, out.prior))
    divergence = kl_divergence(one, two).sum(dim=(1, 2)).mean()
    torch.testing.assert_close(terms["loss_image"], image)
    torch.testing.assert_close(terms["loss_kl"], 0.1 * divergence)
    torch.testing.assert_close(terms["loss"], image + 0.1 * divergence)
    torch.testing.assert_close(terms["mse"] * 5, terms["loss_image"])
    torch.testing.assert_close(terms["kl"] * 5 * 0.1, terms["loss_kl"])


@pytest.mark.parametrize("decoded", [0, 2])
def test_gradients_reach_every_parameter(model: SVG, frames: Tensor, decoded: int) -> None:
    steps = draw_frames(2, 5, decoded, generator())
    svg_objective(model(frames, 3, generator(), steps), frames, kl_weight=1.0)["loss"].backward()
    without = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()]
    assert without == []


def test_the_prior_is_trained_by_the_divergence_alone(model: SVG, frames: Tensor) -> None:
    terms = svg_objective(model(frames, 3, generator()), frames, kl_weight=1.0)
    prior = list(model.prior.parameters())
    image = torch.autograd.grad(terms["loss_image"], prior, retain_graph=True, allow_unused=True)
    assert all(grad is None for grad in image)
    assert all(bool(grad.any()) for grad in torch.autograd.grad(terms["loss_kl"], prior))


def test_the_image_error_trains_the_posterior_through_the_latents(model: SVG, frames: Tensor) -> None:
    terms = svg_objective(model(frames, 3, generator()), frames, kl_weight=1.0)
    grads = torch.autograd.grad(terms["loss_image"], list(model.posterior.parameters()))
    assert all(bool(grad.any()) for grad in grads)


def test_the_loss_over_all_choices_of_decoded_steps_averages_to_the_full_one(model: SVG, frames: Tensor) -> None:
    with torch.no_grad():
        full = svg_objective(model(frames, 3, generator()), frames, 0.1)["loss"]
        choices = [torch.tensor(chosen).expand(2, -1) for chosen in combinations(range(5), 2)]
        parts = [svg_objective(model(frames, 3, generator(), steps), frames, 0.1)["loss"] for steps in choices]
    torch.testing.assert_close(torch.stack(parts).mean(), full)
    assert float(torch.stack(parts).std()) > 1e-4, "each of them is another estimate"


def test_the_average_over_many_draws_is_the_full_loss(model: SVG, frames: Tensor) -> None:
    with torch.no_grad():
        out = model(frames, 3, generator())
        full, numbers, parts = svg_objective(out, frames, 0.1)["loss"], generator(5), []
        clip = torch.arange(2)[:, None]
        for _ in range(2000):
            steps = draw_frames(2, 5, 2, numbers)
            assert steps is not None
            chosen = out._replace(predicted=out.predicted[clip, steps], steps=steps)
            parts.append(svg_objective(chosen, frames, 0.1)["loss"])
    drawn = torch.stack(parts)
    error = float(drawn.std()) / len(drawn) ** 0.5
    assert abs(float(drawn.mean() - full)) < 4 * error
    assert error < 0.01 * float(full), "precise enough to notice a wrong scale"


def test_every_step_of_every_clip_is_drawn_equally_often_and_at_most_once() -> None:
    numbers, counts = generator(), torch.zeros(3, 5)
    for _ in range(1000):
        steps = draw_frames(3, 5, 2, numbers)
        assert steps is not None
        counts += torch.zeros(3, 5).scatter_add_(1, steps, torch.ones(3, 2))
        assert bool((steps[:, 0] != steps[:, 1]).all())
    assert float((counts / 1000 - 0.4).abs().max()) < 0.08


@pytest.mark.parametrize("count", [0, 5, 6])
def test_all_steps_are_decoded_where_nothing_else_is_asked_for(count: int) -> None:
    assert draw_frames(3, 5, count, generator()) is None
