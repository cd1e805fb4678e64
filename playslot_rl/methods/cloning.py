"""What methods share whose model tells latent actions in videos: a policy clones them, a decoder makes them real.

    z_t = what the frozen model infers from (o_t, o_{t+1})
    pi(o_t) ~ z_t                       on the videos of all demonstrations, no action read
    L_a = mean (D(z_t) - a_t)^2         on the labelled ones, D(z_t, h_t) with the policy's features (`decoder_state`),
                                        which of shifted frames are seen in training as the policy's are

then both together, as PlaySlot's (`training.stage_behaviour`). Policies clone what moves: still transitions are left
out (`behaviour.trim_pixels`).

Shapes: M transitions, Z latent-action width, A action dim.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig, ModelConfig, StageConfig
from playslot_rl.data.demonstrations import (
    Demonstrations,
    DemonstrationSplit,
    Transitions,
    labelled_rows,
    moving_frames,
    real_actions,
)
from playslot_rl.data.neighbours import Ends, in_batches
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.tasks import told_tasks
from playslot_rl.data.views import DIRECTIONS, IntArray, shifted_copies
from playslot_rl.losses.behaviour import BehaviourLoss
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.training.demonstrated import cloned, policy_taken_over
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training
from playslot_rl.training.stage import Stage
from playslot_rl.training.stage_behaviour import JointStage, after_cloning
from playslot_rl.training.stage_regression import (
    FrameInputs,
    Inputs,
    PairedInputs,
    RegressionStage,
    TakenInputs,
    apply_rows,
)


class Seen(NamedTuple):
    """Transitions: what the policy reads of the frame before each, the latents (M, Z) that the model infers, the real
    actions (M, A) in [-1, 1], which they are, and what it is told (`Demonstrations.told`), which `inputs` end with.
    """

    inputs: Inputs
    latents: Tensor
    actions: Tensor
    moves: Transitions
    told: Tensor | None


def sizes(config: ExperimentConfig, model: ModelConfig) -> ModelConfig:
    """With a decoder that reads the policy's features where `behaviour.decoder_state` says so."""
    decoder = replace(config.model.action_decoder, reads_slots=config.behaviour.decoder_state)
    return replace(model, action_decoder=decoder)


def slot_sizes(config: ExperimentConfig, model: ModelConfig) -> ModelConfig:
    """The same, of a policy that sees slots: the decoder reads those that it sees."""
    decoder = sizes(config, model).action_decoder
    return replace(model, action_decoder=replace(decoder, slots=config.model.policy.slots))


class LatentCloning(ABC):
    """Policy and decoder, untrained, with the stages that train them one after the other; a DataError for
    demonstrations without actions, or in which nothing moves, or nothing in the labelled ones.

    A method makes `policy` and `decoder` after this, which asks it for `infer` and `observe`. Both are trained with the
    batches and the precision of `schedule`, the policy on frames that are shifted by up to `shift` pixels.
    """

    policy: Any
    """An nn.Module that `Decides`."""
    decoder: ActionDecoder

    noise: float = 0.0
    """Deviation of what is added to the features that the decoder learns from."""

    kind: type[RegressionStage] = RegressionStage
    """Of the policy's stage."""

    def __init__(
        self,
        config: ExperimentConfig,
        demos: DemonstrationSplit,
        device: torch.device,
        shift: int,
        schedule: StageConfig,
        loss: Literal["l2", "l1"],
    ) -> None:
        self.config, self.device, self.schedule, self.loss = config, device, schedule, loss
        self.said = "goal" if config.model.policy.goal else "task"  # of `Demonstrations`
        self.copies = shifted_copies(demos.trained, shift, len(DIRECTIONS))
        self.trained = self._seen(demos.trained, shift)
        self.labelled = labelled_rows(self.trained.moves.episode, config.behaviour.labelled_demos)
        self.held_out = None if demos.held_out is None else self._seen(demos.held_out)

    @abstractmethod
    def infer(self, source: EpisodeFrames, moves: Transitions) -> Tensor:
        """Latent actions (M, Z) of transitions, by the frozen model."""

    def observe(self, frames: FrameInputs) -> Inputs:
        """What the policy reads of frames: themselves."""
        return frames

    def criterion(self) -> BehaviourLoss:
        """What compares the policy's outputs and the inferred latents; the policy reads frames."""
        criterion = BehaviourLoss(self.policy, self.loss)
        criterion.set_keys(observation=keys.PIXELS)
        return criterion

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

    def new_decoder(self, latent_dim: int, state_dim: int) -> ActionDecoder:
        """One that may read the policy's features, of that width."""
        model = sizes(self.config, self.config.model)
        return ActionDecoder(model.action_decoder, latent_dim, self.config.env.action_dim, state_dim).to(self.device)

    def decoding(
        self, clone: RegressionStage, part: Callable[[str, Stage, int, float], Part], steps: int, lr: float
    ) -> Iterator[Part]:
        """What follows the policy, which `clone` has trained; see `after_cloning`. The decoder has `steps` and `lr`."""
        config = replace(
            self.config.behaviour,
            parsed=True,
            imagined=False,
            slot_noise=self.noise,
            loss=self.loss,
            batch_size=self.schedule.batch_size,
            precision=self.schedule.precision,
            decoder_steps=steps,
            decoder_lr=lr,
        )
        self.policy.eval()
        labelled, other = self.labelled.to(self.device), self.held_out
        shown = TakenInputs(self.trained.inputs, labelled), self.trained.actions[labelled]

        def finetune() -> JointStage:
            measured = other and (other.inputs, other.actions)
            return JointStage(clone, self.decoder, shown, measured, config)

        held_out = None if other is None else self._decided(other, torch.arange(len(other.actions)))
        yield from after_cloning(self.decoder, self.policy, self._shown(labelled), config, part, finetune, held_out)

    def _seen(self, source: EpisodeFrames, shift: int = 0) -> Seen:
        moves, frames, actions = moving_examples(self.config, source, self.device, shift)
        task = task_of(source, moves, self.config, self.device)
        inputs = PairedInputs.told(self.observe(frames), task)
        return Seen(inputs, self.infer(source, moves), actions, moves, task)

    def _shown(self, labelled: Tensor) -> Demonstrations:
        """The labelled rows, then those of shifted frames."""
        demos, moved = self._decided(self.trained, labelled), self.trained.moves.rows[labelled.cpu().numpy()]
        every = torch.arange(len(moved), device=self.device)
        frames = [self.observe(FrameInputs(copy, moved, self.device, resident=False)) for copy in self.copies]
        features = [apply_rows(self.policy.features, PairedInputs.told(part, demos.told), every) for part in frames]
        shown, none = torch.cat((demos.slots, *features)), demos.slots[:, :0]  # what is taken apart is not copied
        taken = replace(demos, slots=none, imagined=none).take(every.repeat(1 + len(frames)))
        return replace(taken, slots=shown, imagined=shown)

    def _decided(self, seen: Seen, rows: Tensor) -> Demonstrations:
        """What the decoder meets of some rows: the policy's features in place of slots."""
        rows, moves = rows.to(self.device), seen.moves
        features = apply_rows(self.policy.features, seen.inputs, rows)
        episode, step = (torch.from_numpy(part).to(self.device)[rows] for part in (moves.episode, moves.step))
        told = {} if seen.told is None else {self.said: seen.told[rows]}
        lengths = torch.from_numpy(moves.lengths)
        return Demonstrations(
            features, features, seen.latents[rows], seen.actions[rows], episode, step, lengths, **told
        )


