"""SOLD small enough for tests: 4 slots of 32, networks of one layer of 16."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict

from playslot_rl import keys
from playslot_rl.methods.sold.learner import SOLDLearner
from playslot_rl.methods.sold.method import SOLDConfig
from playslot_rl.methods.sold.networks import SOLDNetworks
from playslot_rl.modules.savi import SAVi
from playslot_rl.testing import tiny_config

SIZES = {
    "batch_size": 3, "sequence": 6, "dim": 16, "heads": 2, "mlp_dim": 16, "dynamics_layers": 1, "head_layers": 1,
    "bins": 41, "context": 3, "least_context": 1, "horizon": 3, "starts": 7, "image_weight": 0.0, "dynamics_clip": 10.0,
    "predicted_rewards": True,
}  # fmt: skip


@pytest.fixture
def make_learner() -> Callable[..., SOLDLearner]:
    """Makes learners of equal weights; `spread` gives those weights that start at zero other values."""

    def make(spread: bool = True, frames: int = 6, **changes: object) -> SOLDLearner:
        config = SOLDConfig(**{**SIZES, **changes})
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            savi = SAVi(tiny_config().model.savi, 64).eval().requires_grad_(False)
            networks = SOLDNetworks(config, savi.config.slot_dim, 4, config.sequence)
            if spread:
                for layer in (networks.dynamics.head, networks.reward.out, networks.critic.out):
                    torch.nn.init.normal_(layer.weight, std=0.1)
        return SOLDLearner(savi, networks, config, 4, frames)

    return make


@pytest.fixture
def batch() -> TensorDict:
    """Three sequences of six frames with pixels; the second runs on into another episode at its fourth."""
    generator = torch.Generator().manual_seed(5)
    is_first = torch.zeros(3, 6, 1, dtype=torch.bool)
    is_first[0, 0], is_first[1, 3] = True, True
    return TensorDict(
        {
            keys.SLOTS: torch.randn(3, 6, 4, 32, generator=generator),
            keys.PIXELS: torch.randint(256, (3, 6, 3, 64, 64), generator=generator, dtype=torch.uint8),
            keys.ACTION: torch.rand(3, 6, 4, generator=generator) * 2 - 1,
            keys.REWARD: torch.rand(3, 6, 1, generator=generator) * 5,
            keys.IS_FIRST: is_first,
            keys.IS_LAST: torch.zeros_like(is_first),
        },
        [3, 6],
    )
