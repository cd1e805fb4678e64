"""SOLD's policy at work (frame, SAVi's state and past slots to an action), from disk, and what its world model cost in
agent steps.

Shapes: n episodes, W frames of memory, N slots, D slot width, A action width.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.modules import TruncatedNormal

from playslot_rl import keys
from playslot_rl.acting.actor import Actor
from playslot_rl.config import EnvConfig
from playslot_rl.errors import ConfigError
from playslot_rl.methods.sold.method import NAME, SOLDConfig
from playslot_rl.methods.sold.networks import ActorHead, SOLDNetworks, sample_action
from playslot_rl.modules.savi import SAVi
from playslot_rl.runs import Run
from playslot_rl.storage.checkpoints import StageCheckpoint
from playslot_rl.world_model import frame_parser_module, module_device


class SOLDActor(Actor):
    """SOLD: one step of acting, by the most likely action.

    Reads PIXELS (n, 3, H, W) uint8, SLOT_STATE, SLOT_AGE, SLOT_HISTORY (n, W, N, D), right-aligned, and
    HISTORY_LENGTH (n, 1); writes these anew but for the frame, SLOTS (n, N, D) and ACTION (n, A) in [-1, 1].

    Note: the window W is C, in imagination as here: each decision follows the last 1 to C frames, there predicted ones
    too. ALiBi lets it slide.
    """

    def __init__(self, savi: SAVi, actor: ActorHead, window: int, action_dim: int) -> None:
        super().__init__((keys.SLOT_STATE, keys.SLOT_AGE, keys.SLOT_HISTORY, keys.HISTORY_LENGTH, keys.ACTION))
        self.savi, self.actor, self.window, self.action_dim = savi, actor, window, action_dim

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        return self.initial(len(seeds))

    def initial(self, n: int) -> TensorDict:
        """The memory of n new episodes, batch size [n]."""
        device, shape = module_device(self.actor), (self.savi.config.n_slots, self.savi.config.slot_dim)
        return TensorDict(
            {
                keys.SLOT_STATE: torch.zeros(n, *shape, device=device),
                keys.SLOT_AGE: torch.zeros(n, 1, dtype=torch.long, device=device),
                keys.SLOT_HISTORY: torch.zeros(n, self.window, *shape, device=device),
                keys.HISTORY_LENGTH: torch.zeros(n, 1, dtype=torch.long, device=device),
                keys.ACTION: torch.zeros(n, self.action_dim, device=device),
            },
            batch_size=[n],
            device=device,
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The most likely action; sampled initial slots are the same in every episode."""
        return self.act(tensordict, torch.Generator(module_device(self.actor)).manual_seed(0), explore=False)

    def act(self, memory: TensorDictBase, generator: torch.Generator, explore: bool) -> TensorDictBase:
        """Parse, remember, choose; `explore` samples the action."""
        out = frame_parser_module(self.savi, generator)(memory.copy())
        history = torch.cat((memory[keys.SLOT_HISTORY][:, 1:], out[keys.SLOTS].unsqueeze(1)), dim=1)
        length = (memory[keys.HISTORY_LENGTH] + 1).clamp(max=self.window)
        location, std = self._last(history, length.squeeze(-1))
        action = sample_action(TruncatedNormal(location, std), generator) if explore else location
        return out.update({keys.SLOT_HISTORY: history, keys.HISTORY_LENGTH: length, keys.ACTION: action})

    def _last(self, history: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        """Location and deviation (n, A) at the newest frame of right-aligned histories.

        They are moved to the left: the actor is causal, so what pads the right end is never looked at.
        """
        window = int(length.max())
        steps = torch.arange(window, device=history.device)
        source = (steps + self.window - length[:, None]).clamp(max=self.window - 1)
        rows = torch.arange(len(history), device=history.device)
        location, std, _ = self.actor(history[rows[:, None], source])
        return location[rows, length - 1], std[rows, length - 1]


def build_networks(config: SOLDConfig, slots: StageCheckpoint, action_dim: int, max_steps: int) -> SOLDNetworks:
    """Fresh networks for the slots of a finished SAVi; a `sequence` of 0 takes an episode of `max_steps` whole."""
    slot_dim = slots.sizes[0].savi.slot_dim
    return SOLDNetworks(config, slot_dim, action_dim, config.sequence or max_steps + 1)


def prior_steps(config: SOLDConfig, slots: StageCheckpoint) -> int:
    """Agent steps of the data that SAVi was trained on, which count as SOLD's own.

    `savi_steps` of the config if given; else what the checkpoint says. One written before it said so names its episodes
    only: their number times `env.max_steps`, as `playslot pipeline` records. A ConfigError where it says neither.
    """
    if config.savi_steps is not None:
        return config.savi_steps
    steps, episodes = slots.meta.get("agent_steps"), slots.meta.get("episodes")
    if steps is not None:
        return int(steps)
    if episodes is None:
        raise ConfigError(
            f"baselines.sold.savi_steps: got nothing, and {slots.path}/meta.json names neither agent_steps nor "
            "episodes: say how many agent steps SAVi's data hold"
        )
    return int(episodes) * slots.sizes[1].max_steps


def load_actor(run: Run, device: torch.device | str = "cpu") -> SOLDActor:
    """SOLD's policy, in evaluation mode; a CheckpointError where a stage is missing, damaged, or of another SAVi."""
    done, slots = run.stage(NAME, "slots"), run.stage("slots")
    own, env = done.group(SOLDConfig, NAME), done.group(EnvConfig, "env")
    networks = done.restore(
        lambda: build_networks(own, slots, env.action_dim, env.max_steps),
        ("dynamics", "reward", "critic", "actor"),
        device,
    )
    actor = SOLDActor(run.load_savi(device), networks.actor, own.context, env.action_dim)
    actor.eval()
    return actor
