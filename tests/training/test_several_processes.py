"""Training on several processes: the result does not depend on their number."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock, patch

import pytest
import torch
from ranks import launcher_variables, log_of, run_ranks
from replayed import Replayed, different
from tiny_stages import DOUBLE, STAGES, in_double

from playslot_rl.errors import CheckpointError, ConfigError, PeerError, TrainingError
from playslot_rl.runtime import processes
from playslot_rl.runtime.processes import agreed, claim, here, wait
from playslot_rl.storage.tensors import load_tensors, module_tensors, save_tensors
from playslot_rl.training import fit as fit_module
from playslot_rl.training import steps as steps_module
from playslot_rl.training.fit import fit
from playslot_rl.training.steps import Steps

pytestmark = pytest.mark.integration

SEED = 3
CURVE = 1e-5
"""Largest relative difference of a number that is logged while training."""
AT_ALL = 1e-6
"""Absolute difference that is none: numbers that are zero but for rounding."""
RESUMED = "dynamics"


def train(name: str, folder: Path) -> None:
    """One stage, to its end; each rank keeps what it ended with."""
    with in_double(name in DOUBLE):
        part = STAGES[name]()
        fit(part, folder, seed=SEED)
        save_tensors(folder / f"rank{here().rank}.safetensors", module_tensors(part.stage.modules))


def interrupted(whole: Path, folder: Path) -> Path:
    """A training as it was when a kill ended it after half its steps."""
    shutil.copytree(whole, folder)
    shutil.rmtree(folder / "checkpoints" / "step_00000020")
    return folder


def train_all(folder: Path) -> None:
    """Every stage, one after the other, in one process group, and one of them once more from half its way on."""
    for name in STAGES:
        train(name, folder / name)
    if here().first:
        interrupted(folder / RESUMED, folder / "resumed")
    wait()
    train(RESUMED, folder / "resumed")


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of all stages trained by this process."""
    folder = tmp_path_factory.mktemp("alone")
    train_all(folder)
    return folder


