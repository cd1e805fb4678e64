"""CADDY's actions: the distribution of a direction, the samples of an action, centroids and variability."""

from __future__ import annotations

import pytest
import torch
from caddy_parts import clips, tiny
from torch.distributions import Normal, kl_divergence

from playslot_rl.methods.caddy.action import (
    VARIANCE,
    ActionNetwork,
    Gaussian,
    chosen,
    difference,
    divergence,
    gumbel_softmax,
)
from playslot_rl.methods.caddy.model import CADDY


@pytest.fixture
def network() -> ActionNetwork:
    torch.manual_seed(0)
    network = ActionNetwork(4, 8, 3, 5, decay=0.9)
    network.centroids.normal_()
    return network


def poses() -> tuple[Gaussian, Gaussian]:
    numbers = torch.Generator().manual_seed(0)
    mean, var = torch.randn(2, 4, 3, generator=numbers), torch.rand(2, 4, 3, generator=numbers)
    return Gaussian(mean[0], var[0]), Gaussian(mean[1], var[1])


def test_the_direction_is_distributed_as_the_difference_of_two_normals() -> None:
    first, second = poses()
    direction = difference(first, second)
    numbers = torch.Generator().manual_seed(1)
    noise = torch.randn(2, 40_000, 4, 3, generator=numbers)
    samples = second.mean + second.var.sqrt() * noise[0] - first.mean - first.var.sqrt() * noise[1]
    torch.testing.assert_close(samples.mean(0), direction.mean, atol=0.03, rtol=0)
    torch.testing.assert_close(samples.var(0), direction.var, atol=0.05, rtol=0)


def test_the_divergence_is_that_of_torchs_distributions() -> None:
    direction = difference(*poses())
    expected = kl_divergence(Normal(direction.mean, direction.var.sqrt()), Normal(0.0, 1.0)).sum(dim=-1)
    torch.testing.assert_close(divergence(direction), expected)
    assert divergence(Gaussian(torch.zeros(4, 3), torch.ones(4, 3))).abs().max() == 0


def test_a_variance_of_zero_has_a_finite_divergence_and_gradient() -> None:
    nothing = torch.zeros(2, 3, requires_grad=True)
    direction = difference(Gaussian(nothing, nothing), Gaussian(nothing, nothing))
    assert (direction.var == VARIANCE).all()
    (divergence(direction).sum() + direction.var.sqrt().sum()).backward()
    assert nothing.grad is not None
    assert nothing.grad.isfinite().all()


def test_a_drawn_direction_follows_its_distribution(network: ActionNetwork) -> None:
    first, second = (Gaussian(m.expand(20_000, 4, 3), v.expand(20_000, 4, 3)) for m, v in poses())
    moves = network.moves(first, second, torch.Generator().manual_seed(0))
    standard = (moves.d - moves.direction.mean) / moves.direction.var.sqrt()
    torch.testing.assert_close(standard.mean(0), torch.zeros(4, 3), atol=0.03, rtol=0)
    torch.testing.assert_close(standard.std(0), torch.ones(4, 3), atol=0.03, rtol=0)


def test_nothing_is_drawn_without_a_generator(network: ActionNetwork) -> None:
    first, second = poses()
    before = torch.get_rng_state()
    moves = network.moves(first, second)
    assert torch.equal(moves.d, second.mean - first.mean)
    network.moves(first, second, torch.Generator().manual_seed(0))
    assert torch.equal(torch.get_rng_state(), before), "the global generator is never used"


def test_gumbel_samples_choose_each_action_as_often_as_it_is_probable() -> None:
    logits = torch.tensor([2.0, 0.0, 1.0])
    samples = gumbel_softmax(logits.expand(40_000, 3), 0.3, torch.Generator().manual_seed(0))
    torch.testing.assert_close(samples.sum(dim=-1), torch.ones(40_000))
    frequency = torch.bincount(samples.argmax(dim=-1), minlength=3) / 40_000
    torch.testing.assert_close(frequency, logits.softmax(dim=-1), atol=0.01, rtol=0)


