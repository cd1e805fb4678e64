"""A ResNet-18 on the real actions of all demonstrations, or of the labelled ones alone (BC), where the arm hides things
with the last frames; its settings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import Need, frame_numbers, windows
from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.roles import UNSAID, at_least, between, was
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.config.stages import OptimConfig, StageConfig
from playslot_rl.errors import ConfigError


@dataclass(frozen=True)
class ResNetOracleConfig(StageConfig):
    """Schedule of the ResNet oracle; the head's sizes are `model.policy`, its loss `behaviour.loss`.

    Attributes:
        weights: of ResNet-18: `auto` (ImageNet's in torchvision's cache, else from scratch),
            `scratch`, `download` (ImageNet's, fetched if they are not in the cache), or the path of a file of them
            (`.pth` as torchvision publishes it, or `.safetensors` with the same names).
        shift: frames are shifted by up to so many pixels either way in training, edges repeated; 0 does not.
        patience: end before `steps` once the error on held-out demonstrations has not fallen for so many validations,
            with the weights that had the lowest; 0, or none held out: train all steps.
        history: frames that `history_bc` sees, the present one the last.
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
    history: int = field(default=4, metadata=UNSAID | between(2, 16, "2 to 16"))

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        yield windows(name, self, frame_numbers(config))

    def check(self, name: str, config: ExperimentConfig) -> None:  # noqa: ARG002
        require_weights(name, self.weights)


def require_weights(name: str, weights: str) -> None:
    """Refuse `NAME.weights` that no ResNet-18 can start from, by a ConfigError."""
    if weights not in ("auto", "download", "scratch") and not Path(weights).is_file():
        raise ConfigError(f"{name}.weights: got {weights}, expected a file, auto, download or scratch: check it")


NAME: Final = "resnet_oracle"
STAGE: Final = StageSpec(
    NAME,
    keys=("model.policy", "behaviour.loss", "behaviour.trim_pixels", "behaviour.trim_margin"),
    settings=("baselines.resnet_oracle",),
    data="demos",
    parts="playslot_rl.methods.resnet_oracle.training:training",
)
_LOAD: Final = Load(actor="playslot_rl.methods.resnet_oracle.network:load_actor")
HISTORY: Final = "history_bc"
_WITH_HISTORY: Final = replace(
    STAGE,
    name=HISTORY,
    data="labelled",
    parts="playslot_rl.methods.resnet_oracle.training:with_history",
    names={"baselines.resnet_oracle": HISTORY},
)
RESNET_ORACLE: Final = Method(
    NAME, ("ResNet Oracle", "ResNet"), Style(1, "v"), ResNetOracleConfig, (STAGE,), _LOAD, told="task"
)
RESNET_BC: Final = Method(
    "resnet_bc", ("ResNet BC",), Style(1, ">"), None, (replace(STAGE, data="labelled"),), _LOAD, told="task"
)
HISTORY_BC: Final = Method(
    HISTORY, ("ResNet BC with history",), Style(1, "$H$"), None, (_WITH_HISTORY,),
    Load(actor="playslot_rl.methods.resnet_oracle.network:load_with_history"), told="task",
)  # fmt: skip
