"""How the heads on a frozen CADDY are trained on demonstrations.

    (a_t, v_t) = A(E(x_t), E(x_{t+1}))                   inferred from the videos: one-hot argmax, mean direction
    L_pi = -sum_k a_tk log softmax(l_t)_k + mean (v^_t - v_t)^2 / sigma^2,   (l_t, v^_t) = f(s_t)
    L_a = mean (D(z_t) - a_t)^2,   z_t = [a_t, v_t]      D reads the labelled demonstrations
    L_oracle = mean (f(s_t) - a_t)^2                     of all demonstrations

or means of absolute differences in L_a and L_oracle, `behaviour.loss`.

Note: PlaySlot's paper names neither losses nor heads. The error of the variability is divided by its variance sigma^2
in the demonstrations, so that it counts beside the action's whatever its scale.

Shapes: M transitions, b rows of a batch, C channels of a state of H/8 x W/8, K actions, Z latent dim, A action dim.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional as F

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig
from playslot_rl.data.demonstrations import DemonstrationSplit, Transitions
from playslot_rl.data.neighbours import pairs_at
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.losses.behaviour import BehaviourLoss
from playslot_rl.methods.caddy.heads import ORACLE, POLICY, MovesHead, StateHead, load_model, states_of
from playslot_rl.methods.caddy.method import CADDYConfig, CADDYOracleConfig, CADDYPolicyConfig
from playslot_rl.methods.caddy.model import CADDY
from playslot_rl.methods.caddy.networks import Encoder
from playslot_rl.methods.caddy.stage import CADDYStage
from playslot_rl.methods.cloning import LatentCloning, action_stage, cloning, inferred
from playslot_rl.methods.video.training import pixel_model
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.storage.checkpoints import StageCheckpoint
from playslot_rl.training.demonstrated import cloning_alone
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training, on_clips
from playslot_rl.training.stage_regression import (
    FrameInputs,
    Inputs,
    RegressionStage,
    unexplained,
)


class StateInputs:
    """States by row (b, C, H/8, W/8): `Inputs` of a regression, encoded by a frozen E as they are drawn."""

    def __init__(self, encoder: Encoder, frames: FrameInputs) -> None:
        self.encoder, self.frames = encoder, frames

    def __len__(self) -> int:
        return len(self.frames)

    def draw(self, rows: Tensor, generators: StepGenerators) -> Tensor:
        return states_of(self.encoder, self.frames.draw(rows, generators))

    def plain(self, rows: Tensor) -> Tensor:
        return states_of(self.encoder, self.frames.plain(rows))


class MovesLoss(BehaviourLoss):
    """Cross-entropy of the action and squared error of the variability, over its variance: reads STATE_MAPS
    (b, C, H/8, W/8) and moves LATENT_ACTION (b, K + Z); writes `loss_policy`.
    """

    network: MovesHead

    def __init__(self, network: MovesHead) -> None:
        super().__init__(network)
        self.set_keys(observation=keys.STATE_MAPS)

    def _error(self, tensordict: TensorDictBase, observed: Sequence[NestedKey]) -> Tensor:
        out: Tensor = self.network(*(tensordict.get(key) for key in observed))
        moves, k = tensordict.get(self.tensor_keys.action), self.network.actions
        error: Tensor = ((out[:, k:] - moves[:, k:]) / self.network.scale).square().mean()
        return F.cross_entropy(out[:, :k], moves[:, :k]) + error


class MovesStage(RegressionStage):
    criterion: MovesLoss

    def validate(self, step: int) -> Mapping[str, float]:  # noqa: ARG002
        """`unexplained` fraction of v's variance and `mistaken` actions (0 to 1), of each of the checks."""
        numbers, k = {}, self.criterion.network.actions
        for name, examples in self.checks.items():
            out, moves = self.compared(*examples)
            numbers[name] = unexplained(out[:, k:], moves[:, k:])
            wrong = out[:, :k].argmax(dim=-1) != moves[:, :k].argmax(dim=-1)
            numbers[name.replace("unexplained", "mistaken")] = float(wrong.float().mean())
        return numbers


class CADDYBehaviour(LatentCloning):
    """See `LatentCloning`; a CheckpointError where the model is damaged."""

    policy: MovesHead
    kind = MovesStage

    def __init__(
        self, config: ExperimentConfig, model: StageCheckpoint, demos: DemonstrationSplit, device: torch.device
    ) -> None:
        self.own: CADDYPolicyConfig = config.baselines.caddy_policy
        self.model = load_model(model, device)
        super().__init__(config, demos, device, self.own.shift, self.own.policy, config.behaviour.loss)
        sizes = self.model.config
        width = sizes.actions + sizes.latent_dim
        with global_seed(config.seed, 0, POLICY):
            tasks = len(config.env.tasks)
            self.policy = MovesHead(sizes.encoder[-1], sizes.actions, sizes.latent_dim, tasks).to(device)
            self.decoder = self.new_decoder(width, 2 * sizes.encoder[-1])
        self.policy.standardise(self.trained.latents[:, sizes.actions :])

    def infer(self, source: EpisodeFrames, moves: Transitions) -> Tensor:
        return inferred(partial(infer_moves, self.model), source.pixels, pairs_at(moves.rows), self.device)

    def observe(self, frames: FrameInputs) -> Inputs:
        return StateInputs(self.model.encoder, frames)

    def criterion(self) -> MovesLoss:
        return MovesLoss(self.policy)


def oracle_stage(
    config: ExperimentConfig, model: StageCheckpoint, demos: DemonstrationSplit, device: torch.device
) -> RegressionStage:
    """The CADDY Oracle's training: a new head clones the real actions of all demonstrations; a CheckpointError where
    the model is damaged, a DataError where actions are missing or nothing moves.
    """
    own: CADDYOracleConfig = config.baselines.caddy_oracle
    caddy = load_model(model, device)
    with global_seed(config.seed, 0, ORACLE):
        tasks = len(config.env.tasks)
        oracle = StateHead(caddy.config.encoder[-1], config.env.action_dim, True, tasks).to(device)

    def observe(frames: FrameInputs) -> Inputs:
        return StateInputs(caddy.encoder, frames)

    return action_stage(
        "oracle", oracle, keys.STATE_MAPS, observe, config, demos, device, own.shift, own.policy, validated=1024
    )


def infer_moves(model: CADDY, frames: Tensor) -> Tensor:
    """Moves (B, K + Z) between pairs of frames (B, 2, 3, H, W), a one-hot action and a variability each."""
    latents = model.infer(frames)
    return torch.cat((latents.a, latents.v), dim=-1)[:, 0]


def model(record: StageRecord) -> Training:
    own: CADDYConfig = record.config.baselines.caddy
    stage = CADDYStage(pixel_model(CADDY, own, record), record.clips(own.frames), own)
    return on_clips(record, stage, own, extra={"perceptual": stage.objective.perceptual is not None})


def policy(record: StageRecord) -> Training:
    behaviour = CADDYBehaviour(record.config, record.parents["caddy"], record.demos, record.device)
    return cloning(record, behaviour, behaviour.own.decoder_steps, behaviour.own.decoder_lr)


def oracle(record: StageRecord) -> Training:
    own: CADDYOracleConfig = record.config.baselines.caddy_oracle
    stage = oracle_stage(record.config, record.parents["caddy"], record.demos, record.device)
    part = Part(f"{record.name}.policy", stage, own.policy, group=f"baselines.{record.name}.policy")
    return cloning_alone(record, part, len(stage.targets))
