"""`playslot bench`: its keys and ratios, variants that all compute the same, losses that are the training stages'.

No test judges a speed: the figures of a busy machine mean nothing.
"""

from __future__ import annotations

import json
import math
import platform
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from playslot_rl.cli import main
from playslot_rl.config import DynamicsStageConfig, ModelConfig
from playslot_rl.errors import PlaySlotError
from playslot_rl.losses.common import total_loss
from playslot_rl.losses.dynamics import DynamicsLoss
from playslot_rl.losses.slots import SlotsLoss
from playslot_rl.modules.inverse_dynamics import InverseDynamics
from playslot_rl.modules.predictors.cocvp import COCVP
from playslot_rl.runtime.precision import resolve_precision
from playslot_rl.speed import cases
from playslot_rl.speed.cases import (
    Sizes,
    Variant,
    build_savi,
    build_step,
    computed_here,
    dynamics_loss,
    dynamics_variants,
    play_variants,
    quick_sizes,
    rollout_variants,
    savi_variants,
    slots_loss,
)
from playslot_rl.speed.race import start
from playslot_rl.speed.report import RATES, TARGETS, table
from playslot_rl.speed.several import teams

ALL = savi_variants() | dynamics_variants(1) | rollout_variants()


@pytest.fixture
def sizes() -> Sizes:
    return quick_sizes()


def test_the_default_sizes_are_the_papers() -> None:
    assert Sizes().model == ModelConfig()
    assert (Sizes().rollout_batch, Sizes().rollout_slots, Sizes().rollout_steps) == (64, 8, 15)
    assert Sizes().seed_frames + Sizes().predicted_frames == 14


def test_the_savi_rows_are_first_layer_times_precision_times_allocator() -> None:
    rows = {(v.collapse, v.precision, v.allocator) for v in savi_variants().values()}
    assert len(rows) == len(savi_variants()) == 8
    assert savi_variants()["plain_fp32_glibc"] == Variant("savi_step", False, "fp32", False, False)
    assert savi_variants()["collapsed_bf16_allocator"] == Variant("savi_step", precision="bf16")


@pytest.mark.parametrize("native", [True, False])
def test_what_the_processor_only_emulates_is_left_out(native: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases, "native_bf16", lambda _: native)
    left = computed_here(savi_variants() | play_variants())
    assert len(left) == (11 if native else 6)
    assert native or all(variant.precision == "fp32" for variant in left.values())


@pytest.mark.parametrize("case", ["savi_step", "dynamics_step", "rollout_cache"])
def test_every_variant_of_a_case_computes_the_same_thing(case: str, sizes: Sizes) -> None:
    variants = {name: v for name, v in ALL.items() if v.case == case and not v.decoded_frames}
    values = {name: float(build_step(v, sizes)()) for name, v in variants.items()}
    exact = [value for name, value in values.items() if variants[name].precision == "fp32"]
    assert exact == pytest.approx([exact[0]] * len(exact), rel=1e-5) if exact else len(values) == 2
    first = next(iter(values.values()))
    assert list(values.values()) == pytest.approx([first] * len(values), rel=0.02 if exact else 1e-5)
    assert math.isfinite(first)


@pytest.mark.integration
def test_a_game_is_the_same_whatever_it_is_computed_with(sizes: Sizes) -> None:
    rows = play_variants()
    shipped = [float(build_step(rows["shipped"], sizes)()) for _ in range(2)]
    assert shipped[0] == shipped[1]
    fp32, bf16 = (float(build_step(rows[name], sizes)()) for name in ("paper_fp32", "paper_bf16"))
    assert fp32 == pytest.approx(bf16, rel=0.02)


def test_a_training_step_changes_the_weights(sizes: Sizes) -> None:
    for variant in (Variant("savi_step"), Variant("dynamics_step")):
        step = build_step(variant, sizes)
        assert float(step()) != float(step())


