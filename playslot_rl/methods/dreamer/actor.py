"""DreamerV3 as an actor: one step of acting, and a trained one from disk."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase

from playslot_rl import keys
from playslot_rl.acting.actor import Actor
from playslot_rl.config import EnvConfig
from playslot_rl.methods.dreamer.config import DreamerConfig
from playslot_rl.methods.dreamer.method import NAME
from playslot_rl.methods.dreamer.networks import DreamerNetworks
from playslot_rl.runs import Run


def act(networks: DreamerNetworks, memory: TensorDictBase, generator: torch.Generator | None) -> TensorDict:
    """See a frame and choose an action; networks in eval mode, without a generator the most likely state and the mean.

    The memory is `state` (n, S), `belief` (n, H), ACTION (n, A) and PIXELS uint8 (n, 3, H, W), which come back anew,
    the
    frames reduced.
    """
    frames = networks.reduce(memory.get(keys.PIXELS))
    state, belief = networks.filter(
        memory.get("state"), memory.get("belief"), memory.get(keys.ACTION), frames, generator
    )
    mean, std = networks.actor(state, belief)
    action = mean
    if generator is not None:
        action = mean + std * torch.randn(mean.shape, generator=generator, device=mean.device)
    values = {"state": state, "belief": belief, keys.ACTION: action, keys.PIXELS: frames}
    return TensorDict(values, memory.batch_size)


class DreamerActor(Actor):
    """DreamerV3 without exploring. The memory: `state`, `belief` and the last ACTION."""

    def __init__(self, networks: DreamerNetworks) -> None:
        super().__init__(("state", "belief", keys.ACTION))
        self.networks = networks

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        return self.networks.blank(len(seeds)).to(self.device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """PIXELS uint8 (n, 3, H, W) and the memory -> ACTION (n, A) and the memory."""
        # The prior draws a sample that is not used here.
        with torch.random.fork_rng(devices=[]):
            out = act(self.networks, tensordict, None)
        return tensordict.update(out.select(*self.out_keys))


def load_actor(run: Run, device: torch.device | str = "cpu") -> DreamerActor:
    """The trained actor of `RUN/dreamer/checkpoint`, in eval mode; a CheckpointError where there is none, or a damaged
    one.
    """
    done = run.stage(NAME)
    own, env = done.group(DreamerConfig, NAME), done.group(EnvConfig, "env")
    return DreamerActor(done.restore(lambda: DreamerNetworks(own, env), "networks", device))
