"""Config of the baselines (the group `baselines` of the experiment's config)."""

from __future__ import annotations

from dataclasses import dataclass, field

from playslot_rl.config.dreamer import DreamerConfig
from playslot_rl.config.lapo import LAPOConfig
from playslot_rl.config.oracles import ResNetOracleConfig
from playslot_rl.config.sold import SOLDConfig


@dataclass(frozen=True)
class BaselinesConfig:
    """Sizes and schedules, one group a method."""

    resnet_oracle: ResNetOracleConfig = field(default_factory=ResNetOracleConfig)
    lapo: LAPOConfig = field(default_factory=LAPOConfig)
    dreamer: DreamerConfig = field(default_factory=DreamerConfig)
    sold: SOLDConfig = field(default_factory=SOLDConfig)
