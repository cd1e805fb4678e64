"""Training on several processes: the result does not depend on their number."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from ranks import log_of, run_ranks
from tiny_stages import DOUBLE, STAGES, in_double

from playslot_rl.processes import here, wait
from playslot_rl.storage.tensors import load_tensors, module_tensors, save_tensors
from playslot_rl.training.fit import fit

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
def trained(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """The folder of all stages trained by one, two and three ranks."""
    folders = {world: tmp_path_factory.mktemp(f"ranks{world}") for world in (1, 2, 3)}
    train_all(folders[1])
    for world in (2, 3):
        assert run_ranks(world, train_all, folders[world]) == [0] * world
    return folders


def difference(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> float:
    assert one.keys() == other.keys()
    return max(float((one[key].double() - other[key].double()).abs().max()) for key in one if one[key].numel())


@pytest.mark.parametrize("world", [2, 3])
@pytest.mark.parametrize("name", STAGES)
def test_the_curve_is_that_of_one_process(trained: dict[int, Path], name: str, world: int) -> None:
    one, several = log_of(trained[1] / name), log_of(trained[world] / name)
    assert [(row["step"], row["split"]) for row in one] == [(row["step"], row["split"]) for row in several]
    for alone, shared in zip(one, several, strict=True):
        tolerance = CURVE if alone.pop("split") == "train" else 10 * CURVE
        del shared["split"]
        assert shared == pytest.approx(alone, rel=tolerance, abs=AT_ALL)


@pytest.mark.parametrize("world", [2, 3])
@pytest.mark.parametrize("name", STAGES)
def test_all_ranks_end_with_the_same_weights(trained: dict[int, Path], name: str, world: int) -> None:
    first, *others = [load_tensors(trained[world] / name / f"rank{rank}.safetensors") for rank in range(world)]
    for other in others:
        assert [key for key in first if not torch.equal(first[key], other[key])] == []


@pytest.mark.parametrize("world", [1, 2, 3])
def test_a_killed_training_resumes_bit_for_bit_on_as_many_ranks(trained: dict[int, Path], world: int) -> None:
    whole, resumed = trained[world] / RESUMED, trained[world] / "resumed"
    first, second = load_tensors(whole / "rank0.safetensors"), load_tensors(resumed / "rank0.safetensors")
    assert difference(first, second) == 0
    assert log_of(whole) == log_of(resumed)


def test_a_training_of_three_ranks_is_carried_on_by_one(trained: dict[int, Path], tmp_path: Path) -> None:
    folder = interrupted(trained[3] / RESUMED, tmp_path / "resumed")
    train(RESUMED, folder)
    three, one = (load_tensors(path / "rank0.safetensors") for path in (trained[3] / RESUMED, folder))
    assert 0 < difference(three, one) < 1e-4
