"""A small stage with everything that makes resuming hard: an EMA codebook, global randomness, a frozen part."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from playslot_rl.config import OptimConfig, StageConfig
from playslot_rl.modules.quantizer import ActionQuantizer
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.training.fit import Part, TrainingState, fit


class ToyStage:
    """Fits a quantised autoencoder of random vectors; dead codes are revived from torch's global generator."""

    def __init__(self, delay: float = 0.0, nan_at: int = -1) -> None:
        self.delay, self.nan_at, self.steps_seen = delay, nan_at, 0
        with global_seed(0, 0, "toy"):
            frozen = nn.Linear(4, 4).requires_grad_(False)
            self.modules: Mapping[str, nn.Module] = {
                "encoder": nn.Sequential(nn.Linear(6, 4), nn.BatchNorm1d(4), frozen),
                "quantizer": ActionQuantizer(4, 5, 0.9, 2.0, 0.25),
                "decoder": nn.Linear(4, 6),
            }

    def batch(self, step: int, generators: StepGenerators) -> dict[str, Tensor]:
        time.sleep(self.delay)
        self.steps_seen += 1
        x = torch.randn(16, 6, generator=generators.torch("x"))
        return {"x": x + torch.as_tensor(generators.numpy("shift").normal(), dtype=torch.float32)}

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> dict[str, Tensor]:
        x = batch["x"]
        z = self.modules["encoder"](x) + 0.1 * torch.randn(16, 4)
        p, _, commitment = self.modules["quantizer"](z)
        error = (self.modules["decoder"](p) - x).square().mean()
        if step == self.nan_at:
            error = error * float("nan")
        return {"loss": error + commitment, "error": error}

    def validate(self, step: int) -> dict[str, float]:
        assert not self.modules["encoder"].training
        assert not torch.is_grad_enabled()
        return {"error": float(torch.rand(())), "step": float(step)}


def toy_config(steps: int = 12, **changes: float) -> StageConfig:
    optim = OptimConfig(lr=changes.pop("lr", 0.01), warmup_steps=3, grad_clip=1.0)
    settings = {"checkpoint_every": 3, "validate_every": 4, "log_every": 2} | changes
    return StageConfig(steps=steps, batch_size=16, optim=optim, **settings)  # type: ignore[arg-type]


def train(folder: Path, steps: int = 12, delay: float = 0.0) -> tuple[ToyStage, TrainingState, int]:
    stage = ToyStage(delay)
    return stage, *fit(Part("toy", stage, toy_config(steps)), folder, seed=3, identity={"data": "abc"})