def test_the_slots_loss_is_the_stages(sizes: Sizes) -> None:
    savi = build_savi(Variant("savi_step", precision="fp32"), sizes)
    frames = torch.rand(1, 2, 3, sizes.image_size, sizes.image_size)
    got = slots_loss(savi, frames, torch.Generator().manual_seed(1))
    expected = SlotsLoss(savi)(TensorDict({"pixels": frames}, [1]), generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(got, expected["loss_reconstruction"])


@pytest.mark.parametrize("decoded_frames", [0, 1])
def test_the_dynamics_loss_is_the_stages(decoded_frames: int, sizes: Sizes) -> None:
    torch.manual_seed(0)
    variant = Variant("dynamics_step", precision="fp32", decoded_frames=decoded_frames)
    savi = build_savi(variant, sizes)
    inverse = InverseDynamics(sizes.model.inverse_dynamics, 32, 4)
    inverse.split(torch.randn(64, inverse.latent_dim))  # sets the codebook
    inverse.quantizer.eval()  # which then stays as it is through both
    predictor = COCVP(sizes.model.predictor, 32, inverse.latent_dim)
    slots, frames = torch.randn(2, 4, 4, 32), torch.rand(2, 4, 3, sizes.image_size, sizes.image_size)
    got = dynamics_loss(inverse, predictor, savi, slots, frames, variant, 2, torch.Generator().manual_seed(1))
    config = DynamicsStageConfig(seed_frames=2, predicted_frames=2, decoded_frames=decoded_frames)
    loss = DynamicsLoss(inverse, predictor, savi, config)
    batch = TensorDict({"slots": slots, "pixels": frames}, [2])
    expected = total_loss(loss(batch, generator=torch.Generator().manual_seed(1)))
    torch.testing.assert_close(got, expected)


@pytest.mark.integration
def test_two_processes_share_the_batch_of_one(sizes: Sizes) -> None:
    variants = [variant for team in teams().values() for variant, _ in team]
    with ExitStack() as stack:
        children = [stack.enter_context(start(f"{v.rank} of {v.world}", v, sizes, 1)) for v in variants]
        losses = []
        for _ in range(2):
            for child in children:
                if not losses:
                    child.answer()
                child.begin()
            losses.append([child.answer()["value"] for child in children])
    assert losses[0] == pytest.approx([losses[0][0]] * 3, rel=1e-3)  # bf16
    assert losses[1] == pytest.approx([losses[1][0]] * 3, rel=1e-3)
    assert losses[0] != losses[1]


@pytest.mark.slow
def test_a_child_that_fails_ends_the_benchmark_with_one_line(sizes: Sizes) -> None:
    broken = replace(sizes, rollout_steps=0)
    with start("broken", Variant("rollout_cache"), broken, 1) as child:
        child.answer()
        with pytest.raises(PlaySlotError, match=r"variant broken: got ValueError\(.*expected a time"):
            child.ask()
    assert not child.process.is_alive()


@pytest.mark.integration
def test_a_child_that_is_killed_ends_the_benchmark_with_one_line(sizes: Sizes) -> None:
    with start("killed", Variant("rollout_cache"), sizes, 1) as child:
        child.answer()
        child.process.kill()
        with pytest.raises(PlaySlotError, match=r"variant killed: got exit code -9, expected a time.*memory"):
            child.ask()


@pytest.mark.integration
def test_each_child_has_its_own_allocator_setting_and_ends_with_its_block(sizes: Sizes) -> None:
    for allocator in (True, False, True):
        with start("x", Variant("rollout_cache", allocator=allocator), sizes, 1) as child:
            ready = child.answer()
            assert ready["threads"] == 1
            assert ready["allocator"] is (allocator and platform.libc_ver()[0] == "glibc")
            child.ask()
            assert child.seconds[0] > 0
        assert not child.process.is_alive()


@pytest.mark.integration
def test_the_command_writes_every_key_with_its_ratio_and_medians(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bench.json"
    assert main(["bench", "preset=smoke", "threads=1", "--json", str(path)]) == 0
    figures = json.loads(path.read_text())
    assert set(figures) == {*TARGETS, "machine"}
    pairs = {
        "savi_step": ("plain_fp32_glibc", f"collapsed_{resolve_precision('auto', 'cpu')}_allocator"),
        "dynamics_step": ("plain_fp32_glibc", "fast"),
        "rollout_cache": ("full", "cached"),
        "render": ("full", "fast"),
        "render_block_push": ("full", "fast"),
        "plan_step": ("torchrl", "own"),
        "ddp_2": ("one_process_two_threads", "two_processes"),
    }
    for key, (slow, fast) in pairs.items():
        assert figures[key]["ratio"] == pytest.approx(figures[key][slow] / figures[key][fast])
    sampling = figures["window_sampling"]
    assert sampling["ratio"] == pytest.approx(sampling["cache"] / sampling["lerobot"])
    assert set(figures["savi_step"]) == {"ratio", "unit", *computed_here(savi_variants())}
    played = figures["play_step"]
    assert set(played) == {"ratio", "unit", *computed_here(play_variants())}
    assert played["ratio"] == pytest.approx(1 / played["shipped"])
    assert set(sampling) == {"ratio", "unit", "cache", "stream", "lerobot"}
    for key, unit in RATES.items():
        assert figures[key] == {
            "ratio": figures[key]["rate"],
            "unit": unit,
            "rate": pytest.approx(figures[key]["rate"]),
        }
        assert figures[key]["rate"] > 0
    assert figures["machine"]["quick"] is True
    printed = capsys.readouterr().out
    assert table(figures) in printed
    assert all(f"`{key}`" in printed for key in TARGETS)
    assert "say nothing about speed" in printed
