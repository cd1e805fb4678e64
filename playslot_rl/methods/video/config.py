"""Clips and training of a model that predicts frames, or slots."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import Need, predictor_weights, rollouts
from playslot_rl.config.model import PredictorConfig
from playslot_rl.config.roles import NOT_NEGATIVE, at_least
from playslot_rl.config.stages import DynamicsStageConfig, StageConfig


@dataclass(frozen=True)
class VideoStageConfig(StageConfig):
    """Clips and training of a video predictor.

    Attributes:
        seed_frames: frames that are shown.
        predicted_frames: frames predicted after them.
        decoded_frames: of a clip's predictions, how many are decoded for the image loss, drawn at random; 0 decodes
            all of them.
    """

    seed_frames: int = field(default=6, metadata=at_least(1))
    predicted_frames: int = field(default=8, metadata=at_least(1))
    decoded_frames: int = field(default=0, metadata=NOT_NEGATIVE)

    @property
    def frames(self) -> int:
        """Of a clip."""
        return self.seed_frames + self.predicted_frames


@dataclass(frozen=True)
class OnSlotsConfig(DynamicsStageConfig):
    """Stage 2 with nothing inferred, on a frozen SAVi's slots.

    Attributes:
        predictor: sizes.
    """

    predictor: PredictorConfig = field(default_factory=PredictorConfig)

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        yield rollouts(name, self, config)
        yield predictor_weights(f"{name}.predictor", self.predictor, config)
