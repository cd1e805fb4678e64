"""The expert's videos through latents: nothing but the decoder may lose a success."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.acting.actor import ExpertActor
from playslot_rl.acting.agent import ReplayActor, perform
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.acting.episodes import TaskPool, run_episodes
from playslot_rl.config import ExperimentConfig
from playslot_rl.evaluation.success import evaluate
from playslot_rl.testing import tiny_config
from playslot_rl.world_model import Agent, WorldModel

SEEDS = [1_000_000_000, 1_000_000_001]


class _Decodes(nn.Module):
    def __init__(self, scale: float) -> None:
        super().__init__()
        self.scale = scale

    def forward(self, z: Tensor) -> Tensor:
        return self.scale * z


@pytest.fixture(scope="module")
def config() -> ExperimentConfig:
    config = tiny_config(max_steps=20)
    dynamics = replace(config.model.inverse_dynamics, mode="ground_truth")
    return replace(config, model=replace(config.model, inverse_dynamics=dynamics))


@pytest.mark.integration
@pytest.mark.parametrize(("scale", "success"), [(1.0, 1.0), (0.0, 0.0)])
def test_latents_that_are_the_actions_succeed_as_the_expert_does_unless_the_decoder_loses_them(
    config: ExperimentConfig, scale: float, success: float
) -> None:
    agent = Agent.untrained(WorldModel(config.model, config.env)).eval()
    agent.action_decoder = _Decodes(scale)  # type: ignore[assignment]
    once = replace(config, evaluation=replace(config.evaluation, references=False))
    result = evaluate(agent, once, "replay", 2, 0)
    assert result["seeds"] == SEEDS
    assert result["success_rate"] == success
    with TaskPool(config.env, config.render) as pool:
        expert = [one.steps for one in run_episodes(pool, ExpertActor(), SEEDS)]
    assert [one["steps"] for one in result["per_episode"]] == (expert if success else [None, None])


@pytest.mark.integration
def test_the_film_is_whole_and_of_the_episodes_that_were_asked_for(config: ExperimentConfig) -> None:
    with TaskPool(config.env, config.render) as pool:
        frames, actions = perform(pool, SEEDS)
        again, _ = perform(pool, SEEDS[1:])
        first = [torch.from_numpy(pool.take(1)[0].reset(seed=seed)[0]["pixels"]).movedim(-1, 0) for seed in SEEDS]
    assert (frames.shape, actions.shape) == ((2, 21, 3, 64, 64), (2, 20, 4))
    assert torch.equal(frames[:, 0], torch.stack(first))
    assert torch.equal(frames[1:], again)
    assert (frames[:, 1:] != frames[:, :-1]).flatten(1).any(1).all()
    assert actions.abs().max() <= 1


@pytest.mark.integration
def test_the_policy_is_not_asked(config: ExperimentConfig) -> None:
    agent = Agent.untrained(WorldModel(tiny_config().model, config.env)).eval()
    agent.policy = nn.Module()  # type: ignore[assignment]
    with TaskPool(config.env, config.render) as pool:
        memory = ReplayActor(agent, lambda seeds: perform(pool, seeds)).reset(SEEDS)
    assert memory["planned_actions"].shape == (2, 20, 4)


def test_longer_episodes_than_the_model_was_trained_on_are_acted_to_their_end(config: ExperimentConfig) -> None:
    agent = Agent.untrained(WorldModel(tiny_config(max_steps=4).model, replace(config.env, max_steps=4))).eval()
    loop = ClosedLoop(ReplayActor(agent, lambda seeds: (torch.zeros(1, 8, 3, 64, 64), torch.zeros(1, 7, 4))))
    loop.reset([0])
    plan = torch.arange(7.0).view(1, 7, 1).expand(1, 7, 4)
    loop._memory[keys.PLANNED_ACTIONS] = plan.clone()
    acted = torch.stack([loop.step(TensorDict({}, [1]))[keys.ACTION] for _ in range(7)], 1)
    assert torch.equal(acted, plan)
