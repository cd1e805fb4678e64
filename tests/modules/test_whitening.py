"""Whitening is invertible and gives latents unit scale; decoders that read slots do not depend on their order."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from playslot_rl.config import ActionDecoderConfig, PolicyConfig
from playslot_rl.losses.behaviour import ActionDecoderLoss, BehaviourLoss
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.modules.whitening import FADE, Whitening

READS = ActionDecoderConfig(16, state_dim=8, state_heads=2, state_dropout=0.0, reads_slots=True)
SMALL = PolicyConfig(dim=16, layers=1, heads=2, head_dim=8, mlp_dim=16)


def latents(rows: int = 500) -> torch.Tensor:
    """Correlated latents of very different scales, (M, 5)."""
    generator = torch.Generator().manual_seed(0)
    mix = torch.randn(5, 5, generator=generator)
    return torch.randn(rows, 5, generator=generator) * torch.tensor([3.0, 1.0, 0.5, 1e-3, 1e-5]) @ mix + 4.0


def test_it_is_the_identity_until_it_is_fitted_and_invertible_after() -> None:
    z, whitening = latents(), Whitening(5)
    assert torch.equal(whitening(z), z)
    whitening.fit(z)
    assert torch.allclose(whitening.inverse(whitening(z)), z, atol=1e-4)
    assert torch.allclose(whitening.turn(z[:3] - z[3:6]), whitening(z[:3]) - whitening(z[3:6]), atol=1e-4)


def test_coordinates_are_uncorrelated_and_directions_without_variance_fade() -> None:
    z, whitening = latents(), Whitening(5)
    whitening.fit(z)
    covariance = torch.cov(whitening(z).T)
    assert torch.allclose(covariance, covariance.diagonal().diag(), atol=1e-3)
    spread = covariance.diagonal()
    assert float(spread[0]) == pytest.approx(1 / (1 + FADE), rel=1e-3)
    assert float(spread[-1]) < 1e-3
    assert bool((spread.diff() <= 1e-4).all())


def test_constant_latents_do_no_harm() -> None:
    whitening = Whitening(3)
    whitening.fit(torch.ones(10, 3))
    assert bool(torch.isfinite(whitening(torch.randn(4, 3))).all())


def test_a_whitened_policy_is_compared_in_coordinates() -> None:
    torch.manual_seed(0)
    policy, z = LatentPolicy(SMALL, 6, 5, whiten=True), latents(8)
    assert policy.whitening is not None
    policy.whitening.fit(latents())
    slots = torch.randn(8, 3, 6)
    loss = BehaviourLoss(policy, "l1")(TensorDict({"slots": slots, "latent_action": z}, [8]))["loss_policy"]
    expected = (policy.whitening(policy(slots)) - policy.whitening(z)).abs().mean()
    assert float(loss.detach()) == pytest.approx(float(expected.detach()), rel=1e-4)


@pytest.mark.parametrize("whiten", [False, True])
def test_a_decoder_that_reads_slots_does_not_depend_on_their_order(whiten: bool) -> None:
    torch.manual_seed(0)
    decoder = ActionDecoder(
        ActionDecoderConfig(16, state_dim=8, state_heads=2, whiten=whiten, reads_slots=True), 5, 4, 6
    )
    decoder.standardise(latents())
    decoder.eval()
    z, slots = latents(7), torch.randn(7, 3, 6)
    action = decoder(z, slots)
    assert action.shape == (7, 4)
    assert torch.allclose(decoder(z, slots[:, [2, 0, 1]]), action, atol=1e-5)
    assert not torch.allclose(decoder(z, slots + 1.0 * torch.randn_like(slots)), action, atol=1e-3)
    assert decoder(z).shape == (7, 4), "it can do without"


def test_with_and_without_slots_are_two_networks_and_each_learns_from_every_row() -> None:
    torch.manual_seed(0)
    decoder, z, slots, action = ActionDecoder(READS, 5, 4, 6), latents(9), torch.randn(9, 3, 6), torch.rand(9, 4)
    loss = ActionDecoderLoss(decoder, "l1")
    got = loss(TensorDict({"latent_action": z, "slots": slots, "action": action}, [9]))["loss_action"]
    parts = [(decoder(z, seen) - action).abs().mean() for seen in (slots, None)]
    assert float(got.detach()) == pytest.approx(float(sum(part.detach() for part in parts)), rel=1e-5)

    def moved(part: torch.Tensor) -> set[str]:
        decoder.zero_grad()
        part.backward()
        return {name.partition(".")[0] for name, p in decoder.named_parameters() if p.grad is not None and p.grad.any()}

    assert [moved(part) for part in parts] == [{"encoder", "seeing"}, {"layers"}]


def test_slots_are_dropped_in_training_only_and_by_rows() -> None:
    torch.manual_seed(0)
    decoder, z, slots = ActionDecoder(replace(READS, state_dropout=0.5), 5, 4, 6), latents(200), torch.randn(200, 3, 6)
    decoder.eval()
    seen = decoder(z, slots)
    decoder.train()
    drawn = decoder(z, slots)
    kept = (drawn == seen).all(-1)
    assert 60 < int(kept.sum()) < 140
    with torch.no_grad():
        alone = torch.tanh(decoder.seeing(torch.cat(((z - decoder.mean) / decoder.scale, torch.zeros(200, 8)), dim=-1)))
    assert torch.equal(drawn[~kept], alone[~kept])


def test_without_slots_it_is_the_papers_decoder() -> None:
    torch.manual_seed(0)
    plain, decoder = ActionDecoder(ActionDecoderConfig(16), 5, 4), ActionDecoder(READS, 5, 4, 6)
    missing = decoder.load_state_dict(plain.state_dict(), strict=False)
    assert all(name.startswith(("encoder", "seeing", "trusts_slots")) for name in missing.missing_keys)
    z = latents(7)
    assert torch.equal(plain(z), decoder(z))


def test_a_decoder_without_slots_takes_or_leaves_them() -> None:
    decoder = ActionDecoder(ActionDecoderConfig(hidden_dim=16), 5, 4)
    z = latents(3)
    assert not decoder.reads_slots
    assert torch.equal(decoder(z), decoder(z, torch.randn(3, 2, 6)))


def test_its_loss_reads_what_it_reads() -> None:
    plain = ActionDecoderLoss(ActionDecoder(ActionDecoderConfig(hidden_dim=16), 5, 4))
    state = ActionDecoderLoss(
        ActionDecoder(ActionDecoderConfig(16, state_dim=8, state_heads=2, reads_slots=True), 5, 4, 6)
    )
    assert plain.in_keys == ["latent_action", "action"]
    assert state.in_keys == ["latent_action", "slots", "action"]
    rows = TensorDict({"latent_action": latents(3), "slots": torch.randn(3, 2, 6), "action": torch.rand(3, 4)}, [3])
    state(rows)["loss_action"].backward()
    assert state.network.encoder.to_token.weight.grad is not None


def test_a_number_that_training_latents_share_does_not_drown_the_others() -> None:
    decoder, z = ActionDecoder(ActionDecoderConfig(hidden_dim=16), 5, 4), latents(50)
    z[:, 0] = 0.0  # such as an action that no labelled demonstration has
    decoder.standardise(z)
    assert float(decoder.scale[0]) == 1.0
    torch.testing.assert_close(decoder.scale[1:], z[:, 1:].std(dim=0))


def test_widths_that_do_not_fit_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"model\.action_decoder\.state_dim: got 10, expected a multiple of state_heads, 4"
    ):
        ActionDecoderConfig(state_dim=10, reads_slots=True)
