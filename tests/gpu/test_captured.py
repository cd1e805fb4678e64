"""Steps on a GPU: captured ones are the written ones, and none of them waits (`make test-gpu`)."""

from __future__ import annotations

import copy
import shutil
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import tiny_stages
import torch
from ranks import alone_in_a_group
from tiny_stages import BY_BATCH, CADDY_STEPS, OPTIM, STAGES, in_double
from torch import Tensor

from playslot_rl.acting.imagination import ImaginationSession
from playslot_rl.config import StageConfig
from playslot_rl.errors import ConfigError, TrainingError
from playslot_rl.runtime.captured import Captured
from playslot_rl.seeds.draws import step_generator
from playslot_rl.storage.tensors import module_tensors
from playslot_rl.training.batches import GlobalBatches
from playslot_rl.training.fit import Part, fit
from playslot_rl.training.optimizer import build_adam, trainable_parameters
from playslot_rl.training.stage import PhasedStage
from playslot_rl.training.steps import Steps

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]

STEPS = 50
SAME = 1e-5
"""Largest difference of a tensor after training, relative to its largest number."""
IN_DOUBLE = ("caddy", "dynamics of many agents")
"""In double precision: two trainings that are written alike part in fp32, too, whose sums have no fixed order."""
NO_GRADIENT = "inverse_dynamics.to_mean.bias"
"""It cancels in the differences of means: its gradient is rounding alone, which Adam makes steps of."""


@pytest.fixture(autouse=True)
def on_the_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiny_stages, "DEVICE", torch.device("cuda"))
    monkeypatch.setattr(torch.backends.cudnn, "deterministic", True)
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)


def part_of(name: str, **settings: Any) -> Part:
    part = STAGES[name]()
    steps = CADDY_STEPS if name == "caddy" else STEPS
    config = replace(part.config, steps=steps, checkpoint_every=steps // 2, validate_every=steps // 2, **settings)
    if isinstance(getattr(part.stage, "config", None), StageConfig):
        part.stage.config = config  # type: ignore[attr-defined]
    return replace(part, config=config)


def trained(name: str, folder: Path, execution: str, **settings: Any) -> dict[str, Tensor]:
    with in_double(name in IN_DOUBLE):
        part = part_of(name, execution=execution, **settings)
        fit(part, folder, seed=3, device="cuda")
        return {key: value.cpu().clone() for key, value in module_tensors(part.stage.modules).items()}


def difference(one: dict[str, Tensor], other: dict[str, Tensor]) -> float:
    assert one.keys() == other.keys()
    return max(
        float((one[key].double() - other[key].double()).abs().max() / one[key].double().abs().max().clamp(min=1e-3))
        for key in one
        if key != NO_GRADIENT
    )


@pytest.mark.parametrize("name", STAGES)
def test_captured_steps_end_with_the_weights_of_the_written_ones(name: str, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".* could not be captured", category=RuntimeWarning)
        captured = trained(name, tmp_path / "graph", "auto")
    assert difference(trained(name, tmp_path / "eager", "eager"), captured) <= SAME


@pytest.mark.parametrize("name", [name for name in STAGES if name not in BY_BATCH])
def test_micro_batches_are_captured(name: str, tmp_path: Path) -> None:
    optim = replace(OPTIM, accumulate=2)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".* launched one by one", category=RuntimeWarning)
        captured = trained(name, tmp_path / "graph", "auto", optim=optim)
    assert difference(trained(name, tmp_path / "eager", "eager", optim=optim), captured) <= SAME


@pytest.mark.parametrize("name", ["slots", "dynamics", "lapo"])
def test_exchanges_of_nccl_are_captured(name: str, tmp_path: Path) -> None:
    """Those of one process; the second training has a communicator from the first, as after a validation."""
    with alone_in_a_group("nccl"):
        eager = trained(name, tmp_path / "eager", "eager")
        captured = trained(name, tmp_path / "graph", "graph")
        with pytest.warns(RuntimeWarning, match=r"got 1 processes, .* by .*\.execution=graph alone"):
            trained(name, tmp_path / "auto", "auto")
    assert difference(eager, captured) <= SAME


def test_exchanges_of_gloo_are_refused(tmp_path: Path) -> None:
    with alone_in_a_group("gloo"), pytest.raises(ConfigError, match=r"got processes that do not meet by NCCL"):
        trained("decoder", tmp_path, "graph")


@pytest.mark.parametrize("name", STAGES)
def test_a_killed_and_resumed_training_ends_with_the_same_weights(name: str, tmp_path: Path) -> None:
    whole = trained(name, tmp_path / "whole", "auto")
    shutil.copytree(tmp_path / "whole", tmp_path / "parts")
    *_, newest = sorted((tmp_path / "parts").rglob("step_*"))
    shutil.rmtree(newest)
    assert difference(whole, trained(name, tmp_path / "parts", "auto")) <= SAME


