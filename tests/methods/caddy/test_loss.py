"""CADDY's training pass and its loss: which frames are generated from what, and where gradients go. T is 5, S is 2."""

from __future__ import annotations

from itertools import combinations

import pytest
import torch
from caddy_parts import clips, tiny, tiny_config

from playslot_rl.methods.caddy.action import divergence
from playslot_rl.methods.caddy.model import CADDY, Rollout
from playslot_rl.methods.caddy.stage import CADDYLoss, VGGFeatures

S, T = 2, 5


def run(
    model: CADDY, frames: torch.Tensor, wanted: list[int] | None = None, warmup: bool = False, seed: int = 0
) -> Rollout:
    rollout: Rollout = model(frames, S, 0.7, torch.Generator().manual_seed(seed), wanted, warmup)
    return rollout


def terms(
    model: CADDY, frames: torch.Tensor, wanted: list[int] | None = None, warmup: bool = False
) -> dict[str, float]:
    rollout = run(model, frames, wanted, warmup)
    return CADDYLoss(model.config)(rollout, frames, model.information, wanted)


@pytest.mark.parametrize("warmup", [True, False])
def test_gradients_reach_every_parameter_that_should_have_one(warmup: bool) -> None:
    model, frames = tiny().train(), clips()
    terms(model, frames, warmup=warmup)["loss"].backward()
    without = {name for name, p in model.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0}
    assert without == (set() if warmup else {"pretraining.weight", "pretraining.bias"})
    assert all(p.grad.isfinite().all() for p in model.parameters() if p.grad is not None)


def test_in_the_warm_up_the_generator_learns_from_reconstructions_alone_and_r_from_the_codes_alone() -> None:
    model, frames = tiny().train(), clips()
    parts = terms(model, frames, warmup=True)
    parts["loss_fit"].backward(retain_graph=True)
    assert all(p.grad is None for p in [*model.generator.parameters(), *model.pretraining.parameters()])
    assert all(p.grad is not None for p in model.dynamics.parameters())
    model.zero_grad()
    parts["loss_image"].backward()
    assert all(p.grad is None for p in [*model.dynamics.parameters(), *model.action.parameters()])
    assert all(p.grad is not None for p in [*model.generator.parameters(), *model.pretraining.parameters()])


def test_in_the_warm_up_every_state_that_r_is_given_is_true() -> None:
    model, frames = tiny().eval(), clips()
    given: list[torch.Tensor] = []
    handle = model.dynamics.register_forward_pre_hook(lambda _, args: given.append(args[0]))
    rollout = run(model, frames, warmup=True)
    handle.remove()
    assert torch.equal(torch.stack(given, dim=1), rollout.s[:, :-1])


def test_states_are_true_up_to_the_seed_and_then_of_the_generated_frames() -> None:
    model, frames = tiny().eval(), clips()
    given: list[torch.Tensor] = []
    handle = model.dynamics.register_forward_pre_hook(lambda _, args: given.append(args[0]))
    rollout = run(model, frames)
    handle.remove()
    assert torch.equal(torch.stack(given[:S], dim=1), rollout.s[:, :S])
    assert torch.equal(torch.stack(given[S:], dim=1), rollout.generated.s[:, S - 1 : T - 2])


def test_in_a_training_pass_too_a_true_frame_has_no_effect_on_earlier_times() -> None:
    model, frames, other = tiny().eval(), clips(), clips()
    other[:, 3] = clips(seed=1)[:, 3]
    first, second = run(model, frames).generated, run(model, other).generated
    assert torch.equal(first.frames[-1][:, :2], second.frames[-1][:, :2])
    assert not torch.equal(first.frames[-1][:, 2], second.frames[-1][:, 2])


def test_fewer_wanted_frames_change_the_wanted_ones_not_and_those_fed_back_are_generated() -> None:
    model, frames = tiny().eval(), clips()
    whole, part = run(model, frames).generated, run(model, frames, [1, 4]).generated
    assert whole.times == (1, 2, 3, 4)
    assert part.times == (1, 2, 3, 4), "times 2 and 3 are fed back"
    part = run(model, frames, [3]).generated
    assert part.times == (2, 3), "time 4 is neither wanted nor fed back"
    assert torch.equal(part.frames[-1], whole.frames[-1][:, 1:3])
    assert run(model, frames, [3], warmup=True).generated.times == (3,)


