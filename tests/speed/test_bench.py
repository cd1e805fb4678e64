"""`playslot bench`: its keys and tables. No test judges a speed: the figures of a busy machine mean nothing.

The fast paths race plain code in `tests/benchmarks`.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from playslot_rl.cli import main
from playslot_rl.config import ModelConfig
from playslot_rl.speed import steps
from playslot_rl.speed.cases import CPU, Sizes, quick_sizes
from playslot_rl.speed.report import table
from playslot_rl.speed.steps import RandomStage, precisions

CASES = {
    "savi_step": {f"collapsed_{precision}_allocator" for precision in precisions("cpu")},
    "dynamics_step": {"fast", "fast_1_decoded"},
    "rollout_cache": {"cached"},
    "play_step": {"shipped", *(f"paper_{precision}" for precision in precisions("cpu"))},
    "plan_step": {"own"},
    "render": {"full", "fast"},
    "render_block_push": {"full", "fast"},
    "window_sampling": {"cache", "stream"},
    "verify": {"rate"},
    "export": {"rate"},
    "slot_cache": {"rate"},
}


def test_the_default_sizes_are_the_papers() -> None:
    sizes = Sizes()
    assert sizes.config.model == ModelConfig()
    assert sizes.rollout == (64, 15, 8)
    assert sizes.config.dynamics.seed_frames + sizes.config.dynamics.predicted_frames == 14
    assert (sizes.config.slots.batch_size, sizes.config.slots.clip_frames) == (2, 4)


@pytest.mark.parametrize("native", [True, False])
def test_what_the_processor_only_emulates_is_left_out(native: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(steps, "native_bf16", lambda _: native)
    assert precisions("cpu") == (("fp32", "bf16") if native else ("fp32",))


@pytest.mark.parametrize("stage", steps.STAGES)
def test_a_training_step_changes_the_weights(stage: str) -> None:
    step = RandomStage(quick_sizes().config, stage, CPU, "fp32").step()
    first = float(step())
    assert float(step()) != first


@pytest.mark.integration
def test_a_game_is_the_same_every_time() -> None:
    from playslot_rl.play.pictures import game
    from playslot_rl.runs import Run

    torch.manual_seed(0)
    play = game(Run.open("pretrained").load_world_model(), 2)
    assert float(play()) == float(play())


@pytest.mark.integration
def test_the_command_writes_every_key_with_its_medians(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bench.json"
    assert main(["bench", "preset=smoke", "threads=1", "--json", str(path)]) == 0
    figures = json.loads(path.read_text())
    machine = figures.pop("machine")
    assert machine["quick"] is True
    assert {name: {*entry} - {"unit"} for name, entry in figures.items()} == CASES
    assert all(value > 0 for entry in figures.values() for name, value in entry.items() if name != "unit")
    printed = capsys.readouterr().out
    assert table({**figures, "machine": machine}) in printed
    assert "say nothing about speed" in printed
    assert "| all stages |" in printed
