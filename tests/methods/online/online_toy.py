"""A task without a simulator, and a small learner with everything that makes resuming hard."""

from __future__ import annotations

import signal
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import EnvConfig, ExperimentConfig, LoggingConfig, RenderConfig
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.errors import PlaySlotError
from playslot_rl.methods.online.config import OnlineConfig
from playslot_rl.methods.online.loop import OnlineTraining
from playslot_rl.methods.online.replay import OnlineState
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.storage.tensors import module_tensors
from playslot_rl.training.record import StageRecord

SPEC = StageSpec("toy", settings=("baselines.dreamer",), data="", names={"baselines.dreamer": "toy"})

STEPS = 4


class ToyTask:
    """A point on a line; the reward is its place, the frame shows it, and beyond 1 the task is solved."""

    draw_steps = True

    def reset(self, *, seed: int | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        self.place = float(np.random.default_rng(seed).uniform(-0.5, 0.5))
        return self._seen(), {"success": False}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self.place += 0.5 * float(np.clip(action, -1, 1)[0])
        return self._seen(), self.place, False, False, {"success": self.place > 1}

    def expert_action(self) -> Any:
        return np.ones(4, np.float32)

    def close(self) -> None:
        pass

    def _seen(self) -> dict[str, Any]:
        return {"pixels": np.full((8, 8, 3), int(np.clip(128 + 40 * self.place, 0, 255)), np.uint8)}


class ToyPool:
    """Stands in for `TaskPool`."""

    def __init__(self, env: EnvConfig, render: RenderConfig) -> None:
        self.env, self.render = env, render

    def take(self, count: int) -> list[ToyTask]:
        return [ToyTask() for _ in range(count)]

    def close(self) -> None:
        pass

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass


class HangingPool(ToyPool):
    """Its episodes never begin."""

    def take(self, count: int) -> list[ToyTask]:
        signal.pause()
        return []


class BrokenPool(ToyPool):
    """Has no GL backend, say."""

    def take(self, count: int) -> list[ToyTask]:
        raise PlaySlotError("render: got none, expected one")


class ToyLearner:
    """Regresses rewards from frames, by two optimisers; its actions and targets are drawn."""

    stored = (keys.PIXELS, "shade")

    def __init__(self, nan_at: int = -1) -> None:
        self.nan_at, self.batches = nan_at, []
        with global_seed(0, 0, "toy"):
            self.net, self.bias = nn.Linear(1, 1), nn.BatchNorm1d(1)
        self._optimizers = {
            "net": torch.optim.Adam(self.net.parameters(), lr=0.1),
            "bias": torch.optim.SGD(self.bias.parameters(), lr=0.1, momentum=0.9),
        }

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"net": self.net, "bias": self.bias}

    @property
    def optimizers(self) -> Mapping[str, torch.optim.Optimizer]:
        return self._optimizers

    def initial(self, n: int) -> TensorDict:
        return TensorDict({keys.ACTION: torch.zeros(n, 4), "age": torch.zeros(n, 1)}, [n])

    def act(self, memory: TensorDictBase, generator: torch.Generator, explore: bool) -> TensorDictBase:
        assert not self.net.training
        pixels = memory.get(keys.PIXELS)
        shade = pixels.float().mean((1, 2, 3)).div(255).unsqueeze(-1)
        action = self.net(shade).tanh().expand(-1, 4)
        if explore:
            action = action + torch.randn(action.shape, generator=generator)
        values = {keys.ACTION: action, "age": memory.get("age") + 1, keys.PIXELS: pixels, "shade": shade}
        return TensorDict(values, memory.batch_size)

    def update(self, batch: TensorDict, generators: StepGenerators) -> Mapping[str, Tensor]:
        assert self.net.training
        self.batches.append(batch)
        shade = batch["shade"].flatten(0, 1) + 0.01 * torch.randn(1, generator=generators.torch("noise"))
        predicted = self.bias(self.net(shade))
        loss = (predicted + 0.1 * torch.rand(1) - batch[keys.REWARD].flatten(0, 1)).square().mean()
        if generators.step == self.nan_at:
            loss = loss * float("nan")
        for optimizer in self._optimizers.values():
            optimizer.zero_grad()
        loss.backward()
        for optimizer in self._optimizers.values():
            optimizer.step()
        return {"loss": loss.detach()}


def weights(learner: ToyLearner) -> dict[str, Tensor]:
    return {key: value.clone() for key, value in module_tensors(learner.modules).items()}


def same(one: Mapping[str, Tensor], other: Mapping[str, Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)


def toy_online(**changes: Any) -> OnlineConfig:
    values: dict[str, Any] = {
        "steps": 64, "prefill": 8, "envs": 2, "update_ratio": 0.5, "batch_size": 3, "sequence": 3, "capacity": 40,
        "evaluate_every": 16, "evaluation_episodes": 3, "checkpoint_every": 16, "log_every": 1,
    }  # fmt: skip
    return OnlineConfig(**(values | changes))


class Trained(NamedTuple):
    """What `OnlineTraining.train` returns."""

    state: OnlineState
    resumed_from: int


def train(run: Path, learner: ToyLearner | None = None, **changes: Any) -> tuple[ToyLearner, Trained]:
    """Train with the pool of `monkeypatch`ed toy tasks, into `RUN/toy`."""
    learner = learner or ToyLearner()
    config = ExperimentConfig(
        env=EnvConfig(max_steps=STEPS), seed=3, device="cpu", logging=LoggingConfig(backend="none", progress=False)
    )
    record = StageRecord(SPEC, run, config)
    with record.training() as begin:
        done = OnlineTraining(learner, toy_online(**changes), learner.modules).train(record, begin)
    return learner, Trained(*done)


def interrupt(monkeypatch: pytest.MonkeyPatch, at: int, folder: Path, message: str, **options: Any) -> None:
    """Press Ctrl-C in update `at` of a training, which ends with this message."""
    original = ToyLearner.update

    def pressed(self: ToyLearner, batch: TensorDict, generators: StepGenerators) -> Mapping[str, Tensor]:
        if generators.step == at:
            signal.raise_signal(signal.SIGINT)
        return original(self, batch, generators)

    with monkeypatch.context() as patch:
        patch.setattr(ToyLearner, "update", pressed)
        with pytest.raises(KeyboardInterrupt, match=message):
            train(folder, **options)
