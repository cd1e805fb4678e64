"""Fixtures: an untrained agent in a model folder, and a run with the stored ButtonPress policy."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from playslot_rl.sharing.folder import SharedPolicyConfig, save_pretrained
from playslot_rl.storage.atomic import write_json
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.world_model import Agent

SHIPPED = Path(__file__).parents[2] / "playslot_rl" / "pretrained" / "button_press"


@pytest.fixture(scope="session")
def agent() -> Agent:
    """Untrained, with a slot oracle, whitened latents and a decoder that reads slots."""
    plain = tiny_config()
    policy = replace(plain.model.policy, whiten=True)
    decoder = replace(plain.model.action_decoder, whiten=True, reads_slots=True, state_dim=8, state_heads=2)
    return tiny_agent(replace(plain, model=replace(plain.model, policy=policy, action_decoder=decoder)))


@pytest.fixture(scope="session")
def config(agent: Agent) -> SharedPolicyConfig:
    """Of that agent."""
    return SharedPolicyConfig(env=agent.world_model.env, model=agent.world_model.config, source={"demos": 3})


@pytest.fixture
def folder(agent: Agent, config: SharedPolicyConfig, tmp_path: Path) -> Path:
    """That agent's model folder, to break."""
    save_pretrained(agent, tmp_path / "policy", config, lambda _: "card\n")
    return tmp_path / "policy"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run with the stored policy on the shipped world model."""
    from playslot_rl.config import to_dict
    from playslot_rl.config.compose import compose

    root = tmp_path / "run"
    shutil.copytree(SHIPPED / "policy" / "checkpoint", root / "policy" / "checkpoint")
    write_json(root / "world_model.json", {"source": "pretrained"})
    write_json(root / "config.json", to_dict(compose(["preset=compact", "data.demos=/home/someone/data"])))
    return root
