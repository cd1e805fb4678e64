"""The policies that collect: random exploration and the scripted expert.

Their random numbers are a function of the episode's seed and step, so that an episode is the same in any process.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from playslot_rl import keys

EPISODE_SEED: Final = "episode_seed"
"""Seed of the running episode: int64 (1,)."""
EPISODE_STEP: Final = "episode_step"
"""Agent steps since its reset: int64 (1,)."""
EXPERT_ACTION: Final = "expert_action"
"""The scripted expert's action for the present state: float32 (A,)."""
POLICY_STREAM: Final = 2
"""Spawn key of the policy's random numbers; the environment uses 0 and 1 of the same seed."""


def step_generator(seed: int, step: int) -> np.random.Generator:
    """Generator of one step of one episode."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(POLICY_STREAM, step)))


class RandomActions(nn.Module):
    """Uniform actions in [-1, 1]."""

    def forward(self, expert: Tensor, seed: Tensor, step: Tensor) -> Tensor:
        """Action float32 (A,) from the expert's (A,), of which only the width is used, seed (1,) and step (1,)."""
        rng = step_generator(int(seed), int(step))
        return torch.from_numpy(rng.uniform(-1.0, 1.0, expert.shape[-1]).astype(np.float32))


class ExpertActions(nn.Module):
    """The expert's actions, with Gaussian noise.

    Args:
        noise: standard deviation; the sum is clipped to [-1, 1].
    """

    def __init__(self, noise: float) -> None:
        super().__init__()
        self.noise = noise

    def forward(self, expert: Tensor, seed: Tensor, step: Tensor) -> Tensor:
        """Action float32 (A,) from the expert's (A,), seed (1,) and step (1,)."""
        if self.noise == 0.0:
            return expert.clone()
        rng = step_generator(int(seed), int(step))
        noise = rng.normal(0.0, self.noise, expert.shape[-1]).astype(np.float32)
        return (expert + torch.from_numpy(noise)).clamp(-1.0, 1.0)


def make_policy(name: str, noise: float = 0.0) -> TensorDictModule:
    """Policy of a collector: reads `EXPERT_ACTION`, `EPISODE_SEED`, `EPISODE_STEP` and writes `keys.ACTION`."""
    module = RandomActions() if name == "random" else ExpertActions(noise)
    return TensorDictModule(module, in_keys=[EXPERT_ACTION, EPISODE_SEED, EPISODE_STEP], out_keys=[keys.ACTION])
