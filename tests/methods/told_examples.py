"""What a policy shows that is told something, whatever that is."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.agent import imagine
from playslot_rl.world_model import Agent


@torch.no_grad()
def imagines_by(agent: Agent, key: str, told: Tensor) -> None:
    """From the same slots it imagines something else for each of two things (2, ...) that it is told."""
    slots = torch.randn(1, 4, 32, generator=torch.Generator().manual_seed(0)).expand(2, -1, -1)
    both = imagine(agent, TensorDict({keys.SLOTS: slots, key: told}, [2]), 3).latents
    torch.testing.assert_close(both[:, 0], agent.policy(slots, told))
    assert (both[0] - both[1]).abs().max() > 1e-4
