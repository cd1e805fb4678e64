"""LAPO's second and third stage: the latent policy clones the inverse model's latents, the decoder regresses actions.

    L_pi = mean (pi(o_t) - z_t)^2,   L_a = mean (D(z_t) - a_t)^2

Note: LAPO fine-tunes its policy online or fits a decoder on labelled transitions; this is the second. The decoder is
PlaySlot's, on the same labels, and is fed alike (`behaviour.decoder_inputs`).

Shapes: M transitions, Z latent-action width, A action dim.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl import keys
from playslot_rl.baselines.lapo.load import NAME, LAPOPolicy
from playslot_rl.baselines.lapo.model import InverseModel
from playslot_rl.baselines.lapo.stage import infer_latents
from playslot_rl.config import ExperimentConfig, LAPOConfig
from playslot_rl.data.demonstrations import DemonstrationSplit, moving_frames
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.losses.behaviour import ActionDecoderLoss, BehaviourLoss
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.seeding import global_seed
from playslot_rl.storage.checkpoints import StageCheckpoint, load_weights
from playslot_rl.training.runs import freeze_on, stage_config, stage_model
from playslot_rl.training.stage_regression import (
    FrameInputs,
    RegressionStage,
    TensorInputs,
    apply_rows,
    demonstrated_frames,
)


class _Seen(NamedTuple):
    """Transitions of demonstrations: frames, latents (M, Z), real actions (M, A) and whose they are (M,)."""

    frames: FrameInputs
    latents: Tensor
    actions: Tensor
    episode: npt.NDArray[np.int64]


class LAPOBehaviour:
    """Policy and decoder, untrained, with the stages that train them one after the other.

    Args:
        config: sizes, schedules, labels.
        model: finished inverse and forward model.
        demos: demonstrations, and those that are held out.
        device: where to compute.

    Raises:
        CheckpointError: a damaged model.
        DataError: demonstrations without actions.
    """

    def __init__(
        self, config: ExperimentConfig, model: StageCheckpoint, demos: DemonstrationSplit, device: torch.device
    ) -> None:
        self.config, self.own, self.device = config, config.baselines.lapo, device
        inverse = load_inverse(model, device)

        def seen(source: EpisodeFrames, shift: int = 0) -> _Seen:
            moves = moving_frames(source, config.behaviour.trim_pixels, config.behaviour.trim_margin)
            inputs, actions = demonstrated_frames(source, moves, config.env.action_dim, device, shift)
            return _Seen(
                inputs,
                infer_latents(inverse, source, moves, device, self.own.targets == "quantised"),
                actions,
                moves.episode,
            )

        self.trained = seen(demos.trained, self.own.shift)
        self.held_out = None if demos.held_out is None else seen(demos.held_out)
        with global_seed(config.seed, 0, "lapo"):
            self.policy = LAPOPolicy(self.own, config.env.image_size).to(device)
            width = self.own.latent_dim
            self.decoder = ActionDecoder(config.model.action_decoder, width, config.env.action_dim).to(device)

    def policy_stage(self) -> RegressionStage:
        """Latent actions from frames of all demonstrations, no action read."""
        criterion = BehaviourLoss(self.policy, self.own.loss)
        criterion.set_keys(observation=keys.PIXELS)
        return RegressionStage(
            "policy",
            criterion,
            self.trained.frames,
            self.trained.latents,
            self.own.policy.batch_size,
            held_out=self.held_out and (self.held_out.frames, self.held_out.latents),
            validated=1024,
            precision=self.own.policy.precision,
        )

    def decoder_stage(self) -> RegressionStage:
        """Real actions of the labelled demonstrations, from inferred latents, the policy's, or both."""
        labelled = np.flatnonzero(self.trained.episode < self.config.behaviour.labelled_demos)
        inputs, actions = self._decoded(self.trained, torch.from_numpy(labelled).to(self.device))
        held_out = None
        if self.held_out is not None:
            held_out = self._decoded(self.held_out, torch.arange(len(self.held_out.actions), device=self.device))
        self.decoder.standardise(inputs.values)
        return RegressionStage(
            "action_decoder",
            ActionDecoderLoss(self.decoder, self.own.loss),
            inputs,
            actions,
            self.own.policy.batch_size,
            held_out=held_out,
            precision=self.own.policy.precision,
        )

    def _decoded(self, seen: _Seen, rows: Tensor) -> tuple[TensorInputs, Tensor]:
        """What the decoder regresses from, and what it should give, on rows of demonstrations."""
        kind = self.config.behaviour.decoder_inputs
        inputs: list[Tensor] = [] if kind == "policy" else [seen.latents[rows]]
        if kind != "inverse_dynamics":
            self.policy.eval()
            inputs.append(apply_rows(self.policy, seen.frames, rows))
        return TensorInputs(torch.cat(inputs)), seen.actions[rows].repeat(len(inputs), 1)


def load_inverse(model: StageCheckpoint, device: torch.device | str) -> InverseModel:
    """The inverse model of a finished stage, frozen.

    Raises:
        CheckpointError: it is damaged.
    """
    from playslot_rl.baselines.lapo.model import ForwardModel

    config, (_, env) = stage_config(model, LAPOConfig, NAME), stage_model(model)
    with torch.random.fork_rng(devices=[]):
        inverse, forward = InverseModel(config, env.image_size), ForwardModel(config)
    load_weights(model, {"inverse": inverse, "forward": forward})
    freeze_on(inverse, device)
    return inverse
