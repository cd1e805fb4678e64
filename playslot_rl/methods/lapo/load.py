"""A trained LAPO run as an actor: frame to latent action by the latent policy, to a real action by the decoder.

Shapes: B batch, H W image height and width, Z latent-action width, A action dim.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn

from playslot_rl.acting.actor import Actor, latent_actor
from playslot_rl.config.baselines import LAPOConfig
from playslot_rl.config.plain import to_dict
from playslot_rl.frames import normalise
from playslot_rl.methods.lapo.model import EncoderMLP
from playslot_rl.modules.action_decoder import ActionDecoder

NAME: Final = "lapo"
MODEL: Final = "lapo_model"
"""Stage of the inverse and forward model, the parent of the policy and the decoder."""


class LAPOPolicy(nn.Module):
    """LAPO's latent policy: one frame to a latent action.

    Args:
        config: sizes.
        image_size: H = W.
    """

    def __init__(self, config: LAPOConfig, image_size: int) -> None:
        super().__init__()
        self.network = EncoderMLP(3, config.channels, image_size, config.hidden, config.latent_dim)

    def forward(self, pixels: Tensor) -> Tensor:
        """Frames (B, 3, H, W), uint8 or float [0, 1], to latent actions (B, Z)."""
        z: Tensor = self.network(normalise(pixels))
        return z


def sizes_of(config: LAPOConfig) -> dict[str, Any]:
    """The part of the config that inverse and forward model are built from."""
    names = ("channels", "hidden", "groups", "code_dim", "codes", "decay", "dead_threshold", "commitment")
    values = to_dict(config)
    return {name: values[name] for name in names}


def load_actor(run: Path, device: torch.device | str = "cpu") -> Actor:
    """The actor of a finished run.

    Raises:
        CheckpointError: it is missing or damaged, or was trained on another inverse model.
    """
    from playslot_rl.storage.checkpoints import checkpoint_folder, load_weights, read_stage, require_parents
    from playslot_rl.training.runs import freeze_on, stage_config, stage_model

    done = read_stage(checkpoint_folder(run, NAME), NAME)
    require_parents(done, {MODEL: read_stage(checkpoint_folder(run, MODEL), MODEL)})
    config, (model, env) = stage_config(done, LAPOConfig, NAME), stage_model(done)
    with torch.random.fork_rng(devices=[]):
        policy = LAPOPolicy(config, env.image_size)
        decoder = ActionDecoder(model.action_decoder, config.latent_dim, env.action_dim)
    load_weights(done, {"policy": policy, "action_decoder": decoder})
    freeze_on(policy, device)
    freeze_on(decoder, device)
    return latent_actor(policy, decoder)
