"""Cloning latent actions and decoding them."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import BCLoss

from playslot_rl import keys
from playslot_rl.losses import ActionDecoderLoss, BehaviourLoss
from playslot_rl.testing import tiny_agent
from playslot_rl.world_model import latent_policy_module


def demos() -> TensorDict:
    g = torch.Generator().manual_seed(0)
    entries = {
        keys.SLOTS: torch.randn(3, 5, 4, 32, generator=g),
        keys.LATENT_ACTION: torch.randn(3, 5, 8, generator=g),
        keys.ACTION: torch.rand(3, 5, 4, generator=g) * 2 - 1,
    }
    return TensorDict(entries, [3, 5])


@pytest.mark.filterwarnings("ignore:The name target_actor_network_params")
@pytest.mark.parametrize("loss_function", ["l2", "l1"])
def test_it_equals_torchrls_behaviour_cloning_loss_and_its_gradient(loss_function: str) -> None:
    policy = tiny_agent().policy
    twin = copy.deepcopy(policy)
    ours = BehaviourLoss(policy, loss_function)(demos())["loss_policy"]
    ours.backward()
    reference = BCLoss(latent_policy_module(twin), loss_function=loss_function)
    reference.set_keys(action=keys.LATENT_ACTION)
    theirs = reference(demos())["loss_bc"]
    theirs.backward()
    torch.testing.assert_close(ours, theirs)
    gradients = {name: p.grad for name, p in reference.actor_network_params.flatten_keys(".").items()}
    for name, parameter in policy.named_parameters():
        torch.testing.assert_close(parameter.grad, gradients[f"module.{name}"])


def test_between_opposite_targets_l2_finds_the_mean_and_l1_stays_with_the_more_frequent_one() -> None:
    target = torch.tensor([[1.0], [1.0], [1.0], [-1.0], [-1.0]])
    batch = TensorDict({keys.SLOTS: torch.zeros(5, 1), keys.LATENT_ACTION: target}, [5])
    found = {}
    for loss_function in ("l2", "l1"):
        network = torch.nn.Linear(1, 1)
        optimizer = torch.optim.SGD(network.parameters(), lr=0.05)
        for _ in range(400):
            optimizer.zero_grad()
            BehaviourLoss(network, loss_function)(batch)["loss_policy"].backward()
            optimizer.step()
        found[loss_function] = float(network.bias.detach())
    assert found["l2"] == pytest.approx(0.2, abs=0.01)
    assert found["l1"] == pytest.approx(1.0, abs=0.06)


def test_an_unknown_loss_function_is_refused() -> None:
    with pytest.raises(ValueError, match="expected l1 or l2"):
        BehaviourLoss(torch.nn.Linear(1, 1), "l3")


def test_the_slot_oracle_is_the_same_loss_on_real_actions() -> None:
    agent = tiny_agent()
    assert agent.oracle is not None
    loss = BehaviourLoss(agent.oracle)
    loss.set_keys(action=keys.ACTION)
    data = demos()
    expected = (agent.oracle(data[keys.SLOTS]) - data[keys.ACTION]).square().mean()
    torch.testing.assert_close(loss(data)["loss_policy"], expected)


def test_masked_elements_do_not_count_even_if_they_are_nan() -> None:
    data, loss = demos(), BehaviourLoss(tiny_agent().policy)
    expected = loss(data[:2])["loss_policy"]
    data["mask"] = torch.tensor([True, True, False])[:, None].expand(3, 5)
    data[keys.LATENT_ACTION][2] = float("nan")
    out = loss(data)["loss_policy"]
    torch.testing.assert_close(out, expected)
    out.backward()
    assert all(torch.isfinite(p.grad).all() for p in loss.parameters() if p.grad is not None)


def test_the_action_decoder_regresses_real_actions() -> None:
    decoder, data = tiny_agent().action_decoder, demos()
    out = ActionDecoderLoss(decoder)(data)
    expected = (decoder(data[keys.LATENT_ACTION]) - data[keys.ACTION]).square().mean()
    torch.testing.assert_close(out["loss_action"], expected)
    assert list(out.keys()) == ["loss_action"]


def test_a_target_of_another_width_is_refused_rather_than_broadcast() -> None:
    data = demos()
    data[keys.LATENT_ACTION] = data[keys.LATENT_ACTION][..., :1]
    with pytest.raises(ValueError, match=r"latent_action: got shape \(3, 5, 1\), expected \(3, 5, 8\)"):
        BehaviourLoss(tiny_agent().policy)(data)


@pytest.mark.integration
@pytest.mark.parametrize("steps", [150])
def test_a_policy_learns_latent_actions_that_depend_on_the_slots(steps: int) -> None:
    policy = tiny_agent().policy.train()
    slots = torch.randn(64, 4, 32, generator=torch.Generator().manual_seed(0))
    data = TensorDict({keys.SLOTS: slots, keys.LATENT_ACTION: slots.mean(1)[:, :8]}, [64])
    loss, optimiser = BehaviourLoss(policy), torch.optim.Adam(policy.parameters(), 3e-3)
    before = loss(data)["loss_policy"].item()
    for _ in range(steps):
        optimiser.zero_grad()
        loss(data)["loss_policy"].backward()
        optimiser.step()
    assert loss(data)["loss_policy"].item() < 0.2 * before