@pytest.fixture(scope="module", params=[2, pytest.param(3, marks=pytest.mark.slow)])
def several(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same by so many ranks."""
    folder: Path = tmp_path_factory.mktemp(f"ranks{request.param}")
    assert run_ranks(request.param, train_all, folder) == [0] * request.param
    return folder


def disagree(folder: Path) -> None:
    """Each rank looks into a folder of its own, of which one holds a training and the other none."""
    with pytest.raises(CheckpointError, match=r"got checkpoints of steps 10, 0 on ranks 0 to 1, expected one: out="):
        fit(STAGES["policy"](), folder / str(here().rank), seed=SEED)


def test_ranks_that_find_checkpoints_of_different_steps_are_refused(alone: Path, tmp_path: Path) -> None:
    interrupted(alone / "policy", tmp_path / "0")
    assert run_ranks(2, disagree, tmp_path) == [0, 0]


def claims() -> None:
    assert sum(agreed(claim("error"))) == 1
    assert sum(agreed(claim("error"))) == 0
    assert sum(agreed(claim("another"))) == 1


def test_one_rank_has_what_all_of_them_claim() -> None:
    assert run_ranks(3, claims) == [0, 0, 0]
    assert [claim("error"), claim("error")] == [True, True]  # a process alone


def test_more_processes_than_gpus_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in launcher_variables(1, 3, 1).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(ConfigError, match=r"got 3 processes on a machine with 2 GPUs, .*--nproc-per-node=2"):
        processes.start()


@pytest.mark.parametrize(
    ("said", "kept"),
    [
        ("Connection closed by peer [127.0.0.1]:1", "minutes; its own"),
        ("NCCL error in: a.cpp:1\nLast error:\nDuplicate GPU detected : rank 0 and 1", "minutes (NCCL: Duplicate GPU"),
    ],
)
def test_a_failed_exchange_is_one_line_with_what_nccl_adds(said: str, kept: str) -> None:
    with pytest.raises(PeerError) as failed, processes._exchange():
        raise RuntimeError(said)
    assert kept in str(failed.value)
    assert "\n" not in str(failed.value)


def accumulated(folder: Path) -> None:
    part = STAGES["dynamics"]()
    optim = replace(part.config.optim, accumulate=MICROS[here().world], ema=0.9)
    fit(replace(part, config=replace(part.config, steps=6, optim=optim)), folder, seed=SEED)


MICROS = {1: 1, 2: 3}
"""By number of ranks."""


def test_micro_batches_and_an_average_on_two_ranks_are_those_of_one(tmp_path: Path) -> None:
    accumulated(tmp_path / "one")
    assert run_ranks(2, accumulated, tmp_path / "two") == [0, 0]
    for one, other in zip(log_of(tmp_path / "one"), log_of(tmp_path / "two"), strict=True):
        assert other["loss" if "loss" in one else "psnr"] == pytest.approx(
            one["loss" if "loss" in one else "psnr"], rel=10 * CURVE
        )


def replayed(folder: Path) -> None:
    """Steps as they are written, and as a graph takes them: micro-batches, and a codebook beside BatchNorm."""
    for name, micros in (("dynamics", 3), ("lapo", 1)):
        ended = []
        for steps in (Steps, Replayed):
            part = STAGES[name]()
            config = replace(part.config, steps=8, optim=replace(part.config.optim, accumulate=micros))
            with patch.object(fit_module, "Steps", steps):
                fit(replace(part, config=config), folder / steps.__name__ / name, seed=SEED)
            ended.append(module_tensors(part.stage.modules))
        assert different(*ended) == set()
    assert Replayed.replays > 0


def test_replayed_steps_of_two_ranks_are_the_written_ones(tmp_path: Path) -> None:
    assert run_ranks(2, replayed, tmp_path) == [0, 0]


class _Recorded(Steps):
    """Steps that are recorded as on a GPU."""

    def _captures(self) -> bool:
        return True

    def _recorded(self, compute: Any) -> Any:
        self._stream = Mock()
        try:
            return super()._recorded(compute)
        finally:
            self._stream = None


def one_fails(folder: Path) -> None:
    """Only rank 0 can record a step, and none is replayed."""

    def recorded(*_: Any) -> tuple[Mock, dict[str, torch.Tensor]]:
        if here().rank == 1:
            raise RuntimeError("operation not permitted")
        return Mock(side_effect=AssertionError("replayed without the other")), {}

    def ended(execution: str, steps: type[Steps]) -> dict[str, torch.Tensor]:
        part = STAGES["decoder"]()
        with patch.object(fit_module, "Steps", steps), patch.object(steps_module, "recorded", recorded):
            config = replace(part.config, execution=execution)  # type: ignore[arg-type]
            fit(replace(part, config=config), folder / f"{execution} {steps.__name__}", seed=SEED)
        return module_tensors(part.stage.modules)

    why = "could not be captured at .*: operation" if here().rank else "another process could not capture"
    with pytest.raises(TrainingError, match=why):
        ended("graph", _Recorded)
    with pytest.warns(RuntimeWarning, match=why):
        refused = ended("auto", _Recorded)
    assert different(refused, ended("auto", Steps)) == set()


def test_ranks_of_which_one_cannot_record_a_step_end_or_go_on_together(tmp_path: Path) -> None:
    assert run_ranks(2, one_fails, tmp_path) == [0, 0]


def difference(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> float:
    assert one.keys() == other.keys()
    return max(float((one[key].double() - other[key].double()).abs().max()) for key in one if one[key].numel())


@pytest.mark.parametrize("name", STAGES)
def test_the_curve_is_that_of_one_process(alone: Path, several: Path, name: str) -> None:
    ones, shares = log_of(alone / name), log_of(several / name)
    assert [(row["step"], row["split"]) for row in ones] == [(row["step"], row["split"]) for row in shares]
    for one, shared in zip(ones, shares, strict=True):
        tolerance = CURVE if one.pop("split") == "train" else 10 * CURVE
        del shared["split"]
        assert shared == pytest.approx(one, rel=tolerance, abs=AT_ALL)


@pytest.mark.parametrize("name", STAGES)
def test_all_ranks_end_with_the_same_weights(several: Path, name: str) -> None:
    first, *others = [load_tensors(path) for path in sorted((several / name).glob("rank*.safetensors"))]
    assert others
    for other in others:
        assert [key for key in first if not torch.equal(first[key], other[key])] == []


def test_a_killed_training_resumes_bit_for_bit_on_as_many_ranks(several: Path) -> None:
    whole, resumed = several / RESUMED, several / "resumed"
    first, second = load_tensors(whole / "rank0.safetensors"), load_tensors(resumed / "rank0.safetensors")
    assert difference(first, second) == 0
    assert log_of(whole) == log_of(resumed)


def test_a_training_of_several_ranks_is_carried_on_by_one(several: Path, tmp_path: Path) -> None:
    folder = interrupted(several / RESUMED, tmp_path / "resumed")
    train(RESUMED, folder)
    whole, carried_on = (load_tensors(path / "rank0.safetensors") for path in (several / RESUMED, folder))
    assert 0 < difference(whole, carried_on) < 1e-4
