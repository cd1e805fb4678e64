"""Trainings of CLAM: inverse and forward model on unlabelled videos, and the action decoder with them on the labelled
demonstrations; then a latent policy.

    L = mean (o^_{t+1} - o_{t+1})^2 / mean (o_{t+1} - o_t)^2 + lambda mean (D(z_u) - a_u)^2
    L_pi = mean (pi(o_t) - z_t)^2

t runs over the videos, u over the moving transitions of the labelled demonstrations, equally many a step. Before an
episode's first frame there is that frame once more.

Note: the original divides by nothing, and takes labels in every other step, with a weight of 1 (of states) or 0.01 (of
pixels). Its labels are of play, ours of demonstrations, as all methods here have them.

Shapes: B batch, H W image height and width, M transitions, Z latent-action width.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import Transitions
from playslot_rl.data.neighbours import Ends, in_batches
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import IntArray
from playslot_rl.frames import normalise
from playslot_rl.methods.clam.method import NAME, CLAMConfig
from playslot_rl.methods.clam.model import Forward, Inverse
from playslot_rl.methods.cloning import inferred
from playslot_rl.methods.lapo.training import PixelCloning, on_pairs
from playslot_rl.methods.supervised import LabelledMoves
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.runtime.precision import autocast
from playslot_rl.runtime.processes import spread
from playslot_rl.runtime.shares import own_rows
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.storage.checkpoints import StageCheckpoint
from playslot_rl.training.demonstrated import cloning_alone
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training
from playslot_rl.training.stage_regression import RegressionStage, apart, together
from playslot_rl.world_model import module_device


class CLAMStage:
    """Inverse model, forward model and decoder together, trained in place."""

    def __init__(
        self, inverse: Inverse, forward: Forward, decoder: ActionDecoder, clips: Clips, labelled: LabelledMoves,
        config: CLAMConfig,
    ) -> None:  # fmt: skip
        self.inverse, self.forward, self.decoder = inverse, forward, decoder
        self.clips, self.labelled, self.config, self.ends = clips, labelled, config, Ends.of(clips.source)
        frames = self._frames(clips.spread(clips.train_episodes))
        self.still = max(1e-6, float((frames[:, 2] - frames[:, 1]).square().mean()))

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"inverse": self.inverse, "forward": self.forward, "action_decoder": self.decoder}

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        count = self.config.model.batch_size
        pairs = self.clips.sample(count, generators.numpy("moves"))
        known, actions = self.labelled.draw(count, generators)
        frames = self.labelled.pixels(own_rows(self.labelled.ends.past(known + 1, 3)))
        videos = self.clips.pixels(own_rows(self.ends.past(pairs[:, 1], 3)), module_device(self.inverse))
        return together({"videos": {keys.PIXELS: videos}, "labelled": {keys.PIXELS: frames, keys.ACTION: actions}})

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        frames, labelled = normalise(apart(batch, "videos")[keys.PIXELS]), apart(batch, "labelled")
        with autocast(frames.device.type, self.config.model.precision):
            z, known = self.inverse(torch.cat((frames, normalise(labelled[keys.PIXELS])))).split(len(frames))
            predicted, decoded = self.forward(frames[:, :2], z), self.decoder(known)
        image = (predicted.float() - frames[:, 2]).square().mean() / self.still
        action = (decoded.float() - labelled[keys.ACTION]).square().mean()
        return {"loss": image + self.config.label_weight * action, "loss_image": image, "loss_action": action}

    @torch.no_grad()
    def validate(self, step: int) -> Mapping[str, float]:  # noqa: ARG002
        """`unexplained`: error on held-out frames over that of no change."""

        def look(_: int, rows: IntArray) -> tuple[float, float]:
            frames = self._frames(rows)
            error = self.forward(frames[:, :2], self.inverse(frames)) - frames[:, 2]
            return float(error.square().sum()), float((frames[:, 2] - frames[:, 1]).square().sum())

        errors, stills = zip(*spread(in_batches(self.clips.held_out), look), strict=True)
        return {"unexplained": sum(errors) / max(1e-6, sum(stills))}

    def _frames(self, pairs: IntArray) -> Tensor:
        return normalise(self.clips.pixels(self.ends.past(pairs[:, 1], 3), module_device(self.inverse)))


class PolicyStage(RegressionStage):
    """Trains the policy; the decoder, which stays as it is, is stored beside it."""

    decoder: ActionDecoder

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {**super().modules, "action_decoder": self.decoder}


class CLAMBehaviour(PixelCloning):
    """The decoder is the model's. A CheckpointError where the model is damaged."""

    kind = PolicyStage

    def __init__(self, record: StageRecord) -> None:
        own: CLAMConfig = record.config.baselines.clam
        self.inverse, self._decoder = load_model(record.parents["clam_model"], record.device)
        super().__init__(record, own.shift, own.loss)

    def infer(self, source: EpisodeFrames, moves: Transitions) -> Tensor:
        return inferred(self.inverse, source.pixels, Ends.of(source).past(moves.rows + 1, 3), self.device)

    def new_decoder(self, latent_dim: int, state_dim: int) -> ActionDecoder:  # noqa: ARG002
        return self._decoder


def load_model(model: StageCheckpoint, device: torch.device | str) -> tuple[Inverse, ActionDecoder]:
    own, (sizes, env) = model.group(CLAMConfig, NAME), model.sizes

    def build() -> tuple[Inverse, Forward, ActionDecoder]:
        decoder = sizes.action_decoder, own.latent_dim, env.action_dim
        return Inverse(own, env.image_size), Forward(own), ActionDecoder(*decoder)

    inverse, _, decoder = model.restore_several(("inverse", "forward", "action_decoder"), build, device)
    return inverse, decoder


def model(record: StageRecord) -> Training:
    config, device = record.config, record.device
    own: CLAMConfig = config.baselines.clam
    assert record.labelled is not None
    with global_seed(config.seed, 0, record.name):
        inverse, forward = Inverse(own, config.env.image_size).to(device), Forward(own).to(device)
        decoder = ActionDecoder(config.model.action_decoder, own.latent_dim, config.env.action_dim).to(device)
    labelled = LabelledMoves(record.labelled, config, device)
    stage = CLAMStage(inverse, forward, decoder, record.clips(2, shown=256), labelled, own)
    known = config.behaviour.labelled_demos
    return on_pairs(record, stage, own.model, labels=f", {known} labelled")


def policy(record: StageRecord) -> Training:
    config, own = record.config, record.config.baselines.clam
    behaviour = CLAMBehaviour(record)
    stage = behaviour.policy_stage()
    assert isinstance(stage, PolicyStage)
    stage.decoder = behaviour.decoder
    part = Part("clam.policy", stage, own.policy, group="baselines.clam.policy")
    return cloning_alone(record, part, len(stage.targets), labelled=config.behaviour.labelled_demos)
