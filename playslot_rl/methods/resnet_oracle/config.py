"""Settings of the ResNet oracle (`baselines.resnet_oracle`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import Need, frame_numbers, windows
from playslot_rl.config.roles import at_least, between, was
from playslot_rl.config.stages import OptimConfig, StageConfig
from playslot_rl.errors import ConfigError


@dataclass(frozen=True)
class ResNetOracleConfig(StageConfig):
    """Schedule of the ResNet oracle; the head's sizes are `model.policy`, its loss `behaviour.loss`.

    Attributes:
        weights: of ResNet-18: `auto` (ImageNet's from torchvision's cache, from scratch where they are not there),
            `scratch`, `download` (ImageNet's, fetched if they are not in the cache), or the path of a file of them
            (`.pth` as torchvision publishes it, or `.safetensors` with the same names).
        shift: frames are shifted by up to so many pixels either way in training, edges repeated; 0 does not.
        patience: end before `steps` once the error on held-out demonstrations has not fallen for so many validations,
            with the weights that had the lowest; 0, or none held out: train all steps.
    """

    group = "baselines.resnet_oracle."
    steps: int = field(default=20_000, metadata=at_least(1))
    batch_size: int = field(default=64, metadata=at_least(1))
    optim: OptimConfig = field(
        default_factory=lambda: OptimConfig(lr=2e-4, warmup_steps=0, schedule="constant", grad_clip=0.0)
    )
    weights: str = "auto"
    shift: int = field(default=0, metadata=between(0, 16, "0 to 16 pixels"))
    patience: int = field(default=0, metadata=was(0) | at_least(0))

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        yield windows(name, self, frame_numbers(config))

    def check(self, name: str, config: ExperimentConfig) -> None:  # noqa: ARG002
        if self.weights not in ("auto", "download", "scratch") and not Path(self.weights).is_file():
            raise ConfigError(
                f"{name}.weights: got {self.weights}, expected a file, auto, download or scratch: check it"
            )
