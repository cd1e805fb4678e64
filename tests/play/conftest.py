"""A world model to play with, and where playing starts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from scene import DotTask, make_source

from playslot_rl.data.source import EpisodeFrames
from playslot_rl.play.session import PlaySession
from playslot_rl.play.starts import RecordedStarts, SimulatedStarts
from playslot_rl.play.studio import Studio
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.world_model import Agent, WorldModel


@pytest.fixture(scope="session")
def agent() -> Agent:
    return tiny_agent()


@pytest.fixture(scope="session")
def many() -> WorldModel:
    """A world model with one latent action per slot."""
    config = tiny_config(multi=True)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = WorldModel(config.model, config.env)
        model.inverse_dynamics.split(torch.randn(64, 8))
    return model.eval().requires_grad_(False)


@pytest.fixture(scope="session")
def source() -> EpisodeFrames:
    return make_source()


@pytest.fixture
def recorded(agent: Agent, source: EpisodeFrames) -> RecordedStarts:
    return RecordedStarts(agent.world_model, source, DotTask)


@pytest.fixture
def simulated(agent: Agent) -> SimulatedStarts:
    return SimulatedStarts(agent.world_model, DotTask, 10.0, "move the dot", first_seed=100)


@pytest.fixture
def session(agent: Agent, recorded: RecordedStarts) -> PlaySession:
    """Begun in the middle of an episode, with the simulator beside."""
    made = PlaySession(agent.world_model, agent)
    made.begin(recorded.start(1, 3))
    return made


@pytest.fixture
def studio(agent: Agent, recorded: RecordedStarts, simulated: SimulatedStarts, tmp_path: Path) -> Iterator[Studio]:
    made = Studio(agent.world_model, agent, recorded, simulated, tmp_path / "play", "tiny")
    yield made
    made.close()


@pytest.fixture
def studio_of_many(many: WorldModel, source: EpisodeFrames, tmp_path: Path) -> Iterator[Studio]:
    """With one latent action per slot; recordings, no simulator."""
    made = Studio(many, None, RecordedStarts(many, source), None, tmp_path)
    yield made
    made.close()
