"""Both predictors: causality, equivariance, and the cached rollout, which is the full one."""

from __future__ import annotations

from typing import Literal

import pytest
import torch
from torch import Tensor

from playslot_rl.config import PredictorConfig
from playslot_rl.errors import ConfigError
from playslot_rl.modules.predictors import COCVP, AutoregressivePredictor, OCVPSeq, build_predictor
from playslot_rl.modules.transformer import TransformerBlock, sinusoidal_code

B, T, N, D, Z = 2, 6, 3, 10, 4
Kind = Literal["cocvp", "ocvp_seq"]
KINDS: tuple[Kind, ...] = ("cocvp", "ocvp_seq")


def predictor(kind: Kind = "cocvp", context: int = 8, residual: bool = False) -> AutoregressivePredictor:
    torch.manual_seed(0)
    config = PredictorConfig(
        kind=kind, dim=16, layers=2, heads=2, head_dim=6, mlp_dim=24, context=context, residual=residual
    )
    model = build_predictor(config, D, Z).double()
    torch.nn.init.normal_(model.head.weight, std=0.3)  # a residual model starts at zero and would show nothing
    return model


def cocvp() -> COCVP:
    model = predictor()
    assert isinstance(model, COCVP)
    return model


def clip(steps: int = T, per_slot: bool = False) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    slots = torch.randn(B, steps, N, D, generator=generator, dtype=torch.float64)
    shape = (B, steps, N, Z) if per_slot else (B, steps, Z)
    p, v = (torch.randn(shape, generator=generator, dtype=torch.float64) for _ in range(2))
    return slots, p, v


@pytest.mark.parametrize(("kind", "per_slot"), [("cocvp", False), ("cocvp", True), ("ocvp_seq", False)])
def test_predictions_permute_with_the_slots(kind: Kind, per_slot: bool) -> None:
    model, (slots, p, v), order = predictor(kind), clip(per_slot=per_slot), torch.tensor([2, 0, 1])
    if per_slot:
        permuted = model(slots[:, :, order], p[:, :, order], v[:, :, order])
    else:
        permuted = model(slots[:, :, order], p, v)
    torch.testing.assert_close(permuted, model(slots, p, v)[:, :, order])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("changed", ["slots", "p", "v"])
def test_future_frames_and_actions_change_no_past_prediction(kind: Kind, changed: str) -> None:
    model, (slots, p, v) = predictor(kind), clip()
    expected = model(slots, p, v)
    for t in range(1, T):
        given = {"slots": slots.clone(), "p": p.clone(), "v": v.clone()}
        given[changed][:, t] += 1.0
        got = model(given["slots"], given["p"], given["v"])
        torch.testing.assert_close(got[:, :t], expected[:, :t], rtol=0, atol=0)
        for later in range(t, T):
            assert not torch.allclose(got[:, later], expected[:, later], atol=1e-9), (t, later)


@pytest.mark.parametrize("kind", KINDS)
def test_every_slot_of_a_frame_sees_every_other_slot_and_the_action_of_that_frame(kind: Kind) -> None:
    model, (slots, p, v) = predictor(kind), clip()
    expected = model(slots, p, v)
    for n in range(N):
        other = slots.clone()
        other[:, 2, n] += 1.0
        moved = (model(other, p, v) - expected)[:, 2].abs().amax(dim=(0, 2))
        assert (moved > 1e-6).all(), f"slot {n} of frame 2 reaches only {moved}"
    for name in ("p", "v"):
        given = {"p": p.clone(), "v": v.clone()}
        given[name][:, 2] += 1.0
        moved = model(slots, *given.values()) - expected
        assert (moved[:, 2].abs().amax(dim=(0, 2)) > 1e-6).all(), name


def test_an_actions_code_reaches_only_its_own_slots_token_with_one_action_per_slot() -> None:
    model, (slots, p, v) = cocvp(), clip(per_slot=True)
    code = model.code[:T].view(1, T, 1, -1)
    expected = model._tokens(slots, p, v, code).view(B, T, N, -1)
    p[:, :, 1] += 1.0
    moved = (model._tokens(slots, p, v, code).view(B, T, N, -1) - expected).abs().amax(dim=(0, 1, 3))
    assert (moved > 0).tolist() == [False, True, False]


def test_tokens_are_the_sum_of_three_projections_and_the_frames_code() -> None:
    model, (slots, p, v) = cocvp(), clip()
    code = model.code[:T].view(1, T, 1, -1)
    action = (model.embed_prototype(p) + model.embed_variability(v))[:, :, None]
    expected = model.embed_slots(slots) + action + sinusoidal_code(8, 16).double()[:T][None, :, None]
    torch.testing.assert_close(model._tokens(slots, p, v, code), expected.flatten(1, 2))


