"""The range of real actions: there and back, what never changes, and what is stored of it."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from playslot_rl import keys
from playslot_rl.acting.simulation import ActionDecoderTransform
from playslot_rl.config import ActionDecoderConfig, InverseDynamicsConfig
from playslot_rl.errors import CheckpointError
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.action_range import ActionRange, range_of
from playslot_rl.modules.inverse_dynamics import InverseDynamics
from playslot_rl.storage.tensors import load_modules, module_tensors

LOW, HIGH = torch.tensor([-90.0, 7.3, 0.0, -1.0]), torch.tensor([90.0, 7.3, 100.0, 1.0])


def arm() -> ActionRange:
    known = ActionRange(4)
    known.take(LOW, HIGH)
    return known


def decoder() -> ActionDecoder:
    torch.manual_seed(0)
    return ActionDecoder(ActionDecoderConfig(hidden_dim=8), 3, 4).eval()


def test_the_ends_are_minus_one_and_one_and_the_middle_is_nought() -> None:
    known = arm()
    actions = torch.stack([LOW, HIGH, torch.tensor([0.0, 7.3, 50.0, 0.0]), torch.tensor([180.0, 7.3, -50.0, 3.0])])
    expected = [[-1.0, -1.0, -1.0, -1.0], [1.0, -1.0, 1.0, 1.0], [0.0, -1.0, 0.0, 0.0], [2.0, -1.0, -2.0, 3.0]]
    assert known.to_unit(actions).tolist() == expected
    assert known.from_unit(torch.tensor(expected)).tolist() == actions.tolist()


def test_what_never_changes_is_that_number_whatever_the_network_says() -> None:
    said = torch.rand(50, 4, generator=torch.Generator().manual_seed(0)) * 2 - 1
    assert (arm().from_unit(said)[:, 1] == torch.tensor(7.3)).all()
    assert (arm().pinned(said)[:, 1] == -1).all()
    assert torch.equal(arm().pinned(said)[:, [0, 2, 3]], said[:, [0, 2, 3]])


def test_it_is_lerobots_normaliser_to_the_last_digit() -> None:
    from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
    from lerobot.processor import UnnormalizerProcessorStep
    from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action

    generator, known = torch.Generator().manual_seed(1), ActionRange(6)
    ends = torch.randn(2, 6, generator=generator) * torch.tensor([1e-3, 1.0, 90.0, 360.0, 1e4, 1.0])
    ends[1, 5] = ends[0, 5]
    low, high = ends.min(dim=0).values, ends.max(dim=0).values
    known.take(low, high)
    step = UnnormalizerProcessorStep(
        features={"action": PolicyFeature(FeatureType.ACTION, (6,))},
        norm_map={FeatureType.ACTION: NormalizationMode.MIN_MAX},
        stats={"action": {"min": low.tolist(), "max": high.tolist()}},
    )
    said = known.pinned(torch.rand(1000, 6, generator=generator) * 2 - 1)
    theirs = transition_to_policy_action(step(policy_action_to_transition(said)))
    assert torch.equal(known.from_unit(said), theirs)


def test_our_simulators_actions_are_handed_on_untouched_and_nothing_is_stored() -> None:
    known, said = ActionRange(4), torch.rand(3, 4)
    known.take(-torch.ones(4), torch.ones(4))
    assert known.to_unit(said) is said
    assert known.from_unit(said) is said
    assert known.pinned(said) is said
    assert known.state_dict() == {}
    assert not any("action_range" in name for name in decoder().state_dict())


@pytest.mark.parametrize(("low", "high"), [(HIGH, LOW), (LOW[:2], HIGH[:2]), (LOW.clone().fill_(float("nan")), HIGH)])
def test_ends_that_are_none_are_refused(low: torch.Tensor, high: torch.Tensor) -> None:
    with pytest.raises(ValueError, match=r"action range: got .* expected 4 finite ends in order"):
        ActionRange(4).take(low, high)


def test_it_is_stored_with_the_decoder_and_read_back() -> None:
    trained, fresh = decoder(), decoder()
    trained.action_range.take(LOW, HIGH)
    stored = {key: value.clone() for key, value in module_tensors({"action_decoder": trained}).items()}
    assert stored["action_decoder.action_range.low"].tolist() == LOW.tolist()
    load_modules({"action_decoder": fresh}, stored, "here")
    z = torch.randn(5, 3)
    assert torch.equal(fresh.action_range.from_unit(fresh(z)), trained.action_range.from_unit(trained(z)))
    assert module_tensors({"action_decoder": fresh}).keys() == stored.keys()


def test_a_checkpoint_from_before_gives_actions_in_minus_one_to_one() -> None:
    old = {key: value.clone() for key, value in module_tensors({"action_decoder": decoder()}).items()}
    reused = decoder()
    reused.action_range.take(LOW, HIGH)
    load_modules({"action_decoder": reused}, old, "here")
    assert reused.action_range.unit
    assert reused.action_range.low.tolist() == [-1.0] * 4


def test_half_a_range_is_refused_and_changes_nothing() -> None:
    trained, fresh = decoder(), decoder()
    trained.action_range.take(LOW, HIGH)
    stored = module_tensors({"action_decoder": trained})
    del stored["action_decoder.action_range.high"]
    with pytest.raises(CheckpointError, match=r"misses tensor action_decoder\.action_range\.high"):
        load_modules({"action_decoder": fresh}, stored, "here")
    assert fresh.action_range.unit


def test_a_simulator_gets_actions_in_its_own_units() -> None:
    network = decoder()
    network.action_range.take(LOW, HIGH)
    latent = torch.randn(7, 3)
    given = ActionDecoderTransform(network, (3,), (2, 5)).inv(TensorDict({keys.LATENT_ACTION: latent}, [7]))
    assert torch.equal(given[keys.ACTION], network.action_range.from_unit(network(latent)))
    assert given[keys.ACTION][:, 0].abs().max() > 1


def test_real_actions_as_latents_are_scaled() -> None:
    model = InverseDynamics(InverseDynamicsConfig(mode="ground_truth"), 8, 4).eval()
    model.action_range.take(LOW, HIGH)
    actions = torch.tensor([[[45.0, 7.3, 25.0, 0.5]]])
    assert model(torch.zeros(1, 2, 3, 8), actions).z.tolist() == [[[0.5, -1.0, -0.5, 0.5]]]


def test_a_range_is_found_beside_the_network_that_it_bounds() -> None:
    network = decoder()
    assert range_of(network) is network.action_range
    assert range_of(torch.nn.Linear(2, 2)) is None
