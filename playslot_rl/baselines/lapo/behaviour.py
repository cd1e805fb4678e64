"""LAPO's second and third stage: the latent policy clones the inverse model's latents, the decoder regresses actions.

    L_pi = mean (pi(o_t) - z_t)^2,   L_a = mean (D(z_t) - a_t)^2

Note: LAPO fine-tunes its policy online or fits a decoder on labelled transitions; this is the second. The decoder is
PlaySlot's, on the same labels, and is fed alike (`behaviour.decoder_inputs`).

Shapes: M transitions, Z latent-action width, A action dim.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.baselines.frame_inputs import FrameInputs
from playslot_rl.baselines.lapo.load import LAPOPolicy, stored_config
from playslot_rl.baselines.lapo.model import InverseModel
from playslot_rl.baselines.lapo.stage import infer_latents
from playslot_rl.config import ExperimentConfig
from playslot_rl.data.demonstrations import real_actions, transitions
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.losses.behaviour import ActionDecoderLoss, BehaviourLoss
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.seeding import derived_seed
from playslot_rl.storage.checkpoints import StageCheckpoint, load_weights
from playslot_rl.training.runs import freeze_on, stage_model
from playslot_rl.training.stage_regression import RegressionStage, TensorInputs, apply_rows


class LAPOBehaviour:
    """Policy and decoder, untrained, with the stages that train them one after the other.

    Args:
        config: sizes, schedules, labels.
        model: finished inverse and forward model.
        source: demonstrations.
        device: where to compute.

    Raises:
        CheckpointError: a damaged model.
        DataError: demonstrations without actions.
    """

    def __init__(
        self, config: ExperimentConfig, model: StageCheckpoint, source: EpisodeFrames, device: torch.device
    ) -> None:
        self.config, self.own, self.source, self.device = config, config.baselines.lapo, source, device
        self.moves = transitions(source)
        self.actions = real_actions(source, self.moves.rows, config.env.action_dim).to(device)
        self.latents = infer_latents(load_inverse(model, device), source, self.moves, device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derived_seed(config.seed, 0, "lapo"))
            self.policy = LAPOPolicy(self.own, config.env.image_size).to(device)
            width = self.own.latent_dim
            self.decoder = ActionDecoder(config.model.action_decoder, width, config.env.action_dim).to(device)

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """What is stored."""
        return {"policy": self.policy, "action_decoder": self.decoder}

    def policy_stage(self) -> RegressionStage:
        """Latent actions from frames of all demonstrations, no action read."""
        criterion = BehaviourLoss(self.policy, self.own.loss)
        criterion.set_keys(observation=keys.PIXELS)
        return RegressionStage(
            "policy",
            criterion,
            FrameInputs(self.source, self.moves.rows, self.device, self.own.shift),
            self.latents,
            self.own.policy.batch_size,
            validated=1024,
            precision=self.own.policy.precision,
        )

    def decoder_stage(self) -> RegressionStage:
        """Real actions of the labelled demonstrations, from inferred latents, the policy's, or both."""
        behaviour = self.config.behaviour
        chosen = np.flatnonzero(self.moves.episode < behaviour.labelled_demos)
        rows = torch.from_numpy(chosen).to(self.device)
        inputs: list[Tensor] = [] if behaviour.decoder_inputs == "policy" else [self.latents[rows]]
        if behaviour.decoder_inputs != "inverse_dynamics":
            self.policy.eval()
            inputs.append(apply_rows(self.policy, FrameInputs(self.source, self.moves.rows, self.device), rows))
        latents = torch.cat(inputs)
        self.decoder.standardise(latents)
        return RegressionStage(
            "action_decoder",
            ActionDecoderLoss(self.decoder, self.own.loss),
            TensorInputs(latents),
            self.actions[rows].repeat(len(inputs), 1),
            self.own.policy.batch_size,
        )


def load_inverse(model: StageCheckpoint, device: torch.device | str) -> InverseModel:
    """The inverse model of a finished stage, frozen.

    Raises:
        CheckpointError: it is damaged.
    """
    from playslot_rl.baselines.lapo.model import ForwardModel

    config, (_, env) = stored_config(model.config, model.path), stage_model(model)
    with torch.random.fork_rng(devices=[]):
        inverse, forward = InverseModel(config, env.image_size), ForwardModel(config)
    load_weights(model, {"inverse": inverse, "forward": forward})
    freeze_on(inverse, device)
    return inverse
