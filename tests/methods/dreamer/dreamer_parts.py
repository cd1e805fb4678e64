"""Networks, objective and batches of a size for tests."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torchrl.objectives import DreamerV3Loss

from playslot_rl import keys
from playslot_rl.config import EnvConfig
from playslot_rl.methods.dreamer.learner import build_loss
from playslot_rl.methods.dreamer.method import DreamerConfig
from playslot_rl.methods.dreamer.networks import DreamerNetworks
from playslot_rl.seeds.draws import global_seed

B, T, A = 2, 5, 4


def tiny(**changes: object) -> DreamerConfig:
    values: dict[str, object] = {
        "frame_size": 16, "depth": 4, "mults": (1, 2), "kernel": 3, "belief": 8, "blocks": 2, "categoricals": 3,
        "classes": 4, "hidden": 8, "units": 8, "layers": 1, "horizon": 4, "gamma": 0.9, "lr": 0.01, "warmup": 0,
    }  # fmt: skip
    return DreamerConfig(**(values | changes))  # type: ignore[arg-type]


def random_batch(seed: int = 0) -> TensorDict:
    """A batch of the replay with an episode's end within one of its sequences."""
    generator = torch.Generator().manual_seed(seed)
    first = torch.zeros(B, T, 1, dtype=torch.bool)
    first[:, 0] = True
    first[1, 3] = True
    last = torch.zeros_like(first)
    last[1, 2] = True
    values = {
        keys.PIXELS: torch.randint(0, 256, (B, T, 3, 16, 16), generator=generator, dtype=torch.uint8),
        keys.ACTION: torch.randn(B, T, A, generator=generator),
        keys.REWARD: torch.randn(B, T, 1, generator=generator),
        keys.IS_FIRST: first,
        keys.IS_LAST: last,
    }
    return TensorDict(values, [B, T])


@dataclass
class Parts:
    """What a test takes apart."""

    config: DreamerConfig
    networks: DreamerNetworks
    loss: DreamerV3Loss

    def touched(self) -> set[str]:
        """Networks that have a gradient."""
        return {
            name
            for name, module in self.networks.named_children()
            if any(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in module.parameters())
        }


def make_parts() -> Parts:
    """Fresh networks; heads that start at zero are shaken, so that gradients pass them."""
    config = tiny()
    with global_seed(0, 0, "test"):
        networks = DreamerNetworks(config, EnvConfig())
        for head in (networks.reward, networks.value):
            for parameter in head.parameters():
                parameter.data.add_(0.05 * torch.randn(parameter.shape))
        return Parts(config, networks, build_loss(networks, config))
