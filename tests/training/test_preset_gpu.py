"""`preset=gpu`, an hour of one GPU: every stage takes a step at its sizes, here of two short clips on the CPU."""

from __future__ import annotations

import math

import pytest
import torch

from playslot_rl.config.compose import compose
from playslot_rl.speed.steps import STAGES, RandomStage

CPU = torch.device("cpu")


@pytest.mark.integration
@pytest.mark.parametrize("env", ["button_press", "block_push"])
@pytest.mark.parametrize("stage", STAGES)
def test_a_step_at_its_sizes_moves_the_weights_of_every_part(env: str, stage: str) -> None:
    short = ["dynamics.predicted_frames=2", "slots.clip_frames=2"]
    config = compose([f"env={env}", "preset=gpu", *short])
    made = RandomStage(config, stage, CPU, "fp32", batch=2)
    before = {name: [p.detach().clone() for p in module.parameters()] for name, module in made.modules.items()}
    assert math.isfinite(float(made.step()()))
    for name, module in made.modules.items():
        trained = [p.requires_grad for p in module.parameters()]
        moved = [not torch.equal(p, old) for p, old in zip(module.parameters(), before[name], strict=True)]
        assert any(moved) == any(trained), name
        assert all(p.isfinite().all() for p in module.parameters()), name
