"""What methods share whose model tells latent actions in videos: a policy clones them, a decoder makes them real.

    z_t = what the frozen model infers from (o_t, o_{t+1})
    pi(o_t) ~ z_t                       on the videos of all demonstrations, no action read
    L_a = mean (D(z_t) - a_t)^2         on the labelled ones

Policies clone what moves: still transitions are left out (`behaviour.trim_pixels`).

Shapes: M transitions, Z latent-action width, A action dim.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig, StageConfig
from playslot_rl.data.demonstrations import (
    DemonstrationSplit,
    Transitions,
    labelled_rows,
    moving_frames,
    real_actions,
)
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.losses.behaviour import ActionDecoderLoss, BehaviourLoss
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.training.demonstrated import cloned, policy_taken_over
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord, Training
from playslot_rl.training.stage_regression import (
    FrameInputs,
    Inputs,
    RegressionStage,
    TensorInputs,
    apply_rows,
)


class Seen(NamedTuple):
    """Transitions: what the policy reads of the frame before each, the latents (M, Z) that the model infers, the real
    actions (M, A) in [-1, 1], and whose they are (M,).
    """

    inputs: Inputs
    latents: Tensor
    actions: Tensor
    episode: npt.NDArray[np.int64]


class LatentCloning(ABC):
    """Policy and decoder, untrained, with the stages that train them one after the other; a DataError for
    demonstrations without actions, or in which nothing moves, or nothing in the labelled ones.

    A method makes `policy` and `decoder` after this, which asks it for `infer` and `observe`. Both are trained with the
    batches and the precision of `schedule`, the policy on frames that are shifted by up to `shift` pixels.
    """

    policy: nn.Module
    decoder: ActionDecoder

    kind: type[RegressionStage] = RegressionStage
    """Of the policy's stage."""

    def __init__(
        self,
        config: ExperimentConfig,
        demos: DemonstrationSplit,
        device: torch.device,
        shift: int,
        schedule: StageConfig,
        loss: str,
    ) -> None:
        self.config, self.device, self.schedule, self.loss = config, device, schedule, loss
        self.trained = self._seen(demos.trained, shift)
        self.labelled = labelled_rows(self.trained.episode, config.behaviour.labelled_demos)
        self.held_out = None if demos.held_out is None else self._seen(demos.held_out)

    @abstractmethod
    def infer(self, source: EpisodeFrames, moves: Transitions) -> Tensor:
        """Latent actions (M, Z) of transitions, by the frozen model."""

    def observe(self, frames: FrameInputs) -> Inputs:
        """What the policy reads of frames: themselves."""
        return frames

    def chosen(self, outputs: Tensor) -> Tensor:
        """The latent actions (M, Z) that the policy's outputs (M, ...) stand for: themselves."""
        return outputs

    @abstractmethod
    def criterion(self) -> BehaviourLoss:
        """What compares the policy's outputs and the inferred latents."""

    def policy_stage(self) -> RegressionStage:
        """Latent actions from frames of all demonstrations, no action read."""
        return self.kind(
            "policy",
            self.criterion(),
            self.trained.inputs,
            self.trained.latents,
            self.schedule.batch_size,
            held_out=self.held_out and (self.held_out.inputs, self.held_out.latents),
            validated=1024,
            precision=self.schedule.precision,
        )

    def decoder_stage(self) -> RegressionStage:
        """Real actions of the labelled demonstrations, from inferred latents, the policy's, or both."""
        inputs, actions = self._decoded(self.trained, self.labelled.to(self.device))
        held_out = None
        if self.held_out is not None:
            held_out = self._decoded(self.held_out, torch.arange(len(self.held_out.actions), device=self.device))
        self.decoder.standardise(inputs.whole())
        return RegressionStage(
            "action_decoder",
            ActionDecoderLoss(self.decoder, self.loss),
            inputs,
            actions,
            self.schedule.batch_size,
            held_out=held_out,
            precision=self.schedule.precision,
        )

    def _seen(self, source: EpisodeFrames, shift: int = 0) -> Seen:
        moves, frames, actions = moving_examples(self.config, source, self.device, shift)
        return Seen(self.observe(frames), self.infer(source, moves), actions, moves.episode)

    def _decoded(self, seen: Seen, rows: Tensor) -> tuple[TensorInputs, Tensor]:
        """What the decoder regresses from, and what it should give."""
        kind = self.config.behaviour.decoder_inputs
        inputs: list[Tensor] = [] if kind == "policy" else [seen.latents[rows]]
        if kind != "inverse_dynamics":
            self.policy.eval()
            inputs.append(self.chosen(apply_rows(self.policy, seen.inputs, rows)))
        return TensorInputs(torch.cat(inputs)), seen.actions[rows].repeat(len(inputs), 1)


