"""SOLD's policy at work: frame by frame, on all frames of the episode so far.

Shapes: n episodes, N slots, D slot width, A action width, L frames that are kept.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase

from playslot_rl import keys
from playslot_rl.acting.actor import Actor
from playslot_rl.config import EnvConfig
from playslot_rl.errors import CheckpointError
from playslot_rl.methods.sold.method import NAME, SOLDConfig
from playslot_rl.methods.sold.networks import ActorHead, build_networks, sample_action
from playslot_rl.modules.savi import SAVi
from playslot_rl.runs import Run
from playslot_rl.storage.checkpoints import StageCheckpoint, training_command
from playslot_rl.world_model import frame_parser_module, module_device


class SOLDActor(Actor):
    """SOLD: one step of acting, by the distribution's mean.

    Reads PIXELS (n, 3, H, W) uint8, SLOT_STATE, SLOT_AGE and KEYS_VALUES; writes these anew but for the frame, SLOTS
    (n, N, D) and ACTION (n, A) in [-1, 1]. Of the frames before, the keys and values of the actor's attention are kept,
    so that a step costs one frame's tokens.

    Args:
        frames: L; of an episode with more frames the actor sees the last L.
    """

    def __init__(self, savi: SAVi, actor: ActorHead, frames: int, action_dim: int) -> None:
        super().__init__((keys.SLOT_STATE, keys.SLOT_AGE, keys.KEYS_VALUES, keys.ACTION))
        self.savi, self.actor, self.frames, self.action_dim = savi, actor, frames, action_dim

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        return self.initial(len(seeds))

    def initial(self, n: int) -> TensorDict:
        """The memory of n new episodes, batch size [n]."""
        device, sizes = module_device(self.actor), self.savi.config
        return TensorDict(
            {
                keys.SLOT_STATE: torch.zeros(n, sizes.n_slots, sizes.slot_dim, device=device),
                keys.SLOT_AGE: torch.zeros(n, 1, dtype=torch.long, device=device),
                keys.KEYS_VALUES: self.actor.backbone.blank(n, self.frames, sizes.n_slots),
                keys.ACTION: torch.zeros(n, self.action_dim, device=device),
            },
            batch_size=[n],
            device=device,
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The mean; sampled initial slots are the same in every episode."""
        return self.act(tensordict, torch.Generator(module_device(self.actor)).manual_seed(0), explore=False)

    def act(self, memory: TensorDictBase, generator: torch.Generator, explore: bool) -> TensorDictBase:
        """Parse, remember, choose; `explore` samples the action."""
        out = frame_parser_module(self.savi, generator)(memory.copy())
        age = memory[keys.SLOT_AGE].squeeze(-1)
        action, std, kept = self.actor.step(out[keys.SLOTS], memory[keys.KEYS_VALUES], age)
        if explore:
            action = sample_action(action, std, generator).clamp(-1, 1)
        return out.update({keys.KEYS_VALUES: kept, keys.ACTION: action})


def require_form(done: StageCheckpoint) -> None:
    """Refuse, by a CheckpointError, networks from before their heads had a hidden layer and their actor the whole
    history.
    """
    if "slow_weight" not in done.config.get(NAME, {}):
        raise CheckpointError(
            f"{done.path}: got SOLD's networks of an earlier form (heads of one layer, an actor that sees 3 frames), "
            f"expected heads with a hidden layer and an actor that sees the episode: run {training_command(NAME)} "
            "with another out="
        )


def load_actor(run: Run, device: torch.device | str = "cpu") -> SOLDActor:
    """SOLD's policy, in evaluation mode; a CheckpointError where a stage is missing, damaged, of another SAVi or of an
    earlier form.
    """
    done, slots = run.stage(NAME, "slots"), run.stage("slots")
    require_form(done)
    own, env = done.group(SOLDConfig, NAME), done.group(EnvConfig, "env")
    networks = done.restore(
        lambda: build_networks(own, slots, env.action_dim, env.max_steps),
        ("dynamics", "reward", "critic", "actor"),
        device,
    )
    actor = SOLDActor(run.load_savi(device), networks.actor, env.max_steps + 1, env.action_dim)
    actor.eval()
    return actor
