"""LeRobot's pipelines before and after the policy."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from lerobot_policy_playslot.configuration_playslot import PlaySlotConfig
from playslot_rl.sharing.folder import make_processors


def make_playslot_pre_post_processors(
    config: PlaySlotConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[Any, Any]:
    """Fresh pipelines; see `playslot_rl.sharing.folder.make_processors`. The range of the actions is that of the data
    which the policy was trained on, not of `dataset_stats`.
    """
    del dataset_stats
    return make_processors(str(config.device), config.actions or {})
