"""InvDyn: the latent's distribution, the four modes, invariance, and the gradients of p and v."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import pytest
import torch

from playslot_rl.config import InverseDynamicsConfig, LatentMode
from playslot_rl.errors import ConfigError
from playslot_rl.modules.inverse_dynamics import InverseDynamics
from playslot_rl.testing import tiny_config
from playslot_rl.world_model import WorldModel

D, Z, A = 12, 6, 4
SMALL = InverseDynamicsConfig(latent_dim=Z, n_prototypes=5, dim=16, layers=2, heads=2, head_dim=8, mlp_dim=32)


def model(
    mode: LatentMode = "hybrid", variant: Literal["single", "multi"] = "single", sample: bool = False
) -> InverseDynamics:
    torch.manual_seed(0)
    made = InverseDynamics(replace(SMALL, mode=mode, variant=variant, sample=sample), D, A)
    if made.n_prototypes:
        made.eval().split(torch.randn(64, Z))  # sets the codebook, which the first latents do otherwise
    return made.train()


def clip(b: int = 2, t: int = 5, n: int = 3) -> torch.Tensor:
    return torch.randn(b, t, n, D, generator=torch.Generator().manual_seed(1))


def noise() -> torch.Generator:
    return torch.Generator().manual_seed(2)


def test_invdyn_s_does_not_depend_on_the_order_of_the_slots() -> None:
    invdyn, order = model().eval(), torch.tensor([2, 0, 1])
    out, permuted = invdyn(clip()), invdyn(clip()[:, :, order])
    torch.testing.assert_close(permuted.z, out.z)
    torch.testing.assert_close(permuted.prototype, out.prototype)
    assert torch.equal(permuted.code, out.code)


def test_what_moves_in_slots_that_are_not_chosen_is_no_action() -> None:
    torch.manual_seed(0)
    invdyn = InverseDynamics(replace(SMALL, slots=(1, 3)), D, A).eval()
    slots = clip()
    expected, moved = invdyn(slots).mean, slots.clone()
    moved[:, :, 1] = torch.randn(2, 5, D)
    torch.testing.assert_close(invdyn(moved).mean, expected)
    for chosen in (0, 2):
        moved = slots.clone()
        moved[:, :, chosen] = torch.randn(2, 5, D)
        assert not torch.allclose(invdyn(moved).mean, expected, atol=1e-4)
    torch.testing.assert_close(invdyn(slots[:, :, [2, 1, 0]]).mean, expected)


@pytest.mark.parametrize(
    ("slots", "variant", "said"),
    [
        ((1, 1), "single", "expected each slot once"),
        ((0, 1), "single", "expected numbers of slots from 1 on"),
        ((1,), "multi", "expected none with variant=multi"),
    ],
)
def test_numbers_of_slots_that_say_nothing_are_refused(
    slots: tuple[int, ...], variant: Literal["single", "multi"], said: str
) -> None:
    with pytest.raises(ValueError, match=f"model.inverse_dynamics.slots: got .*{said}"):
        replace(SMALL, slots=slots, variant=variant)


@pytest.mark.parametrize(
    ("slots", "initial", "said"),
    [((5,), "learned", "got 5, expected at most the 4 slots"), ((1,), "gaussian", "change places from episode")],
)
def test_slots_that_a_world_model_has_not_are_refused(
    slots: tuple[int, ...], initial: Literal["gaussian", "learned"], said: str
) -> None:
    config = tiny_config()
    model = config.model
    sizes = replace(
        model,
        savi=replace(model.savi, initial=initial),
        inverse_dynamics=replace(model.inverse_dynamics, slots=slots),
    )
    with pytest.raises(ConfigError, match=said):
        WorldModel(sizes, config.env)


def test_invdyn_m_gives_each_slot_its_own_latent_and_permutes_with_them() -> None:
    invdyn, order = model(variant="multi").eval(), torch.tensor([2, 0, 1])
    out, permuted = invdyn(clip()), invdyn(clip()[:, :, order])
    assert out.z.shape == (2, 4, 3, Z)
    assert out.code.shape == (2, 4, 3)
    torch.testing.assert_close(permuted.z, out.z[:, :, order])
    other = clip()
    other[:, :, 0] += 1.0
    torch.testing.assert_close(invdyn(other).z[:, :, 1:], out.z[:, :, 1:])


@pytest.mark.parametrize("variant", ["single", "multi"])
def test_the_mean_is_the_difference_of_neighbouring_frames(variant: Literal["single", "multi"]) -> None:
    invdyn = model(variant=variant).eval()
    slots = clip()
    mu, _ = invdyn.scene_dynamics(slots)
    out = invdyn(slots)
    torch.testing.assert_close(out.mean, mu[:, 1:] - mu[:, :-1])
    assert torch.equal(out.z, out.mean)
    still = slots[:, :1].expand(-1, 5, -1, -1)
    torch.testing.assert_close(invdyn(still).mean, torch.zeros_like(out.mean))


def test_training_samples_z_with_the_sum_of_both_frames_variances() -> None:
    invdyn = model("continuous")
    with torch.no_grad():
        invdyn.to_variance.bias.fill_(0.5)
        slots = clip(1, 3).expand(20_000, -1, -1, -1)
        # One batch row is enough for the networks: the samples differ by their noise alone.
        mu, var = (x.expand(20_000, -1, -1) for x in invdyn.scene_dynamics(slots[:1]))
        invdyn.scene_dynamics = lambda _: (mu, var)  # type: ignore[method-assign]
        out = invdyn(slots, generator=noise())
    expected = var[0, 1:] + var[0, :-1]
    torch.testing.assert_close(out.z.var(dim=0), expected, rtol=0.05, atol=0)
    torch.testing.assert_close(out.z.mean(dim=0), out.mean[0], rtol=0, atol=0.05)


def test_the_variance_is_positive() -> None:
    invdyn = model()
    with torch.no_grad():
        invdyn.to_variance.bias.fill_(-1e4)
        assert (invdyn.scene_dynamics(clip())[1] > 0).all()


def test_a_seeded_generator_repeats_the_sample() -> None:
    invdyn = model("continuous")
    first, second = invdyn(clip(), generator=noise()).z, invdyn(clip(), generator=noise()).z
    assert torch.equal(first, second)
    assert not torch.equal(first, invdyn(clip(), generator=torch.Generator().manual_seed(9)).z)


@pytest.mark.parametrize("sample", [False, True])
def test_evaluation_uses_the_mean_unless_told_to_sample(sample: bool) -> None:
    out = model(sample=sample).eval()(clip(), generator=noise())
    assert torch.equal(out.z, out.mean) is not sample


def test_hybrid_splits_z_into_prototype_and_variability() -> None:
    out = model("hybrid").eval()(clip())
    torch.testing.assert_close(out.prototype + out.variability, out.z)
    assert out.variability.any()
    assert model("hybrid")(clip()).vq_loss > 0


def test_hybrid_takes_its_prototypes_from_the_codebook() -> None:
    invdyn = model("hybrid").eval()
    out = invdyn(clip())
    torch.testing.assert_close(out.prototype, invdyn.prototypes[out.code])
    distance = torch.cdist(out.z.reshape(-1, Z), invdyn.prototypes)
    assert torch.equal(distance.argmin(dim=1), out.code.flatten())


def test_discrete_passes_the_prototype_alone() -> None:
    invdyn = model("discrete").eval()
    out = invdyn(clip())
    assert not out.variability.any()
    torch.testing.assert_close(out.prototype, invdyn.prototypes[out.code])
    assert model("discrete")(clip()).vq_loss > 0


def test_continuous_passes_z_without_a_codebook() -> None:
    invdyn = model("continuous").eval()
    out = invdyn(clip())
    assert torch.equal(out.variability, out.z)
    assert not out.prototype.any()
    assert out.vq_loss == 0
    assert invdyn.n_prototypes == 0
    with pytest.raises(ValueError, match="mode continuous has no prototypes"):
        _ = invdyn.prototypes


def test_ground_truth_passes_the_real_actions_and_learns_nothing() -> None:
    invdyn, actions = model("ground_truth"), torch.randn(2, 4, A)
    out = invdyn(clip(), actions)
    assert torch.equal(out.z, actions)
    assert torch.equal(out.variability, actions)
    assert not out.prototype.any()
    assert invdyn.latent_dim == A
    assert list(invdyn.parameters()) == []
    with pytest.raises(ValueError, match="mode ground_truth: got no actions"):
        invdyn(clip())


def test_ground_truth_actions_are_not_per_slot() -> None:
    with pytest.raises(ValueError, match="use variant=single"):
        model("ground_truth", variant="multi")


@pytest.mark.parametrize("part", ["prototype", "variability", "sum"])
def test_gradients_of_p_and_v_with_respect_to_z_are_the_identity(part: str) -> None:
    """dp/dz = I (straight through), dv/dz = I (v = z - sg[p]), so d(p + v)/dz = 2 I."""
    invdyn = model("hybrid").eval()
    z, weights = torch.randn(7, Z).requires_grad_(), torch.randn(7, Z)
    p, v = invdyn.split(z)
    chosen, factor = {"prototype": (p, 1.0), "variability": (v, 1.0), "sum": (p + v, 2.0)}[part]
    (chosen * weights).sum().backward()
    torch.testing.assert_close(z.grad, factor * weights)


def test_in_discrete_mode_the_gradient_comes_through_p_alone() -> None:
    z, weights = torch.randn(7, Z).requires_grad_(), torch.randn(7, Z)
    p, v = model("discrete").eval().split(z)
    ((p + v) * weights).sum().backward()
    torch.testing.assert_close(z.grad, weights)


@pytest.mark.parametrize("mode", ["hybrid", "discrete", "continuous"])
@pytest.mark.parametrize("variant", ["single", "multi"])
def test_gradients_reach_every_parameter(mode: LatentMode, variant: Literal["single", "multi"]) -> None:
    invdyn = model(mode, variant)
    out = invdyn(clip(), generator=noise())
    ((out.prototype + out.variability) * torch.randn_like(out.z)).sum().backward()
    # A bias common to both frames cancels in mu_{t+1} - mu_t.
    silent = {n for n, p in invdyn.named_parameters() if p.grad is None or p.grad.abs().max() < 1e-7}
    assert silent <= {"to_mean.bias"}


@pytest.mark.parametrize("mode", ["hybrid", "discrete", "continuous"])
def test_split_gives_what_inference_gave(mode: LatentMode) -> None:
    invdyn = model(mode).eval()
    out = invdyn(clip())
    p, v = invdyn.split(out.z)
    torch.testing.assert_close(p, out.prototype)
    torch.testing.assert_close(v, out.variability)
