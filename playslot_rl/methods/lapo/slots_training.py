"""Trainings of LAPO on slots: inverse and forward model on parsed videos; then PlaySlot's policy and decoder on their
latents, as `behaviour` says.

    L = mean (S^_{t+1} - S_{t+1})^2 / mean (S_t - S_{t+1})^2 + L_VQ

Shapes: M transitions, F frames, N slots, D slot width, Z latent-action width.
"""

from __future__ import annotations

from dataclasses import fields
from functools import partial

import numpy as np
import torch
from torch import Tensor

from playslot_rl.config import StageConfig
from playslot_rl.data.cache import Cache
from playslot_rl.data.demonstrations import Transitions
from playslot_rl.data.neighbours import Ends
from playslot_rl.data.slot_cache import slot_cache
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.losses.behaviour import BehaviourLoss
from playslot_rl.methods.cloning import LatentCloning, Seen, cloning, inferred
from playslot_rl.methods.lapo.slots import SlotForward, SlotInverse
from playslot_rl.methods.lapo.slots_method import MODEL, LAPOSlotsConfig
from playslot_rl.methods.lapo.training import TWO, LAPOModelStage, on_pairs
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.demonstrated import demonstration_views, moves
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training
from playslot_rl.training.stage_regression import PairedInputs, TensorInputs


def model(record: StageRecord) -> Training:
    config, device, slots = record.config, record.device, record.parents["slots"]
    own: LAPOSlotsConfig = config.baselines.lapo_slots
    savi = record.world.load_savi(device)
    sizes = own, config.model.policy, savi.config.slot_dim
    with global_seed(config.seed, 0, record.name):
        inverse, forward = SlotInverse(*sizes).to(device), SlotForward(*sizes).to(device)
    place, progress = Cache.of(config.data), config.logging.progress
    cached = slot_cache(record.data, savi, slots.fingerprint, place, device, progress)
    stage = LAPOModelStage(inverse, forward, record.clips(2, shown=256), own.model, cached)
    return on_pairs(record, stage, own.model)


class LAPOSlotsBehaviour(LatentCloning):
    """See `LatentCloning`: on slots, of what moves in them, and with shifted copies."""

    def __init__(self, record: StageRecord) -> None:
        config, device, demos = record.config, record.device, record.demos
        own: LAPOSlotsConfig = config.baselines.lapo_slots
        savi = record.world.load_savi(device)
        width = savi.config.slot_dim
        sizes = own, config.model.policy, width
        self.own, self.noise, self.whole = own, config.behaviour.slot_noise, demos.trained
        done = record.parents[MODEL.name]
        self.inverse, _ = done.restore_several(TWO, lambda: (SlotInverse(*sizes), SlotForward(*sizes)), device)
        views, others = demonstration_views(config, demos, savi, record.prints["slots"])
        self.views, self.others = [frames for frames, _ in views], [frames for frames, _ in others]
        self.parsed = {id(frames): slots for frames, slots in (*views, *others)}
        schedule = StageConfig(**{part.name: getattr(config.behaviour, part.name) for part in fields(StageConfig)})
        super().__init__(config, demos, device, 0, schedule, config.behaviour.loss)
        with global_seed(config.seed, 0, record.name):
            tasks = len(config.env.tasks)
            self.policy = LatentPolicy(config.model.policy, width, own.latent_dim, tasks=tasks).to(device)
            decoder = record.groups["model"].action_decoder  # which reads the slots that the policy sees
            self.decoder = ActionDecoder(decoder, own.latent_dim, config.env.action_dim, width).to(device)

    def infer(self, source: EpisodeFrames, moves: Transitions) -> Tensor:
        slots, rows = self.parsed[id(source)], Ends.of(source).past(moves.rows + 1, self.own.frames)
        infer = partial(self.inverse.latents, self.own.targets)
        return inferred(infer, lambda some: torch.from_numpy(slots[some]), rows, self.device)

    def criterion(self) -> BehaviourLoss:
        return BehaviourLoss(self.policy, self.loss)

    def _seen(self, source: EpisodeFrames, shift: int = 0) -> Seen:  # noqa: ARG002
        views = self.views if source is self.whole else self.others
        found = moves([(view, self.parsed[id(view)]) for view in views], self.config, self.device)
        latents = [self.infer(view, moving) for view, moving in zip(views, found.found, strict=True)]
        parts = ([getattr(moving, name) for moving in found.found] for name in ("rows", "episode", "step"))
        rows, episode, step = map(np.concatenate, parts)
        joined = Transitions(rows, episode, step, found.found[0].lengths)
        inputs = PairedInputs.told(TensorInputs(found.slots, self.noise, "policy_noise"), found.told)
        return Seen(inputs, torch.cat(latents), found.actions, joined, found.told)


def policy(record: StageRecord) -> Training:
    behaviour, own = LAPOSlotsBehaviour(record), record.config.behaviour
    return cloning(record, behaviour, own.decoder_steps, own.decoder_lr, "behaviour", len(behaviour.views))