@pytest.mark.parametrize("execution", ["auto", "eager"])
@pytest.mark.parametrize("name", STAGES)
def test_a_step_never_waits_for_the_gpu(name: str, execution: str) -> None:
    part = part_of(name, execution=execution)
    stage = part.stage
    for module in stage.modules.values():
        module.train()
    parameters = trainable_parameters(stage.modules)
    batches = GlobalBatches(stage, part.config, parameters, name)
    steps = Steps(name, name, batches, build_adam(parameters, part.config.optim), part.config, 3, "cuda")
    phases = [stage.phase(step) if isinstance(stage, PhasedStage) else "all" for step in range(STEPS)]
    last = phases.index(phases[-1])
    for step in range(last, last + 5):  # kernels are chosen, the codebook starts
        steps.take(step, 1e-3)
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for step in range(last + 5, last + 8):
            steps.take(step, 1e-3)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert steps.not_finite() is None


def test_a_step_that_is_not_finite_is_skipped_and_named(tmp_path: Path) -> None:
    part = part_of("policy", log_every=10)
    stage, original = part.stage, part.stage.batch

    def batch(step: int, generators: Any) -> dict[str, Tensor]:
        found = dict(original(step, generators))
        if step == 13:
            found = {key: value * float("nan") if value.is_floating_point() else value for key, value in found.items()}
        return found

    stage.batch = batch  # type: ignore[method-assign]
    with pytest.raises(TrainingError, match=r"loss is nan at step 14, expected a finite number"):
        fit(part, tmp_path, seed=3, device="cuda")
    assert all(bool(value.isfinite().all()) for value in module_tensors(stage.modules).values())


def test_a_step_that_cannot_be_captured_is_taken_as_it_is_written(tmp_path: Path) -> None:
    """Also one that draws from the default generator, and while graphs of others live on."""
    layer = torch.nn.Linear(4, 4, device="cuda").requires_grad_(False)
    captured, x = Captured(layer.forward, layer), torch.ones(2, 4, device="cuda")

    def ended(execution: str) -> dict[str, Tensor]:
        part = part_of("decoder", execution=execution)
        original = part.stage.loss

        def loss(batch: Any, step: int, generators: Any) -> Any:
            found = original(batch, step, generators)
            drawn = torch.rand((), device="cuda")
            float(drawn)  # waits, which a capture cannot
            return {key: value * (1 + drawn) for key, value in found.items()}

        part.stage.loss = loss  # type: ignore[method-assign]
        fit(part, tmp_path / execution, seed=3, device="cuda")
        return {key: value.cpu().clone() for key, value in module_tensors(part.stage.modules).items()}

    with torch.no_grad():
        expected = [captured(x).clone() for _ in range(3)][-1]
        with pytest.warns(RuntimeWarning, match=r"could not be captured at `.*`: .*; their kernels are launched"):
            refused = ended("auto")
        assert torch.equal(captured(x), expected)
    assert difference(ended("eager"), refused) <= SAME
    assert torch.rand(2, device="cuda").isfinite().all()


def test_a_captured_function_is_the_function() -> None:
    layer = torch.nn.Linear(4, 4, device="cuda").requires_grad_(False)
    captured = Captured(lambda x, y: (layer(x) + y, x.sum()), layer)
    with torch.no_grad():
        for seed in range(4):
            x, y = (torch.randn(3, 4, device="cuda", generator=step_generator(seed, 0, name, "cuda")) for name in "xy")
            for got, expected in zip(captured(x, y), captured.function(x, y), strict=True):
                assert torch.allclose(got, expected)
        assert captured(x[:2], y[:2])[0].shape == (2, 4)
    assert captured(x.requires_grad_(), y)[0].requires_grad
    assert copy.deepcopy(captured)(x, y)[1].shape == ()


@pytest.mark.parametrize("per_slot", [False, True])
def test_imagination_and_its_rollout_are_captured(per_slot: bool) -> None:
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("error", RuntimeWarning)
        part = STAGES["dynamics of many agents" if per_slot else "dynamics"]()
        model = part.stage.model.eval()  # type: ignore[attr-defined]
        model.inverse_dynamics.split(torch.randn(64, *model.latent_shape, device="cuda"))  # sets the codebook
        slots = torch.randn(2, 1, *model.slot_shape, device="cuda")
        latents = torch.randn(2, 6, *model.latent_shape, device="cuda")
        expected = model.predictor.rollout(slots, *model.inverse_dynamics.split(latents))
        for _ in range(3):
            assert torch.allclose(model.futures(slots, latents), expected, atol=1e-5)
            session = ImaginationSession(model)
            session.reset(slots=slots[:, 0])
            steps = torch.stack([session.step(latents[:, step]) for step in range(6)], dim=1)
            assert torch.allclose(steps, expected, atol=1e-4)
