"""A step computes from its batch and its random numbers alone: so it can be recorded once and replayed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from ranks import alone_in_a_group, log_of
from replayed import Replayed, different
from tiny_stages import BY_BATCH, CADDY_STEPS, STAGES, STEPS
from torch import Tensor
from waits import no_waits

from playslot_rl.errors import ConfigError
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.storage.tensors import module_tensors
from playslot_rl.training import fit as fit_module
from playslot_rl.training.fit import Part, fit
from playslot_rl.training.stage import PhasedStage, step_loss
from playslot_rl.training.steps import WARM


def trained(name: str, folder: Path, **optim: Any) -> dict[str, Tensor]:
    part = STAGES[name]()
    config = replace(part.config, optim=replace(part.config.optim, **optim))
    fit(replace(part, config=config), folder, seed=3)
    return module_tensors(part.stage.modules)


@pytest.mark.parametrize("name", STAGES)
def test_a_replayed_step_is_the_step(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = trained(name, tmp_path / "written")
    monkeypatch.setattr(fit_module, "Steps", Replayed)
    monkeypatch.setattr(Replayed, "replays", 0)
    replayed = trained(name, tmp_path / "replayed")
    assert different(written, replayed) == set()
    steps = {"caddy": CADDY_STEPS, "resnet": 2}.get(name, STEPS)
    stage = STAGES[name]().stage
    phases = [stage.phase(step) if isinstance(stage, PhasedStage) else "all" for step in range(steps)]
    expected = sum(max(0, phases.count(phase) - WARM) for phase in set(phases) if phase is not None)
    assert Replayed.replays == expected
    assert expected > 0 or name in ("caddy", "resnet")


@pytest.mark.integration
@pytest.mark.parametrize("name", [name for name in STAGES if name not in BY_BATCH])
def test_a_replayed_step_in_micro_batches_is_the_step(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = trained(name, tmp_path / "written", accumulate=2)
    monkeypatch.setattr(fit_module, "Steps", Replayed)
    monkeypatch.setattr(Replayed, "replays", 0)
    assert different(written, trained(name, tmp_path / "replayed", accumulate=2)) == set()
    assert log_of(tmp_path / "written") == log_of(tmp_path / "replayed")
    assert Replayed.replays > 0


def test_a_replayed_step_exchanges(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = trained("decoder", tmp_path / "alone")
    with alone_in_a_group("gloo"):
        written = trained("decoder", tmp_path / "written")
        monkeypatch.setattr(fit_module, "Steps", Replayed)
        replayed = trained("decoder", tmp_path / "replayed")
    assert different(written, replayed) == different(written, alone) == set()


class Refused(Replayed):
    """Steps that cannot be recorded."""

    def _recorded(self, compute: Callable[[], dict[str, Tensor]]) -> None:  # type: ignore[override]
        self.captures = False


def test_what_cannot_be_recorded_is_taken_as_it_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = trained("dynamics", tmp_path / "written")
    monkeypatch.setattr(fit_module, "Steps", Refused)
    refused = trained("dynamics", tmp_path / "refused")
    assert different(written, refused) == set()


@pytest.mark.parametrize("name", STAGES)
def test_a_step_never_waits_for_a_value(name: str) -> None:
    stage = STAGES[name]().stage
    for step in (0, STEPS - 1):  # the codebook starts in the first one, which is never replayed
        generators = StepGenerators(3, step)
        batch = stage.batch(step, generators)
        with no_waits() if step else contextlib.nullcontext():
            stage.loss(batch, step, generators)["loss"].backward()


def test_a_graph_is_refused_without_a_gpu(tmp_path: Path) -> None:
    part = STAGES["policy"]()
    asked = Part(part.name, part.stage, part.config.__class__(**{**vars(part.config), "execution": "graph"}))
    with pytest.raises(ConfigError, match=r"policy.execution=graph: got device cpu, expected cuda: use .*=auto"):
        fit(asked, tmp_path, seed=3)


def test_the_batch_of_a_step_is_a_function_of_seed_and_step() -> None:
    for name, make in STAGES.items():
        one, other = make().stage, make().stage
        for key, value in one.batch(5, StepGenerators(3, 5)).items():
            assert torch.equal(value, other.batch(5, StepGenerators(3, 5))[key]), (name, key)
        assert step_loss(one, 0, StepGenerators(3, 0))["loss"].dim() == 0
