"""The learner: it learns, repeats, and what it hands to the checkpoint is all of it."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from dreamer_parts import A, Parts, random_batch, tiny
from tensordict import TensorDict
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.objectives import dreamer_v3

from playslot_rl import keys
from playslot_rl.config import EnvConfig
from playslot_rl.errors import ConfigError
from playslot_rl.methods.dreamer import learner as module
from playslot_rl.methods.dreamer.learner import DreamerLearner
from playslot_rl.methods.dreamer.networks import DreamerNetworks
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.storage.resume import optimizer_tensors, restore_optimizer
from playslot_rl.storage.tensors import load_modules, module_tensors


def learner(seed: int = 0) -> DreamerLearner:
    with global_seed(seed, 0, "test"):
        return DreamerLearner(DreamerNetworks(tiny(), EnvConfig()), tiny())


def step(agent: DreamerLearner, number: int) -> dict[str, float]:
    with global_seed(0, number):
        values = agent.update(random_batch(number % 2), StepGenerators(0, number))
    return {key: float(value) for key, value in values.items()}


def state(agent: DreamerLearner) -> dict[str, torch.Tensor]:
    return {key: value.clone() for key, value in module_tensors(agent.modules).items()}


@pytest.mark.integration
def test_reconstruction_and_reward_prediction_learn() -> None:
    agent = learner()
    first = step(agent, 0)
    for number in range(1, 30):
        last = step(agent, number)
    assert last["loss_model_reward"] < 0.9 * first["loss_model_reward"]
    assert last["loss_model_reco"] < first["loss_model_reco"]
    assert last["loss"] < first["loss"]


@pytest.mark.integration
def test_modules_and_optimisers_are_all_that_an_update_depends_on() -> None:
    one, other = learner(0), learner(1)
    for number in range(3):
        step(one, number)
    load_modules(other.modules, state(one), "test")
    for name, optimizer in one.optimizers.items():
        tensors = {key: value.clone() for key, value in optimizer_tensors(optimizer).items()}
        restore_optimizer(other.optimizers[name], tensors, "test")
    for number in range(3, 6):
        assert step(one, number) == step(other, number)
    left, right = state(one), state(other)
    assert all(torch.equal(left[key], right[key]) for key in left)
    assert any(key.startswith("slow.critic") for key in left)
    assert "slow.returns.high" in left


def test_the_slow_critic_follows_the_critic() -> None:
    agent = learner()
    key = "mlp.model.0.weight"
    for number in range(3):
        before = state(agent)
        step(agent, number)
        after = state(agent)
        expected = 0.98 * before[f"slow.critic.module.{key}"] + 0.02 * after[f"networks.value.{key}"]
        assert torch.allclose(after[f"slow.critic.module.{key}"], expected, atol=1e-6)


def test_acting_without_exploring_is_a_function_of_memory_and_frame(parts: Parts) -> None:
    agent = DreamerLearner(parts.networks, parts.config)
    memory = agent.initial(3).set(keys.PIXELS, torch.randint(0, 256, (3, 3, 64, 64), dtype=torch.uint8))
    before = torch.get_rng_state()
    with torch.no_grad():
        seen = [agent.act(memory.clone(), torch.Generator().manual_seed(i), explore=False) for i in range(2)]
        drawn = [agent.act(memory.clone(), torch.Generator().manual_seed(i), explore=True) for i in (0, 0, 1)]
    assert torch.equal(torch.get_rng_state(), before)  # the global generator is none of its business
    assert torch.equal(seen[0][keys.ACTION], seen[1][keys.ACTION])
    assert torch.equal(drawn[0][keys.ACTION], drawn[1][keys.ACTION])
    assert not torch.equal(drawn[0][keys.ACTION], drawn[2][keys.ACTION])
    assert seen[0][keys.ACTION].shape == (3, A)
    assert seen[0][keys.PIXELS].shape == (3, 3, 16, 16)
    assert seen[0][keys.PIXELS].dtype == torch.uint8


def test_frames_are_reduced_by_their_mean() -> None:
    networks = learner().networks
    frames = torch.zeros(1, 3, 64, 64, dtype=torch.uint8)
    frames[..., :4, :2] = 200
    assert networks.reduce(frames)[0, 0, 0, 0] == 100
    assert torch.equal(networks.reduce(frames / 255), networks.reduce(frames))


def test_floats_of_the_size_that_it_sees_are_bytes_too() -> None:
    frames = torch.randint(0, 256, (1, 3, 16, 16), dtype=torch.uint8)
    assert torch.equal(learner().networks.reduce(frames / 255), frames)


def test_filtering_frame_by_frame_is_the_rollout_of_the_sequence(parts: Parts) -> None:
    from playslot_rl.methods.dreamer.learner import records, world_model

    batch = random_batch()
    with global_seed(0, 0), torch.no_grad():
        out = world_model(parts.networks)(records(batch, parts.networks))
        memory = parts.networks.blank(2)
        for frame in range(3):
            state, belief = memory["state"], memory["belief"]
            action = torch.where(batch[keys.IS_FIRST][:, frame], 0, batch[keys.ACTION][:, frame])
            likely, belief = parts.networks.filter(state, belief, action, batch[keys.PIXELS][:, frame], None)
            assert torch.allclose(belief, out["next", "belief"][:, frame], atol=1e-5)
            posterior = out["next", "posterior_logits"][:, frame]
            assert torch.equal(likely.view_as(posterior).argmax(-1), posterior.argmax(-1))
            memory = memory.update({"state": out["next", "state"][:, frame], "belief": belief})


@pytest.mark.parametrize("key", ["compile_train_step", "cudagraph"])
def test_a_step_is_neither_compiled_nor_recorded_without_a_gpu(key: str) -> None:
    with pytest.raises(
        ConfigError, match=f"^baselines.dreamer.{key}=true: got device cpu, expected cuda: leave .* out$"
    ):
        DreamerLearner(DreamerNetworks(tiny(), EnvConfig()), tiny(**{key: True}))


def test_a_step_that_is_compiled_or_recorded_is_prepared_once_on_what_it_learns_from(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As on a GPU: TorchRL refuses a step that was not."""
    monkeypatch.setattr(module, "require_device", lambda config, device: True)
    agent, warmed = learner(), list[tuple[int, ...]]()

    def warmup(sample: TensorDict) -> None:
        warmed.append(tuple(sample.batch_size))

    monkeypatch.setattr(agent._stepper, "warmup", warmup)
    for number in range(2):
        step(agent, number)
    assert warmed == [tuple(random_batch(0).batch_size)]


class _Waits(TorchDispatchMode):
    """Refuses what needs a value on the host."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        assert not any(wait in func.name() for wait in ("_local_scalar_dense", "nonzero", "masked_select")), func.name()
        return func(*args, **(kwargs or {}))


def test_a_step_as_it_is_recorded_waits_for_no_value(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dreamer_v3, "_is_dynamo_compiling", lambda: True)  # as of a graph TorchRL asks, too
    agent = learner()
    with global_seed(0, 0), _Waits():
        agent.update(random_batch(0), StepGenerators(0, 0))


@pytest.mark.parametrize("size, mults", [(24, (1, 2)), (32, (1, 1, 1, 1, 1, 1))])
def test_a_frame_size_that_does_not_fit_is_refused(size: int, mults: tuple[int, ...]) -> None:
    with pytest.raises(ConfigError, match=f"frame_size: got {size}, expected a divisor of env.image_size"):
        DreamerNetworks(tiny(frame_size=size, mults=mults), EnvConfig())
