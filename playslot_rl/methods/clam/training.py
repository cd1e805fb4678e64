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

import numpy as np
import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import DemonstrationSplit, Transitions
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.windows import IntArray
from playslot_rl.frames import normalise
from playslot_rl.losses.behaviour import BehaviourLoss
from playslot_rl.methods.clam.method import NAME, CLAMConfig
from playslot_rl.methods.clam.model import CLAMPolicy, Forward, Inverse
from playslot_rl.methods.cloning import LatentCloning
from playslot_rl.methods.supervised import Ends, LabelledMoves
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.runtime.precision import autocast
from playslot_rl.runtime.processes import spread
from playslot_rl.runtime.shares import own_rows
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.storage.checkpoints import StageCheckpoint, load_weights
from playslot_rl.training.demonstrated import cloned
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord, Training
from playslot_rl.training.stage_regression import RegressionStage, apart, together
from playslot_rl.world_model import module_device

BATCH = 64


class CLAMStage:
    """Inverse model, forward model and decoder together, trained in place."""

    def __init__(
        self, inverse: Inverse, forward: Forward, decoder: ActionDecoder, clips: Clips, labelled: LabelledMoves,
        config: CLAMConfig,
    ) -> None:  # fmt: skip
        self.inverse, self.forward, self.decoder = inverse, forward, decoder
        self.clips, self.labelled, self.config, self.ends = clips, labelled, config, Ends.of(clips.source)
        frames = self._frames(clips.spread(clips.train_episodes)[:, 0])
        self.still = max(1e-6, float((frames[:, 2] - frames[:, 1]).square().mean()))

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"inverse": self.inverse, "forward": self.forward, "action_decoder": self.decoder}

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        count = self.config.model.batch_size
        rows = triples(self.ends, self.clips.sample(count, generators.numpy("moves"))[:, 0])
        known, actions = self.labelled.draw(count, generators)
        frames = self.labelled.pixels(own_rows(triples(self.labelled.ends, known)))
        videos = self.clips.pixels(own_rows(rows), module_device(self.inverse))
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
            frames = self._frames(rows[:, 0])
            error = self.forward(frames[:, :2], self.inverse(frames)) - frames[:, 2]
            return float(error.square().sum()), float((frames[:, 2] - frames[:, 1]).square().sum())

        batches = np.array_split(self.clips.held_out, -(-len(self.clips.held_out) // BATCH))
        errors, stills = zip(*spread(batches, look), strict=True)
        return {"unexplained": sum(errors) / max(1e-6, sum(stills))}

    def _frames(self, rows: IntArray) -> Tensor:
        return normalise(self.clips.pixels(triples(self.ends, rows), module_device(self.inverse)))


def triples(ends: Ends, rows: IntArray) -> IntArray:
    """Rows (B, 3) of the frame before each of `rows` (B,), of itself, and of the next."""
    return np.stack((ends.before(rows), rows, rows + 1), axis=1)


@torch.no_grad()
def infer_latents(
    inverse: Inverse, source: EpisodeFrames, moves: Transitions, device: torch.device | str = "cpu"
) -> Tensor:
    """Latent actions (M, Z) of transitions; the model in evaluation mode."""
    ends = Ends.of(source)
    parts = np.array_split(moves.rows, -(-len(moves.rows) // BATCH))
    return torch.cat([inverse(source.pixels(triples(ends, rows)).to(device)) for rows in parts])


class PolicyStage(RegressionStage):
    """Trains the policy; the decoder, which stays as it is, is stored beside it."""

    decoder: ActionDecoder

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {**super().modules, "action_decoder": self.decoder}


class CLAMBehaviour(LatentCloning):
    """See `LatentCloning`; the decoder is the model's. A CheckpointError where the model is damaged."""

    kind = PolicyStage

    def __init__(
        self, config: ExperimentConfig, model: StageCheckpoint, demos: DemonstrationSplit, device: torch.device
    ) -> None:
        self.own: CLAMConfig = config.baselines.clam
        self.inverse, self.decoder = load_model(model, device)
        super().__init__(config, demos, device, self.own.shift, self.own.policy, self.own.loss)
        with global_seed(config.seed, 0, NAME):
            self.policy = CLAMPolicy(self.own, config.env.image_size).to(device)

    def infer(self, source: EpisodeFrames, moves: Transitions) -> Tensor:
        return infer_latents(self.inverse, source, moves, self.device)

    def criterion(self) -> BehaviourLoss:
        criterion = BehaviourLoss(self.policy, self.own.loss)
        criterion.set_keys(observation=keys.PIXELS)
        return criterion


def load_model(model: StageCheckpoint, device: torch.device | str) -> tuple[Inverse, ActionDecoder]:
    own, (sizes, env) = model.group(CLAMConfig, NAME), model.sizes
    with torch.random.fork_rng(devices=[]):
        inverse, forward = Inverse(own, env.image_size), Forward(own)
        decoder = ActionDecoder(sizes.action_decoder, own.latent_dim, env.action_dim)
    load_weights(model, {"inverse": inverse, "forward": forward, "action_decoder": decoder})
    return inverse.to(device).eval().requires_grad_(False), decoder.to(device).eval().requires_grad_(False)


def model(record: StageRecord) -> Training:
    config, device = record.config, record.device
    own: CLAMConfig = config.baselines.clam
    assert record.labelled is not None
    with global_seed(config.seed, 0, record.name):
        inverse, forward = Inverse(own, config.env.image_size).to(device), Forward(own).to(device)
        decoder = ActionDecoder(config.model.action_decoder, own.latent_dim, config.env.action_dim).to(device)
    labelled = LabelledMoves(record.labelled, config, device)
    stage = CLAMStage(inverse, forward, decoder, record.clips(2, shown=256), labelled, own)
    return Training(
        [Part("baselines.clam.model", stage, own.model)],
        device,
        lambda metrics: (
            f"{record.name}: {100 * metrics.get('unexplained', float('nan')):.0f} % of the change left on held-out "
            f"frames, {config.behaviour.labelled_demos} labelled, {record.folder}"
        ),
        extra={"episodes": record.data.episodes},
    )


def policy(record: StageRecord) -> Training:
    config, own = record.config, record.config.baselines.clam
    behaviour = CLAMBehaviour(config, record.parents["clam_model"], record.demos, record.device)
    stage = behaviour.policy_stage()
    assert isinstance(stage, PolicyStage)
    stage.decoder = behaviour.decoder
    said, extra = cloned(record.name, record.demos, len(stage.targets), config.behaviour.labelled_demos)
    part = Part("clam.policy", stage, own.policy, group="baselines.clam.policy")
    return Training([part], record.device, lambda _: f"{said}, {record.folder}", extra=extra)