def test_the_position_code_is_vaswanis() -> None:
    code = sinusoidal_code(5, 6)
    for t in range(5):
        for i in range(3):
            angle = torch.tensor(t / 10000 ** (2 * i / 6))
            torch.testing.assert_close(code[t, 2 * i], angle.sin(), atol=1e-6, rtol=1e-5)
            torch.testing.assert_close(code[t, 2 * i + 1], angle.cos(), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("residual", [False, True])
@pytest.mark.parametrize(("kind", "per_slot"), [("cocvp", False), ("cocvp", True), ("ocvp_seq", False)])
@pytest.mark.parametrize(
    ("seed", "steps", "context"),
    [(1, 6, 8), (3, 6, 8), (6, 6, 8), (1, 8, 8), (1, 9, 8), (2, 13, 5), (5, 12, 5)],
)
def test_the_cached_rollout_equals_the_full_one(
    seed: int, steps: int, context: int, kind: Kind, per_slot: bool, residual: bool
) -> None:
    model, (slots, p, v) = predictor(kind, context, residual), clip(steps, per_slot)
    cached, full = model.rollout(slots[:, :seed], p, v), model.rollout_full(slots[:, :seed], p, v)
    assert cached.shape == (B, steps, N, D)
    torch.testing.assert_close(cached, full)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("seed", "steps", "context"), [(1, 5, 8), (3, 5, 8), (2, 8, 4)])
def test_the_cached_rollout_has_the_full_ones_gradients(kind: Kind, seed: int, steps: int, context: int) -> None:
    model, (slots, p, v) = predictor(kind, context), clip(steps)
    weights = torch.randn(B, steps, N, D, dtype=torch.float64)
    found = []
    for rollout in (model.rollout, model.rollout_full):
        model.zero_grad()
        inputs = [x.clone().requires_grad_() for x in (slots[:, :seed], p, v)]
        (rollout(*inputs) * weights).sum().backward()
        grads = {name: parameter.grad for name, parameter in model.named_parameters()}
        grads |= {name: x.grad for name, x in zip(("seed", "p", "v"), inputs, strict=True)}
        found.append({name: grad.clone() for name, grad in grads.items() if grad is not None})
    assert set(found[0]) == set(found[1]) == {*dict(model.named_parameters()), "seed", "p", "v"}
    for name, expected in found[1].items():
        assert expected.any(), name
        torch.testing.assert_close(found[0][name], expected, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.parametrize("kind", KINDS)
def test_the_rollout_feeds_predictions_back_and_reads_parsed_slots_inside_the_seed_only(kind: Kind) -> None:
    model, (slots, p, v) = predictor(kind), clip()
    out = model.rollout(slots[:, :3], p, v)
    torch.testing.assert_close(out[:, :3], model(slots[:, :3], p[:, :3], v[:, :3]))
    fed = torch.cat((slots[:, :3], out[:, 2:-1]), dim=1)
    torch.testing.assert_close(out, model(fed, p, v))
    assert not torch.allclose(out[:, 3:], model(slots, p, v)[:, 3:])


@pytest.mark.parametrize("kind", KINDS)
def test_step_by_step_on_a_kept_past_equals_one_pass(kind: Kind) -> None:
    model, (slots, p, v) = predictor(kind), clip()
    got, past = [], None
    for frames in (slice(0, 1), slice(1, 4), slice(4, 6)):
        out, past = model.step(slots[:, frames], p[:, frames], v[:, frames], past=past)
        got.append(out)
    torch.testing.assert_close(torch.cat(got, dim=1), model(slots, p, v))


@pytest.mark.parametrize("kind", KINDS)
def test_past_the_context_a_prediction_is_that_of_the_window_alone(kind: Kind) -> None:
    model, (slots, p, v) = predictor(kind, context=4), clip(9)
    out = model.rollout(slots[:, :2], p, v)
    frames = torch.cat((slots[:, :2], out[:, 1:]), dim=1)
    for t in range(4, 9):
        window = slice(t - 3, t + 1)
        torch.testing.assert_close(out[:, t], model(frames[:, window], p[:, window], v[:, window])[:, -1])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("padding", [0, 1, 3])
def test_left_padding_changes_nothing(kind: Kind, padding: int) -> None:
    model, (slots, p, v) = predictor(kind), clip(5)
    expected = model(slots, p, v)
    noise = torch.full((B, padding, 1), 1e3, dtype=torch.float64)
    padded = [torch.cat((noise.view(B, padding, *[1] * (x.dim() - 2)).expand(-1, -1, *x.shape[2:]), x), dim=1)
              for x in (slots, p, v)]  # fmt: skip
    valid = torch.arange(padding + 5).expand(B, -1) >= padding
    got = model(*padded, valid=valid)
    assert torch.isfinite(got).all()
    torch.testing.assert_close(got[:, padding:], expected)


@pytest.mark.parametrize("lengths", [(5, 2), (1, 5)])
@pytest.mark.parametrize("kind", KINDS)
def test_histories_of_unequal_length_do_not_disturb_each_other(kind: Kind, lengths: tuple[int, int]) -> None:
    model, (slots, p, v) = predictor(kind), clip(5)
    valid = torch.arange(5) >= 5 - torch.tensor(lengths)[:, None]
    got = model(slots, p, v, valid=valid)
    for row, length in enumerate(lengths):
        alone = model(*(x[row : row + 1, 5 - length :] for x in (slots, p, v)))
        torch.testing.assert_close(got[row : row + 1, 5 - length :], alone)


@pytest.mark.parametrize("kind", KINDS)
def test_the_residual_model_starts_as_nothing_moves(kind: Kind) -> None:
    config = PredictorConfig(kind=kind, dim=16, layers=1, heads=2, head_dim=8, mlp_dim=16, residual=True)
    slots, p, v = (x.float() for x in clip())
    torch.testing.assert_close(build_predictor(config, D, Z)(slots, p, v), slots)


def test_the_kind_is_chosen_by_the_config_and_ocvp_seq_takes_no_latent_action_per_slot() -> None:
    assert type(build_predictor(PredictorConfig(), D, Z, per_slot=True)) is COCVP
    assert type(build_predictor(PredictorConfig(kind="ocvp_seq"), D, Z)) is OCVPSeq
    with pytest.raises(ConfigError, match=r"model\.predictor\.kind: got ocvp_seq with .*variant=multi, expected cocvp"):
        build_predictor(PredictorConfig(kind="ocvp_seq"), D, Z, per_slot=True)


def test_ocvp_seq_takes_one_real_action_as_well_as_p_and_v() -> None:
    torch.manual_seed(0)
    model = OCVPSeq(PredictorConfig(kind="ocvp_seq", dim=16, layers=1, heads=2, mlp_dim=16), D, 2 * Z).double()
    torch.nn.init.normal_(model.head.weight, std=0.3)
    slots, p, v = clip()
    torch.testing.assert_close(model(slots, torch.cat((p, v), dim=-1)), model(slots, p, v))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("seed", "steps"), [(0, 4), (5, 4), (9, 12)])