@pytest.mark.parametrize("warmup", [True, False])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_loss_of_drawn_frames_is_an_unbiased_estimate(count: int, warmup: bool) -> None:
    model, frames = tiny().eval(), clips()
    whole = terms(model, frames, warmup=warmup)
    parts = [terms(model, frames, [*some], warmup) for some in combinations(range(1, T), count)]
    for name in ("loss_image", "loss_state"):
        mean = torch.stack([part[name] for part in parts]).mean()
        torch.testing.assert_close(mean, whole[name], atol=1e-5, rtol=1e-4)
    assert len({part["loss_image"].item() for part in parts}) > 1


def test_actions_are_compared_where_two_consecutive_frames_were_generated() -> None:
    model, frames = tiny().eval(), clips()
    whole, part = run(model, frames), run(model, frames, [3])
    assert whole.real.shape == whole.again.shape == (3, 4, 3)
    assert torch.equal(whole.real, whole.moves.p)
    assert torch.equal(part.real, whole.moves.p[:, 2:3]), "between times 2 and 3"
    assert run(model, frames, [3], warmup=True).real.shape == (3, 0, 3)


def test_each_term_is_what_its_equation_says() -> None:
    changes = {"state_weight": 0.3, "kl_weight": 0.01, "information_weight": 0.5}
    model, frames = tiny(**changes).eval(), clips()
    rollout, got = run(model, frames), terms(model, frames)
    real = frames[:, 1:] * 2 - 1
    errors = []
    for level, pool in zip(rollout.generated.frames, (4, 2, 1), strict=True):
        size = 16 // pool
        coarse = real.reshape(3, 4, 3, size, pool, size, pool).mean(dim=(4, 6))
        errors.append((level - coarse).abs().mean())
    torch.testing.assert_close(got["loss_image"], sum(errors) / 3)
    state = (rollout.generated.s - rollout.s[:, 1:]).square().mean()
    torch.testing.assert_close(got["loss_state"], 0.3 * state)
    torch.testing.assert_close(got["loss_kl"], 0.01 * divergence(rollout.moves.direction).mean())
    torch.testing.assert_close(got["loss_information"], -0.5 * got["information"])
    assert got["loss"].item() == pytest.approx(sum(v.item() for k, v in got.items() if k.startswith("loss_")), rel=1e-5)
    assert "loss_perceptual" not in got
    assert "loss_fit" not in got


def test_in_the_warm_up_r_is_fitted_to_the_codes_of_the_next_frames() -> None:
    model, frames = tiny().eval(), clips()
    rollout, got = run(model, frames, warmup=True), terms(model, frames, warmup=True)
    codes = torch.stack([model.pretraining(rollout.s[:, t + 1]) for t in range(T - 1)], dim=1)
    torch.testing.assert_close(got["loss_fit"], (rollout.generated.y - codes).square().mean())


def test_the_states_of_real_frames_are_not_pulled_towards_those_of_generated_ones() -> None:
    model, frames = tiny().eval(), clips()
    rollout = run(model, frames)
    assert rollout.s.requires_grad
    own = rollout._replace(generated=rollout.generated._replace(s=rollout.generated.s.detach()))
    assert not CADDYLoss(model.config)(own, frames, model.information)["loss_state"].requires_grad


def test_the_training_pass_repeats_with_its_generator_and_not_with_another() -> None:
    model, frames = tiny().eval(), clips()
    before = torch.get_rng_state()
    first = run(model, frames).generated.frames[-1]
    assert torch.equal(run(model, frames).generated.frames[-1], first)
    assert not torch.equal(run(model, frames, seed=1).generated.frames[-1], first)
    assert torch.equal(torch.get_rng_state(), before)


def test_the_perceptual_term_is_there_where_the_network_is() -> None:
    model, frames = tiny(perceptual_weight=0.5).eval(), clips(batch=1)
    torch.manual_seed(0)
    network = VGGFeatures()
    loss = CADDYLoss(model.config, network)
    assert CADDYLoss(model.config).perceptual is None
    rollout = run(model, frames, [4])
    got = loss(rollout, frames, model.information, [4])
    real = frames[:, 4] * 2 - 1
    expected = [
        network.distance(level[:, -1], torch.nn.functional.avg_pool2d(real, pool))
        for level, pool in zip(rollout.generated.frames, (4, 2, 1), strict=True)
    ]
    torch.testing.assert_close(got["loss_perceptual"], 0.5 * sum(expected) / 3)


def test_the_config_is_that_of_the_tests() -> None:
    config = tiny_config()
    assert (config.seed_frames, config.seed_frames + config.predicted_frames) == (S, T)
