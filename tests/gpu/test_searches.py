"""Searches and imagination on a GPU: the host is always ahead of the device (`make test-gpu`)."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import get_args

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tiny_searches import tiny_search

from playslot_rl import keys
from playslot_rl.acting.agent import imagine
from playslot_rl.acting.imagination import ImaginationEnv
from playslot_rl.acting.planners.planner import Best
from playslot_rl.config.planning import PlannerName
from playslot_rl.play.session import PlaySession
from playslot_rl.play.starts import Start
from playslot_rl.seeds.draws import step_generator
from playslot_rl.testing import tiny_agent

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]
WARM = 3
"""Kernels are chosen in the first, graphs recorded in the second."""


@contextlib.contextmanager
def no_waits() -> Iterator[None]:
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("name", get_args(PlannerName))
def test_a_search_waits_for_its_plan_alone(name: PlannerName, monkeypatch: pytest.MonkeyPatch) -> None:
    planner, search = tiny_search(name, "cuda")
    for _ in range(WARM):
        expected = planner(search, step_generator(0, 0, name, "cuda"))
    generator, read = step_generator(0, 0, name, "cuda"), Best.plan
    monkeypatch.setattr(Best, "plan", lambda best: best)
    with no_waits():
        best = planner(search, generator)
    plan = read(best)  # type: ignore[arg-type]
    assert plan.cost == pytest.approx(expected.cost, rel=1e-3)
    torch.testing.assert_close(plan.latents, expected.latents, atol=1e-3, rtol=1e-3)


def test_imagined_and_played_steps_do_not_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the game, the pictures do."""
    agent = tiny_agent().requires_grad_(False).to("cuda")
    first = TensorDict({keys.SLOTS: torch.randn(2, *agent.world_model.slot_shape, device="cuda")}, [2])
    start, session = ImaginationEnv(agent.world_model, [2]).reset(first), PlaySession(agent.world_model)
    picture = np.zeros((64, 64, 3), np.uint8)
    monkeypatch.setattr(PlaySession, "_draw", lambda *_: picture)
    session.begin(Start("", picture, first[keys.SLOTS][:1]))
    monkeypatch.setattr(ImaginationEnv, "reset", lambda env, given: start.clone())  # TorchRL's own reads
    for _ in range(WARM):
        expected = imagine(agent, first, 6)
        session.press(0)
    with no_waits():
        found = imagine(agent, first, 6)
        session.press(0)
    torch.testing.assert_close(found.slots, expected.slots, atol=1e-4, rtol=1e-4)