def test_an_impossible_seed_is_refused(kind: Kind, seed: int, steps: int) -> None:
    _, p, v = clip(steps)
    with pytest.raises(ValueError, match=f"seed frames: got {seed}, expected 1 to"):
        predictor(kind).rollout(torch.zeros(B, seed, N, D, dtype=torch.float64), p, v)


@pytest.mark.parametrize("kind", KINDS)
def test_more_frames_than_the_context_are_refused(kind: Kind) -> None:
    model, given = predictor(kind, context=4), clip()
    with pytest.raises(ValueError, match=r"got 6, expected at most model.predictor\.context=4"):
        model(*given)
    _, past = model.step(*(x[:, :4] for x in given))
    with pytest.raises(ValueError, match=r"got 5, expected at most model.predictor\.context=4"):
        model.step(*(x[:, 4:5] for x in given), past=past)


def test_a_block_with_cached_keys_equals_the_block_on_all_tokens() -> None:
    torch.manual_seed(0)
    block = TransformerBlock(8, 2, 4, 16).double()
    x = torch.randn(2, 5, 8, dtype=torch.float64)
    causal = torch.ones(5, 5, dtype=torch.bool).tril()
    expected, _ = block(x, causal)
    _, past = block(x[:, :4], causal[:4, :4])
    got, (k, v) = block(x[:, 4:], None, past)
    torch.testing.assert_close(got, expected[:, 4:])
    assert k.shape == v.shape == (2, 2, 5, 4)


def test_a_block_without_output_projection_needs_heads_that_fill_the_width() -> None:
    with pytest.raises(ValueError, match="heads \\* head_dim = 6, expected dim = 8"):
        TransformerBlock(8, 2, 3, 16, project_out=False)
