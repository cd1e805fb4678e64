"""What methods share whose model learns from unlabelled videos and whose policy comes after it: their schedule."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from playslot_rl.config.experiment import ExperimentConfig
from playslot_rl.config.machine import Need, frame_numbers, windows
from playslot_rl.config.plain import check
from playslot_rl.config.roles import Checked, between, role
from playslot_rl.config.stages import StageConfig, clipped_stage


@dataclass(frozen=True)
class PretrainedConfig(Checked):
    """A model of unlabelled videos, then a policy.

    Attributes:
        shift: shift of frames in the policy's training, pixels.
        model: training of the model.
        policy: training of the policy.
        world: another run of the method, with the same labels where its model reads them, whose model is taken; empty
            trains one.
    """

    shift: int = field(default=0, metadata=between(0, 16, "0 to 16 pixels"))
    model: StageConfig = field(default_factory=lambda: clipped_stage(200_000, 3e-4, "cosine"))
    policy: StageConfig = field(default_factory=lambda: clipped_stage(20_000, 2e-4, "constant"))
    world: str = field(default="", metadata=role("machine", "folder"))

    def check_levels(self, channels: tuple[int, ...]) -> None:
        """Refuse more widths than frames can be halved, by a ValueError."""
        check(1 <= len(channels) <= 5, f"{self.group}channels", channels, "1 to 5 widths")

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        """What the batches of both trainings take."""
        for part, stage in (("model", self.model), ("policy", self.policy)):
            yield windows(f"{name}.{part}", stage, frame_numbers(config))
