"""Success of an agent in the real environment, and its equality with the TorchRL path."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from playslot_rl import keys
from playslot_rl.acting.actor import ExpertActor
from playslot_rl.acting.agent import imagine, playslot_actor
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.acting.episodes import TaskPool, run_episodes
from playslot_rl.config import EvaluationConfig, ExperimentConfig
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.evaluation import success
from playslot_rl.evaluation.success import PROTOCOLS, RunFacts, evaluate, evaluate_run, run_facts
from playslot_rl.testing import tiny_config
from playslot_rl.world_model import Agent, WorldModel, latent_policy_module

SEED = 1_000_000_000
FACTS = RunFacts(demos=7, labelled_demos=3, fingerprints={"slots": "a", "policy": "b"}, trained_at="c")


def _agent(config: ExperimentConfig) -> Agent:
    torch.manual_seed(0)
    agent = Agent.untrained(WorldModel(config.model, config.env))
    agent.train().world_model.inverse_dynamics(torch.randn(4, 9, 4, 32))  # fills the codebook
    return agent.eval()


@pytest.fixture(scope="module")
def config() -> ExperimentConfig:
    return tiny_config(max_steps=3)


@pytest.fixture(scope="module")
def agent(config: ExperimentConfig) -> Agent:
    return _agent(config)


@pytest.fixture(scope="module")
def pool(config: ExperimentConfig) -> Iterator[TaskPool]:
    with TaskPool(config.env, config.render) as pool:
        yield pool


@pytest.mark.integration
def test_closed_loop_acts_as_the_torchrl_environment_does(
    config: ExperimentConfig, agent: Agent, pool: TaskPool
) -> None:
    from playslot_rl.acting.simulation import make_simulation_env
    from playslot_rl.world_model import action_decoder_module

    env = make_simulation_env(config.env, config.render, agent.world_model, agent.action_decoder)
    env.set_seed(SEED)
    with torch.no_grad():
        rollout = action_decoder_module(agent.action_decoder)(env.rollout(3, latent_policy_module(agent.policy)))
    env.close()
    task = pool.take(1)[0]
    frame, _ = task.reset(seed=SEED)
    torch.testing.assert_close(torch.from_numpy(frame["pixels"]).movedim(-1, 0), rollout[keys.PIXELS][0])
    loop = ClosedLoop(playslot_actor(agent))
    for step in range(3):
        action = loop.act(torch.from_numpy(frame["pixels"]).movedim(-1, 0)[None])[0]
        torch.testing.assert_close(action, rollout[keys.ACTION][step])
        frame, *_ = task.step(action.numpy())


@pytest.mark.parametrize("context", [4, 8])
def test_imagining_equals_the_modules_called_by_hand_past_the_context_too(context: int) -> None:
    agent = _agent(tiny_config(context=context))
    slots = torch.randn(2, 4, 32)
    imagined = imagine(agent, TensorDict({keys.SLOTS: slots}, [2]), 7)
    model = agent.world_model
    with torch.no_grad():
        p, v = model.inverse_dynamics.split(imagined.latents)
        rollout = model.predictor.rollout(slots[:, None], p, v)
        torch.testing.assert_close(imagined.slots, torch.cat([slots[:, None], rollout], 1))
        torch.testing.assert_close(imagined.latents, agent.policy(imagined.slots[:, :-1]))
        torch.testing.assert_close(imagined.actions, agent.action_decoder(imagined.latents))


@pytest.mark.integration
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_result_has_the_agreed_keys(protocol: str, config: ExperimentConfig, agent: Agent, pool: TaskPool) -> None:
    result = evaluate(agent, config, protocol, 2, 1, facts=FACTS, pool=pool)
    assert result["protocol"] == protocol
    assert result["episodes"] == 2
    assert result["seeds"] == [SEED + 1_000_000, SEED + 1_000_001]
    assert (result["demos"], result["labelled_demos"]) == (7, 3)
    assert 0 <= result["ci95"][0] <= result["success_rate"] <= result["ci95"][1] <= 1
    assert result["mean_steps_to_success"] is None
    assert set(result["references"]) == {"random", "expert", "slot_oracle"}
    assert all({"success_rate", "ci95"} <= set(r) for r in result["references"].values())
    assert json.loads(json.dumps(result)) == result


@pytest.mark.integration
def test_references_are_run_once_for_both_protocols(
    config: ExperimentConfig, agent: Agent, pool: TaskPool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evaluation").mkdir()
    first = evaluate(agent, config, "simulation", 1, 0, facts=FACTS, run=tmp_path, pool=pool)
    calls: list[str] = []
    real = success.run_episodes
    monkeypatch.setattr(success, "run_episodes", lambda _, c, s: calls.append(type(c).__name__) or real(pool, c, s))
    again = evaluate(agent, config, "imagination", 1, 0, facts=FACTS, run=tmp_path, pool=pool)
    assert calls == ["ImaginationActor"]  # the agent alone
    assert again["references"] == first["references"]
    other = replace(FACTS, fingerprints={"slots": "a", "policy": "another"})
    evaluate(agent, config, "imagination", 1, 0, facts=other, run=tmp_path, pool=pool)
    assert calls[1:] == ["ImaginationActor", "SlotActor"]  # another oracle; random and expert depend on no weights


def test_training_seeds_are_never_evaluated(
    config: ExperimentConfig, agent: Agent, pool: TaskPool, tmp_path: Path
) -> None:
    (tmp_path / "data" / "expert" / "meta").mkdir(parents=True)
    (tmp_path / "data" / "expert" / "meta" / "playslot.json").write_text(json.dumps({"episodes": [{"seed": SEED}]}))
    with pytest.raises(ConfigError, match="another evaluation"):
        evaluate(agent, config, "simulation", 1, 0, run=tmp_path, pool=pool)
    moved = replace(config, evaluation=EvaluationConfig(references=False, seed_offset=SEED + 5))
    assert evaluate(agent, moved, "simulation", 1, 0, run=tmp_path, pool=pool)["seeds"] == [SEED + 5]


@pytest.mark.integration
def test_undrawn_frames_change_no_outcome(config: ExperimentConfig) -> None:
    with TaskPool(replace(config.env, max_steps=20), config.render) as pool:
        blind = run_episodes(pool, ExpertActor(), [SEED, SEED + 1])
        drawn = run_episodes(pool, ExpertActor(), [SEED, SEED + 1], lambda _: None)
    assert blind == drawn
    assert all(e.success for e in blind)


def test_result_file_is_written_where_it_is_promised(
    config: ExperimentConfig, agent: Agent, pool: TaskPool, tmp_path: Path
) -> None:
    folder = tmp_path / "policy" / "checkpoint"
    folder.mkdir(parents=True)
    meta: dict[str, Any] = {"fingerprint": "f", "parents": {"slots": "s"}, "demos": 5, "labelled_demos": 2}
    (folder / "meta.json").write_text(json.dumps(meta))
    once = replace(config, episodes=1, evaluation=EvaluationConfig(references=False))
    result = evaluate_run(tmp_path, agent, once, "imagination", pool)
    stored = json.loads((tmp_path / "evaluation" / "imagination" / "eval_info.json").read_text())
    assert stored == result
    assert stored["labelled_demos"] == 2
    assert stored["fingerprints"] == {"slots": "s", "policy": "f"}


def test_an_unknown_protocol_and_a_run_without_policy_are_refused(
    config: ExperimentConfig, agent: Agent, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match="expected one of simulation, imagination"):
        evaluate(agent, config, "dream", 1, 0)
    with pytest.raises(CheckpointError, match="train-policy"):
        run_facts(tmp_path)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({}, ConfigError, "expected the folder of a run"),
        ({"run": "pretrained"}, ConfigError, "out: got nothing with run=pretrained"),
        ({"run": "nowhere"}, CheckpointError, "no such folder"),
        ({"run": ".", "out": "elsewhere"}, ConfigError, "leave it out"),
        ({"run": "."}, CheckpointError, "no policy/checkpoint"),
    ],
)
def test_recipe_refuses_runs_that_cannot_be_evaluated(
    changes: dict[str, str],
    error: type[Exception],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from playslot_rl.recipes import evaluate as recipe

    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=message) as caught:
        recipe.main(replace(ExperimentConfig(), **changes))  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
