"""Collectors: record episodes of a policy as a LeRobot v3.0 data set. Everything is imported when first used."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from playslot_rl.config import ExperimentConfig

PolicyName = Literal["random", "expert"]


def collect(
    config: ExperimentConfig, policy: PolicyName, episodes: int, steps: int, out: Path, seed: int, workers: int
) -> Path:
    """Record episodes as a LeRobot data set at `out`; see `playslot_rl.collectors.collection`."""
    from playslot_rl.envs.rendering import import_mujoco

    import_mujoco()  # before torchrl, which imports it too
    from playslot_rl.collectors.collection import collect as run

    return run(config, policy, episodes, steps, out, seed, workers)


__all__ = ["PolicyName", "collect"]