@torch.no_grad()
def inferred(
    infer: Callable[[Tensor], Tensor],
    read: Callable[[IntArray], Tensor],
    rows: IntArray,
    device: torch.device | str = "cpu",
) -> Tensor:
    """What a model in evaluation mode infers (M, ...) from what `read` gives of rows (M, F), some at a time."""
    return torch.cat([infer(read(some).to(device)) for some in in_batches(rows)])


def moving_examples(
    config: ExperimentConfig, source: EpisodeFrames, device: torch.device, shift: int = 0, frames: int = 1
) -> tuple[Transitions, FrameInputs, Tensor]:
    """The transitions in which something moves, the frame before them or the last `frames`, and their real actions
    (M, A) in [-1, 1]; a DataError where there are no actions, or of another width.
    """
    moves = moving_frames(source, config.behaviour.trim_pixels, config.behaviour.trim_margin)
    actions = real_actions(source, moves.rows, config.env.action_dim).to(device)
    rows = moves.rows if frames == 1 else Ends.of(source).past(moves.rows, frames)
    return moves, FrameInputs(source, rows, device, shift, config.data.device == "auto"), actions


def task_of(source: EpisodeFrames, moves: Transitions, config: ExperimentConfig, device: torch.device) -> Tensor | None:
    """The task int64 (M, 1) of transitions, where the environment has several: `told_tasks` on the device."""
    task = told_tasks(source, moves, config.env)
    return None if task is None else task.to(device)


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
    frames: int = 1,
) -> RegressionStage:
    """A network clones the real actions of all demonstrations; it reads what `observe` makes of the last `frames`, as
    `key`.
    """

    def examples(source: EpisodeFrames, shift: int = 0) -> tuple[Inputs, Tensor]:
        moves, seen, actions = moving_examples(config, source, device, shift, frames)
        return PairedInputs.told(observe(seen), task_of(source, moves, config, device)), actions

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
    decoder_steps: int,
    decoder_lr: float,
    at: str = "",
    views: int = 1,
) -> Training:
    """Latent policy, then action decoder, then both; the policy is taken over where another run has trained it.

    The decoder has its own steps and rate, the rest is of the policy's schedule, which is `baselines.METHOD.policy`, or
    the group `at`.
    """
    config, name, split, policy = record.config, record.name, record.demos, behaviour.schedule
    labelled = {"labelled_demos": config.behaviour.labelled_demos, "inputs": config.behaviour.decoder_inputs}
    if behaviour.copies:
        labelled["decoder_views"] = 1 + len(behaviour.copies)
    group, schedule = at or f"baselines.{name}", at or f"baselines.{name}.policy"

    def part(folder: str, stage: Stage, steps: int, lr: float) -> Part:
        kind = folder.partition("_")[0]
        typed = "behaviour.finetune" if kind == "finetune" else f"{group}.decoder"
        changed = replace(policy, steps=steps, optim=replace(policy.optim, lr=lr))
        renamed = {"steps": f"{typed}_steps", "optim.lr": f"{typed}_lr"}
        of = "action_decoder" if folder == "decoder" else folder
        return Part(f"{name}.{of}", stage, changed, folder, schedule, renamed, labelled)

    def parts() -> Iterator[Part]:
        clone = behaviour.policy_stage()
        yield Part(f"{name}.policy", clone, policy, group=schedule)
        yield from behaviour.decoding(clone, part, decoder_steps, decoder_lr)

    said, extra = cloned(name, split, len(behaviour.trained.actions), config.behaviour.labelled_demos, views)
    return Training(
        parts(),
        behaviour.device,
        lambda _: f"{said}, {record.folder}",
        extra={**extra, **labelled},
        adopt=policy_taken_over(config, record, policy.steps),
    )
