"""What a training step costs: counts against known sums, straight lines in the batch, and what is made of them."""

from __future__ import annotations

from dataclasses import replace
from types import MethodType

import pytest
import torch
from torch import nn

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import compose
from playslot_rl.errors import ConfigError
from playslot_rl.modules.savi import SAVi
from playslot_rl.speed import cost, report, steps
from playslot_rl.speed.cost import Count, Machine, StageCost, estimate, stage_cost
from playslot_rl.speed.timing import seconds


@pytest.fixture(scope="module")
def config() -> ExperimentConfig:
    return compose(["preset=smoke"])


@pytest.fixture(scope="module")
def costs(config: ExperimentConfig) -> dict[str, StageCost]:
    return {stage: stage_cost(config, stage) for stage in steps.STAGES}


class _Squares(nn.Module):
    """A linear map of which products and bytes are known."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.rand(5, 7))

    def forward(self, x: torch.Tensor) -> dict[str, torch.Tensor]:
        return {"loss_x": (x @ self.weight).sum()}


def test_a_product_counts_two_a_multiplication_and_what_it_keeps_for_its_gradient() -> None:
    count = cost._count(_Squares(), torch.rand(3, 5))  # type: ignore[arg-type]
    assert count.flops == 2 * (2 * 3 * 5 * 7)  # forward, and the weight's gradient; the input has none
    assert count.kept == 4 * 3 * 5  # the input; the weight is no activation


@pytest.mark.integration
@pytest.mark.parametrize("stage", steps.STAGES)
def test_every_count_is_a_straight_line_in_the_batch(
    config: ExperimentConfig, costs: dict[str, StageCost], stage: str
) -> None:
    found = costs[stage]
    agent = steps.fresh_agent(config)
    criterion, batch_of = steps.parts(config, stage, agent)
    steps.begin(criterion, batch_of(2))
    straight, direct = found.at(5), cost._count(criterion, batch_of(5))
    assert straight.flops == direct.flops
    assert straight.kept == pytest.approx(direct.kept, rel=1e-3)  # the codebook's bookkeeping
    assert straight.calls == pytest.approx(direct.calls, rel=0.05)  # a dead code is revived
    trained = {"slots": agent.world_model.savi, "policy": agent.policy, "decoder": agent.action_decoder}
    if stage in trained:
        assert found.parameters == sum(p.numel() for p in trained[stage].parameters() if p.requires_grad)
        assert found.frozen == 0
    else:
        assert found.frozen == sum(p.numel() for p in agent.world_model.savi.parameters())


def test_an_unknown_stage_is_refused(config: ExperimentConfig) -> None:
    with pytest.raises(ValueError, match=r"stage: got all, expected one of slots, dynamics, policy, decoder"):
        stage_cost(config, "all")


def test_time_is_that_of_arithmetic_or_of_calls_and_of_one_exchange() -> None:
    machine = Machine(teraflops=1.0, call_us=10.0, gigabytes_s=1.0, exchange_us=100.0)
    heavy = StageCost("slots", 10, 4, 1_000_000, 0, Count(2e12, 100, 0), Count(3e12, 100, 0))
    assert estimate(heavy, 1, machine) == pytest.approx(4.0)
    assert estimate(heavy, 2, machine) == pytest.approx(2.0 + 4e6 / 1e9 + 1e-4)
    light = StageCost("slots", 10, 4, 0, 0, Count(2.0, 1000, 0), Count(3.0, 1000, 0))
    assert estimate(light, 1, machine) == pytest.approx(0.01)
    assert estimate(light, 4, machine) == pytest.approx(0.01 + 1e-4), "calls are as many with a share of the batch"


def test_memory_is_weights_gradients_adam_and_what_is_kept() -> None:
    own = StageCost("slots", 10, 4, 100, 50, Count(0, 0, 2000), Count(0, 0, 3000))
    assert own.memory(4) == 4 * (4 * 100 + 50) + 4000


def test_the_tables_have_a_row_a_stage_and_name_what_is_assumed(costs: dict[str, StageCost]) -> None:
    counted, estimated = report.counted([*costs.values()]), report.estimated([*costs.values()], Machine())
    for stage in steps.STAGES:
        assert f"| {stage} | {costs[stage].parameters:,} |" in counted
        assert f"| {stage} |" in estimated
    assert "Estimated, assuming 20 TFLOP/s sustained a device" in estimated
    assert "| all stages |" in estimated


def test_steps_are_timed_in_a_row_and_those_before_are_not_counted() -> None:
    calls: list[int] = []
    assert seconds(lambda: calls.append(1), 5) > 0
    assert len(calls) == 7


@pytest.mark.parametrize("stage", steps.STAGES)
def test_what_is_trained_is_compiled_when_asked_for(
    config: ExperimentConfig, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled: list[nn.Module] = []

    def as_it_is(method: MethodType, **_: object) -> MethodType:
        compiled.append(method.__self__)
        return method

    monkeypatch.setattr(torch, "compile", as_it_is)
    steps.time_step(config, stage, torch.device("cpu"), "fp32", 2, 1, True)
    assert compiled
    assert all(isinstance(part, SAVi) or any(p.requires_grad for p in part.parameters()) for part in compiled)
    if stage == "dynamics":
        compiled.clear()
        steps.time_step(config, stage, torch.device("cpu"), "fp32", 2, 1, "savi")
        assert all(isinstance(part, SAVi) for part in compiled)
    seen = len(compiled)
    took, peak = steps.time_step(config, stage, torch.device("cpu"), "fp32", 2, 1)
    assert (len(compiled), peak) == (seen, None)
    assert took > 0


@pytest.mark.parametrize(("stage", "key"), [("slots", "slots"), ("decoder", "behaviour")])
def test_without_a_compiler_the_setting_to_leave_out_is_named(
    config: ExperimentConfig, stage: str, key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ConfigError, match=rf"^{key}\.compile=true: got no C\+\+ compiler"):
        steps.time_step(config, stage, torch.device("cpu"), "fp32", 2, 1, True)


def test_a_step_is_captured_on_a_gpu_alone(config: ExperimentConfig) -> None:
    with pytest.raises(ConfigError, match=r"dynamics\.execution=graph: got device cpu, expected cuda"):
        steps.time_step(config, "dynamics", torch.device("cpu"), "fp32", 2, 1, execution="graph")


def test_a_step_of_an_unknown_stage_is_not_timed(config: ExperimentConfig) -> None:
    with pytest.raises(ValueError, match="stage: got all"):
        steps.time_step(config, "all", torch.device("cpu"), "fp32", batch=2)


@pytest.mark.parametrize("native", [True, False])
def test_the_measured_table_has_a_row_a_stage_and_precision(
    config: ExperimentConfig, costs: dict[str, StageCost], monkeypatch: pytest.MonkeyPatch, native: bool
) -> None:
    def half_a_second(*args: object) -> tuple[float, None]:
        return 0.25 if args[-1] else 0.5, None

    monkeypatch.setattr(steps, "time_step", half_a_second)
    monkeypatch.setattr(steps, "native_bf16", lambda _: native)
    own = replace(config, slots=replace(config.slots, compile=True))
    table = report.measured(own, [*costs.values()], torch.device("cpu"), lambda _: None)
    for stage in steps.STAGES:
        batch = min(costs[stage].batch, report.CPU_BATCH)
        rate = costs[stage].at(batch).flops / 0.5 / 1e12
        for precision in ("fp32", "bf16"):
            row = f"| {stage} | {precision} | {batch} | 0.5 | {rate:.3g} |"
            assert (row in table) == (native or precision == "fp32")
            row = f"| {stage} | {precision}, compiled | {batch} | 0.25 | {2 * rate:.3g} |"
            assert (row in table) == (stage == "slots" and (native or precision == "fp32"))
