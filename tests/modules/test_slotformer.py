"""Predictors without control: SlotFormer, and OCVP-Seq without an action token."""

from __future__ import annotations

from typing import Literal

import pytest
import torch
from torch import Tensor

from playslot_rl.config import InverseDynamicsConfig, PredictorConfig
from playslot_rl.errors import ConfigError
from playslot_rl.modules.inverse_dynamics import InverseDynamics
from playslot_rl.modules.predictors import AutoregressivePredictor, OCVPSeq, SlotFormer, build_predictor

B, N, D = 2, 3, 10
Kind = Literal["slotformer", "ocvp_seq"]
KINDS: tuple[Kind, ...] = ("slotformer", "ocvp_seq")


def predictor(
    kind: Kind = "slotformer", context: int = 4, residual: bool = False
) -> SlotFormer | AutoregressivePredictor:
    torch.manual_seed(0)
    config = PredictorConfig(
        kind=kind, dim=16, layers=2, heads=2, head_dim=8, mlp_dim=24, context=context, residual=residual
    )
    model = build_predictor(config, D, 0).double()
    torch.nn.init.normal_(model.head.weight, std=0.3)
    return model


def clip(steps: int) -> Tensor:
    return torch.randn(B, steps, N, D, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


def nothing(steps: int) -> Tensor:
    return torch.zeros(B, steps, 0, dtype=torch.float64)


def parameters(kind: Kind, mlp_dim: int, project_out: bool, dim: int = 256, heads: int = 8) -> int:
    config = PredictorConfig(
        kind=kind, dim=dim, layers=4, heads=heads, head_dim=dim // heads, mlp_dim=mlp_dim, project_out=project_out
    )
    return sum(p.numel() for p in build_predictor(config, 128, 0).parameters())


def test_slotformer_has_as_many_parameters_as_the_paper_says() -> None:
    assert parameters("slotformer", 1024, project_out=False) == 2_958_720


def test_ocvp_seq_has_those_of_its_eight_blocks_and_a_final_norm() -> None:
    assert parameters("ocvp_seq", 512, project_out=False) == 3_750_272 + 2 * 256


@pytest.mark.parametrize("kind", KINDS)
def test_predictions_permute_with_the_slots(kind: Kind) -> None:
    model, slots, order = predictor(kind), clip(4), torch.tensor([2, 0, 1])
    torch.testing.assert_close(model(slots[:, :, order], nothing(4)), model(slots, nothing(4))[:, :, order])


@pytest.mark.parametrize("kind", KINDS)
def test_a_prediction_sees_no_later_frame(kind: Kind) -> None:
    model, slots = predictor(kind), clip(4)
    expected = model(slots, nothing(4))
    for t in range(1, 4):
        changed = slots.clone()
        changed[:, t] += 1.0
        got = model(changed, nothing(4))
        torch.testing.assert_close(got[:, :t], expected[:, :t], rtol=0, atol=0)
        assert not torch.allclose(got[:, t:], expected[:, t:])


def test_slotformer_sees_the_frames_of_its_window_and_none_before() -> None:
    model, slots = predictor(context=3), clip(6)
    expected = model(slots, nothing(6))[:, -1]
    for t in range(6):
        changed = slots.clone()
        changed[:, t] += 1.0
        moved = (model(changed, nothing(6))[:, -1] - expected).abs().max()
        assert (moved > 1e-6) == (t >= 3), t


def test_a_window_means_the_same_wherever_it_ends() -> None:
    model, slots = predictor(context=3), clip(6)
    whole = model(slots, nothing(6))
    for t in range(2, 6):
        torch.testing.assert_close(model(slots[:, t - 2 : t + 1], nothing(3))[:, -1], whole[:, t])


def test_the_order_of_the_frames_counts() -> None:
    model, slots = predictor(), clip(3)
    swapped = slots[:, [1, 0, 2]]
    assert not torch.allclose(model(slots, nothing(3))[:, -1], model(swapped, nothing(3))[:, -1])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("seed", "steps"), [(1, 3), (2, 7), (4, 9)])
def test_the_rollout_feeds_predictions_back(kind: Kind, seed: int, steps: int) -> None:
    model, slots = predictor(kind), clip(seed)
    out = model.rollout(slots, nothing(steps))
    assert out.shape == (B, steps, N, D)
    frames = torch.cat((slots, out[:, seed - 1 :]), dim=1)
    for t in range(seed - 1, steps):
        window = frames[:, max(0, t + 1 - 4) : t + 1]
        torch.testing.assert_close(out[:, t], model(window, nothing(window.shape[1]))[:, -1])


@pytest.mark.parametrize("kind", KINDS)
def test_left_padding_changes_nothing(kind: Kind) -> None:
    model, slots = predictor(kind, context=8), clip(4)
    padded = torch.cat((torch.full((B, 3, N, D), 1e3, dtype=torch.float64), slots), dim=1)
    valid = torch.arange(7).expand(B, -1) >= 3
    got = model(padded, nothing(7), valid=valid)
    assert torch.isfinite(got).all()
    torch.testing.assert_close(got[:, 3:], model(slots, nothing(4)))


@pytest.mark.parametrize("kind", KINDS)
def test_a_residual_model_starts_as_nothing_moves(kind: Kind) -> None:
    config = PredictorConfig(kind=kind, dim=16, layers=1, heads=2, head_dim=8, mlp_dim=16, residual=True)
    slots = torch.randn(B, 3, N, D)
    torch.testing.assert_close(build_predictor(config, D, 0)(slots, torch.zeros(B, 3, 0)), slots)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_reach_every_parameter_through_a_rollout(kind: Kind) -> None:
    model = predictor(kind)
    model.rollout(clip(2), nothing(5)).square().sum().backward()
    assert [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_without_actions_there_is_no_token_for_them() -> None:
    model = predictor("ocvp_seq")
    assert isinstance(model, OCVPSeq)
    assert model.embed_action is None
    assert not any("action" in name for name, _ in model.named_parameters())


def test_nothing_inferred_has_width_zero_and_no_parameters() -> None:
    model = InverseDynamics(InverseDynamicsConfig(mode="none"), D, action_dim=4)
    assert model.latent_dim == 0
    assert list(model.parameters()) == []
    latent = model(torch.randn(B, 5, N, D))
    assert latent.z.shape == latent.prototype.shape == latent.variability.shape == (B, 4, 0)
    assert latent.vq_loss == 0
    assert model.split(latent.z)[1].shape == (B, 4, 0)


@pytest.mark.parametrize(
    ("kind", "width", "message"),
    [("slotformer", 4, r"inverse_dynamics\.mode: .* slotformer, which takes no latent actions, expected none"),
     ("cocvp", 0, r"predictor\.kind: .* cocvp, which takes latent actions, expected slotformer or ocvp_seq")],
)  # fmt: skip
def test_control_and_a_predictor_that_cannot_be_controlled_do_not_go_together(
    kind: Literal["slotformer", "cocvp"], width: int, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        build_predictor(PredictorConfig(kind=kind), D, width)


@pytest.mark.parametrize(("seed", "steps"), [(0, 3), (4, 3)])
def test_a_rollout_needs_a_seed_within_its_frames(seed: int, steps: int) -> None:
    with pytest.raises(ValueError, match="seed frames"):
        predictor().rollout(clip(max(seed, 1))[:, :seed], nothing(steps))


def test_heads_without_an_output_projection_have_to_fit() -> None:
    with pytest.raises(ValueError, match=r"head_dim: got 64, expected dim / heads"):
        PredictorConfig(project_out=False)
