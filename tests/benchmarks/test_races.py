"""The fast paths compute what the plain ones do (quick), and are quicker (slow; on an idle machine).

`pytest -m slow -s tests/benchmarks` prints the ratios that docs/results/speed.md shows.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Generator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from racing import children, loss, race
from variants import Variant, build_step, dynamics_variants, rollout_variants, savi_variants, torchrl_search

from playslot_rl import keys
from playslot_rl.runtime.precision import native_bf16, resolve_precision
from playslot_rl.runtime.threads import available_cores
from playslot_rl.speed.cases import Sizes, plan_step, quick_sizes
from playslot_rl.speed.sets import window_readers, write_journal
from playslot_rl.speed.timing import in_turns, seconds

FAST_SAVI = f"collapsed_{resolve_precision('auto', 'cpu')}_allocator"


def test_the_savi_rows_are_first_layer_times_precision_times_allocator() -> None:
    rows = {(v.collapse, v.precision, v.allocator) for v in savi_variants().values()}
    assert len(rows) == len(savi_variants()) == 8
    assert savi_variants()["plain_fp32_glibc"] == Variant("savi_step", False, "fp32", False, False)


@pytest.mark.integration
@pytest.mark.parametrize("variants", [savi_variants(), dynamics_variants(), rollout_variants()])
def test_every_variant_of_a_case_computes_the_same_thing(variants: dict[str, Variant]) -> None:
    sizes = quick_sizes()
    values = {name: float(build_step(variant, sizes)()) for name, variant in variants.items()}
    exact = [value for name, value in values.items() if variants[name].precision == "fp32"]
    assert exact == pytest.approx([exact[0]] * len(exact), rel=1e-5) if exact else len(values) == 2
    first = next(iter(values.values()))
    assert list(values.values()) == pytest.approx([first] * len(values), rel=0.02 if exact else 1e-5)
    assert math.isfinite(first)


@pytest.mark.slow
def test_two_processes_share_the_batch_of_one() -> None:
    shared = Variant("ddp_2")
    with children({"one": [shared], "two": [shared] * 2}, quick_sizes(), 2) as running:
        for _ in range(2):
            answers = [child.submit(loss) for team in running.values() for child in team]
            losses = [answer.result() for answer in answers]
            assert losses == pytest.approx([losses[0]] * 3, rel=1e-3)  # bf16


def won(what: str, took: dict[str, float], slow: str, fast: str) -> None:
    """Print a race, and hold that it was won."""
    shown = ", ".join(f"{name} {value * 1000:.1f} ms" for name, value in took.items())
    print(f"{what}: {took[slow] / took[fast]:.1f} ({shown})")
    assert took[fast] < took[slow]


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("what", "variants", "slow", "fast"),
    [
        ("savi_step", savi_variants(), "plain_fp32_glibc", FAST_SAVI),
        ("dynamics_step", dynamics_variants(), "plain_fp32_glibc", "fast"),
        ("rollout_cache", rollout_variants(), "full", "cached"),
    ],
)
def test_the_fast_path_is_quicker(what: str, variants: dict[str, Variant], slow: str, fast: str) -> None:
    here = {name: [v] for name, v in variants.items() if v.precision != "bf16" or native_bf16("cpu")}
    won(what, race(here, Sizes()), slow, fast)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_two_processes_take_no_more_than_half_as_long_again() -> None:
    shared = Variant("ddp_2")
    took = race({"one_process_two_threads": [shared], "two_processes": [shared] * 2}, Sizes(), 2)
    print(f"ddp_2: {took['one_process_two_threads'] / took['two_processes']:.1f}")
    assert took["two_processes"] < 1.5 * took["one_process_two_threads"]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_our_search_is_quicker_than_that_of_torchrl() -> None:
    sizes = Sizes()
    won("plan_step", {"torchrl": seconds(torchrl_search(sizes)), **plan_step(sizes)}, "torchrl", "own")


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_windows_come_quicker_from_the_cache_than_from_the_loader(tmp_path: Path) -> None:
    from playslot_rl.collectors.export import export

    sizes = Sizes()
    export(write_journal(tmp_path / "journal", sizes), tmp_path / "set")
    took = in_turns(window_readers(tmp_path / "set", tmp_path / "cache", sizes), 1)
    with contextlib.closing(lerobot_batches(tmp_path / "set", sizes)) as batches:
        for _ in range(2 * available_cores()):  # what the workers read ahead while they start
            next(batches)
        took["lerobot"] = seconds(partial(next, batches), 6)
    won("window_sampling", took, "lerobot", "cache")


def lerobot_batches(root: Path, sizes: Sizes) -> Generator[torch.Tensor]:
    """Batches as LeRobot's own training reads them, for ever."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
    from torch.utils.data import DataLoader, RandomSampler

    fps = LeRobotDatasetMetadata("playslot/bench", root=root).fps
    offsets = {keys.FEATURE_IMAGE: [t / fps for t in range(sizes.window)]}
    dataset: Any = LeRobotDataset("playslot/bench", root=root, delta_timestamps=offsets, video_backend="pyav")
    sampler = RandomSampler(dataset, replacement=True, num_samples=1_000_000_000)
    loader: Any = DataLoader(
        dataset, sizes.window_batch, sampler=sampler, num_workers=available_cores(), multiprocessing_context="fork"
    )
    for batch in loader:
        yield batch[keys.FEATURE_IMAGE]