def moving_examples(
    config: ExperimentConfig, source: EpisodeFrames, device: torch.device, shift: int = 0
) -> tuple[Transitions, FrameInputs, Tensor]:
    """The transitions in which something moves, the frames before them, and their real actions (M, A) in [-1, 1]; a
    DataError where there are no actions, or of another width.
    """
    moves = moving_frames(source, config.behaviour.trim_pixels, config.behaviour.trim_margin)
    actions = real_actions(source, moves.rows, config.env.action_dim).to(device)
    return moves, FrameInputs(source, moves.rows, device, shift, config.data.device == "auto"), actions


def action_stage(
    name: str,
    network: nn.Module,
    key: str,
    observe: Callable[[FrameInputs], Inputs],
    config: ExperimentConfig,
    demos: DemonstrationSplit,
    device: torch.device,
    shift: int,
    schedule: StageConfig,
    validated: int,
) -> RegressionStage:
    """A network clones the real actions of all demonstrations; it reads what `observe` makes of frames, as `key`."""

    def examples(source: EpisodeFrames, shift: int = 0) -> tuple[Inputs, Tensor]:
        _, frames, actions = moving_examples(config, source, device, shift)
        return observe(frames), actions

    criterion = BehaviourLoss(network, config.behaviour.loss)
    criterion.set_keys(observation=key, action=keys.ACTION)
    return RegressionStage(
        name,
        criterion,
        *examples(demos.trained, shift),
        schedule.batch_size,
        held_out=None if demos.held_out is None else examples(demos.held_out),
        validated=validated,
        precision=schedule.precision,
    )


def cloning(
    record: StageRecord,
    behaviour: LatentCloning,
    policy: StageConfig,
    decoder_steps: int,
    decoder_lr: float,
) -> Training:
    """Latent policy, then action decoder; the policy is taken over where another run has trained it.

    `policy` is its schedule, `baselines.METHOD.policy`; the decoder has its own steps and rate, the rest is the
    policy's.
    """
    config, name, split = record.config, record.name, record.demos
    decoding = replace(policy, steps=decoder_steps, optim=replace(policy.optim, lr=decoder_lr))
    labelled = {"labelled_demos": config.behaviour.labelled_demos, "inputs": config.behaviour.decoder_inputs}

    def parts() -> Iterator[Part]:
        group = f"baselines.{name}"
        yield Part(f"{name}.policy", behaviour.policy_stage(), policy, group=f"{group}.policy")
        yield Part(
            f"{name}.action_decoder",
            behaviour.decoder_stage(),
            decoding,
            folder="decoder",
            group=f"{group}.policy",
            renamed={"steps": f"{group}.decoder_steps", "optim.lr": f"{group}.decoder_lr"},
            identity=labelled,
        )

    said, extra = cloned(name, split, len(behaviour.trained.actions), config.behaviour.labelled_demos)
    return Training(
        parts(),
        behaviour.device,
        lambda _: f"{said}, {record.folder}",
        extra={**extra, **labelled},
        adopt=policy_taken_over(config, record, policy.steps),
    )
