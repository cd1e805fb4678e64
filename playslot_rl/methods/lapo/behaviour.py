"""LAPO's second and third stage: the latent policy clones the inverse model's latents, the decoder regresses actions.

    L_pi = mean (pi(o_t) - z_t)^2,   L_a = mean (D(z_t) - a_t)^2

Note: LAPO fine-tunes its policy online or fits a decoder on labelled transitions; this is the second.

Shapes: M transitions, Z latent-action width.
"""

from __future__ import annotations

import torch
from torch import Tensor

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig
from playslot_rl.data.demonstrations import DemonstrationSplit, Transitions
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.losses.behaviour import BehaviourLoss
from playslot_rl.methods.cloning import LatentCloning
from playslot_rl.methods.lapo.config import LAPOConfig
from playslot_rl.methods.lapo.load import LAPOPolicy
from playslot_rl.methods.lapo.method import NAME
from playslot_rl.methods.lapo.model import ForwardModel, InverseModel
from playslot_rl.methods.lapo.stage import infer_latents
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.seeds.draws import global_seed
from playslot_rl.storage.checkpoints import StageCheckpoint, load_weights


class LAPOBehaviour(LatentCloning):
    """See `LatentCloning`; a CheckpointError where the model is damaged."""

    def __init__(
        self, config: ExperimentConfig, model: StageCheckpoint, demos: DemonstrationSplit, device: torch.device
    ) -> None:
        self.own: LAPOConfig = config.baselines.lapo
        self.inverse = load_inverse(model, device)
        super().__init__(config, demos, device, self.own.shift, self.own.policy, self.own.loss)
        with global_seed(config.seed, 0, NAME):
            self.policy = LAPOPolicy(self.own, config.env.image_size).to(device)
            width = self.own.latent_dim
            self.decoder = ActionDecoder(config.model.action_decoder, width, config.env.action_dim).to(device)

    def infer(self, source: EpisodeFrames, moves: Transitions) -> Tensor:
        return infer_latents(self.inverse, source, moves, self.device, self.own.targets == "quantised")

    def criterion(self) -> BehaviourLoss:
        criterion = BehaviourLoss(self.policy, self.own.loss)
        criterion.set_keys(observation=keys.PIXELS)
        return criterion


def load_inverse(model: StageCheckpoint, device: torch.device | str) -> InverseModel:
    """The inverse model of a finished stage, frozen."""
    own, (_, env) = model.group(LAPOConfig, NAME), model.sizes

    with torch.random.fork_rng(devices=[]):
        inverse, forward = InverseModel(own, env.image_size), ForwardModel(own)
    load_weights(model, {"inverse": inverse, "forward": forward})
    return inverse.to(device).eval().requires_grad_(False)
