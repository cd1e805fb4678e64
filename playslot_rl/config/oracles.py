"""Config of the ResNet oracle. The slot oracle has none: its sizes are `model.policy`, its schedule `behaviour`."""

from __future__ import annotations

from dataclasses import dataclass, field

from playslot_rl.config.plain import check
from playslot_rl.config.stage import OptimConfig, StageConfig


@dataclass(frozen=True)
class ResNetOracleConfig(StageConfig):
    """Schedule of the ResNet oracle; the head's sizes are `model.policy`, its loss `behaviour.loss`.

    Attributes:
        weights: of ResNet-18: `auto` (ImageNet's from torchvision's cache, from scratch where they are not there),
            `scratch`, `download` (ImageNet's, fetched if they are not in the cache), or the path of a file of them
            (`.pth` as torchvision publishes it, or `.safetensors` with the same names).
        shift: frames are shifted by up to so many pixels either way in training, edges repeated; 0 does not.
    """

    steps: int = 20_000
    batch_size: int = 64
    optim: OptimConfig = field(
        default_factory=lambda: OptimConfig(lr=2e-4, warmup_steps=0, schedule="constant", grad_clip=0.0)
    )
    weights: str = "auto"
    shift: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        check(0 <= self.shift <= 16, "baselines.resnet_oracle.shift", self.shift, "0 to 16 pixels")