def test_a_lower_temperature_makes_samples_harder() -> None:
    means = []
    for temperature in (1.0, 0.4, 0.05):
        samples = gumbel_softmax(torch.zeros(2000, 4), temperature, torch.Generator().manual_seed(0))
        means.append(float(samples.max(dim=-1).values.mean()))
    assert means == sorted(means)
    assert means[-1] > 0.97


def test_chosen_is_the_most_probable_action() -> None:
    p = torch.tensor([[0.2, 0.5, 0.3], [0.6, 0.3, 0.1]])
    assert torch.equal(chosen(p), torch.tensor([[0.0, 1, 0], [1, 0, 0]]))


def test_centroids_move_to_the_means_of_the_directions_weighted_by_p(network: ActionNetwork) -> None:
    p, d = torch.rand(6, 4, 5).softmax(dim=-1), torch.randn(6, 4, 3)
    before = network.centroids.clone()
    network.update_centroids(p, d)
    means = torch.stack([(p[..., k, None] * d).sum(dim=(0, 1)) / p[..., k].sum() for k in range(5)])
    torch.testing.assert_close(network.centroids, 0.9 * before + 0.1 * means)
    for _ in range(300):
        network.update_centroids(p, d)
    torch.testing.assert_close(network.centroids, means)


def test_an_action_that_is_never_used_does_not_spoil_its_centroid(network: ActionNetwork) -> None:
    p = torch.zeros(6, 5)
    p[:, 0] = 1
    network.update_centroids(p, torch.randn(6, 3))
    assert network.centroids.isfinite().all()


def test_centroids_have_no_gradient_and_move_in_training_mode_only() -> None:
    model = tiny()
    assert "action.centroids" not in dict(model.named_parameters())
    assert "action.centroids" in model.state_dict()
    before = model.action.centroids.clone()
    model.eval()(clips(), 2, 1.0, torch.Generator().manual_seed(0))
    model.infer(clips())
    model.predict(clips(), 2)
    assert torch.equal(model.action.centroids, before)
    model.train().predict(clips(), 2)
    assert torch.equal(model.action.centroids, before), "a prediction is one in evaluation mode"
    model(clips(), 2, 1.0, torch.Generator().manual_seed(0))
    assert not torch.equal(model.action.centroids, before)
    assert not model.action.centroids.requires_grad


def test_the_variability_is_zero_where_the_direction_is_the_chosen_centroid(network: ActionNetwork) -> None:
    a = torch.eye(5)
    assert torch.equal(network.variability(a, network.centroids), torch.zeros(5, 3))
    d = torch.randn(5, 3)
    torch.testing.assert_close(network.variability(a, d), d - network.centroids)


def test_the_variability_of_a_soft_action_is_the_weighted_mean_of_the_offsets(network: ActionNetwork) -> None:
    a, d = torch.rand(7, 5).softmax(dim=-1), torch.randn(7, 3)
    offsets = d[:, None] - network.centroids
    torch.testing.assert_close(network.variability(a, d), (a[..., None] * offsets).sum(dim=1))


def test_latents_at_test_are_the_mean_direction_and_a_one_hot_action(model: CADDY) -> None:
    latents = model.infer(clips())
    assert torch.equal(latents.a, chosen(latents.p))
    d = latents.v + latents.a @ model.action.centroids
    means = [model.action.pose(model._encode(clips()[:, t : t + 1] * 2 - 1)[1]).mean[:, 0] for t in range(5)]
    for t in range(4):
        torch.testing.assert_close(d[:, t], means[t + 1] - means[t], atol=1e-4, rtol=1e-4)


def test_a_still_scene_has_the_mean_direction_zero(model: CADDY) -> None:
    latents = model.infer(clips(frames=1).expand(-1, 4, -1, -1, -1))
    d = latents.v + latents.a @ model.action.centroids
    torch.testing.assert_close(d, torch.zeros_like(d), atol=1e-4, rtol=0)
