"""`playslot bench device=cuda`: what it times and what it makes of it. Here without a GPU, on one in `tests/gpu`."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from playslot_rl.cli import main
from playslot_rl.config import Precision
from playslot_rl.runtime import captured
from playslot_rl.speed import gpu
from playslot_rl.speed.cases import CPU, quick_sizes

CUDA = torch.device("cuda")


def figures() -> Any:
    found = gpu.empty()
    found["savi_step"] |= {"paper_fp32_eager": 0.4, "paper_fp32_captured": 0.3}
    found["savi_step"] |= {"paper_bf16_eager": 0.2, "paper_bf16_captured": 0.1, "paper_bf16_compiled": 0.05}
    found["savi_step_memory"] |= {"paper_bf16_captured": 12.0, "paper_bf16_compiled": 10.4}
    found["savi_step_arithmetic"]["paper"], found["savi_step_batch"]["paper"] = 20.0, 64
    found["play_step"]["compact_bf16_captured"] = 0.0123456
    own = {"gpu": "a GPU", "torch": "2.11.0", "cpu": "a CPU", "cores": 16, "repeats": 10, "peak_tflops": 800.0}
    return {**found, "machine": own}


def test_a_row_is_a_precision_and_its_memory_and_share_are_those_of_the_quickest_way() -> None:
    assert gpu.rows(figures()) == [
        ["`savi_step`", "paper", "fp32", 64, 400, 300, 1.33, None, None, 8.33],
        ["`savi_step`", "paper", "bf16", 64, 200, 100, 2, 50, 10.4, 50],
        ["`play_step`", "compact", "bf16", None, None, 12.3, None, None, None, None],
    ]
    table = gpu.table(figures())
    assert "| `savi_step` | paper | bf16 | 64 | 200.0 ms | 100.0 ms | 2.0 | 50.0 ms | 10.4 GiB | 50.0 % |" in table
    assert "a GPU, torch 2.11.0, a CPU, 16 cores" in table


def test_the_papers_networks_are_also_compiled_and_a_search_has_one_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    both: tuple[Precision, ...] = ("fp32", "bf16")
    monkeypatch.setattr(gpu, "precisions", lambda _: both)
    ways = {case: gpu.variants(case, "paper", CUDA) for case in gpu.CASES}
    assert ways["policy_step"] == [(precision, way) for precision in both for way in ("eager", "captured")]
    assert ways["savi_step"] == [*ways["policy_step"], ("bf16", "compiled")]
    assert ways["plan_step"] == [("fp32", "eager"), ("fp32", "captured")]
    assert gpu.variants("savi_step", "compact", CUDA) == ways["policy_step"] == ways["play_step"]
    assert gpu.variants("dynamics_step", "paper", CPU) == [("fp32", "eager"), ("bf16", "eager")]


@pytest.mark.integration
def test_every_case_has_its_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "precisions", lambda _: ("fp32",))
    said: list[str] = []
    found = gpu.measure(CPU, 1, quick=True, say=said.append)
    peak = found.pop("machine")["peak_tflops"]
    assert {name: entry.pop("unit") for name, entry in found.items()} == {
        f"{case}{of}": unit for case in gpu.CASES for of, unit in gpu.UNITS.items()
    }
    for case in gpu.CASES:
        assert found[case].keys() == {"smoke_fp32_eager"}
        assert found[f"{case}_arithmetic"]["smoke"] > 0
        share = found[f"{case}_arithmetic"]["smoke"] / found[case]["smoke_fp32_eager"] / peak
        assert found[f"{case}_share"] == {"smoke_fp32_eager": pytest.approx(100 * share)}
    assert not any("left out" in line for line in said)


@pytest.mark.integration
def test_what_does_not_fit_is_said_and_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(case: str, *_: object) -> tuple[float, None]:
        if case == "savi_step":
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 GiB")
        return 1.0, None

    monkeypatch.setattr(gpu, "_timed", full)
    said: list[str] = []
    found = gpu.measure(CPU, 1, quick=True, say=said.append)
    assert found["savi_step"] == {"unit": "s"}
    assert found["policy_step"]["smoke_fp32_eager"] == 1.0
    assert any("smoke_fp32_eager is left out: got too little memory" in line for line in said)


@pytest.mark.parametrize("case", ["plan_step", "play_step"])
def test_searches_and_games_are_timed_without_and_with_captured_functions(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[bool] = []

    def timed(make: Any, *_: object) -> tuple[float, None]:
        assert make()().isfinite().all()
        seen.append(captured._capturing.get())
        return 1.0, None

    monkeypatch.setattr(gpu, "timed", timed)
    sizes = quick_sizes()
    took = [gpu._timed(case, sizes.config, sizes, CPU, "fp32", way)[0] for way in ("eager", "captured")]
    assert seen == [False, True]
    assert took == [1 / (gpu.FRAMES if case == "play_step" else 1)] * 2


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_the_command_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "preset=smoke", "device=cuda"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("playslot bench: error: device=cuda: ")
    assert error.count("\n") == 1
