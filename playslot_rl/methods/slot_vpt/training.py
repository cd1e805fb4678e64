"""Training of VPT on slots (after Baker et al., "Video PreTraining", 2022, section 2): what few labels teach to tell
from two frames' slots stands in for the labels of all videos.

    c_t = k (S_{t+1} - S_t),                k such that in all videos c varies as much as S
    a^_t = clamp(g(S_t, c_t), -1, 1),       L_g = mean |g(S_t, c_t) - a_t|   on the labelled demonstrations
    pi(S_t) ~ a^_t, on the labelled a_t,                                     on all

The simplest way to use the same videos and labels as PlaySlot: no latent actions, no world model beyond SAVi. g is the
policy's network on a slot and its change beside each other, trained as PlaySlot's action decoder
(`behaviour.decoder_steps`, `behaviour.decoder_lr`), pi as the Slot Oracle. Losses are absolute or squared
(`behaviour.loss`).

Note: the paper's inverse model reads 128 frames and learns from 2,000 hours of labels. Of S_{t+1} in place of c_t a few
labels teach much less (on easy BlockPush five leave 0.40 of the held-out variance unexplained, not 0.17): a step
changes slots by an eighth of their spread.

Shapes: M transitions, N slots, D slot width, A action width.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig
from playslot_rl.data.demonstrations import (
    FRAMES_AT_ONCE,
    labelled_rows,
    moving_slots,
    real_actions,
    require_finite,
    require_labelled,
    told_tasks,
    transitions,
)
from playslot_rl.losses.behaviour import BehaviourLoss
from playslot_rl.methods.slot_vpt.load import networks
from playslot_rl.methods.slot_vpt.method import NAME
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.demonstrated import ParsedVideos, cloned, demonstration_views
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training
from playslot_rl.training.stage_behaviour import VALIDATED, oracle_stage
from playslot_rl.training.stage_regression import RegressionStage, TensorInputs


class Moves(NamedTuple):
    """Transitions: slots before (M, N, D) and their change to those after, real actions (M, A), the demonstration of
    each int64 (M,), and its task (M, 1) where there are several.
    """

    slots: Tensor
    change: Tensor
    actions: Tensor
    episode: Tensor
    task: Tensor | None

    def gain(self) -> Tensor:
        """k."""
        return self.slots.std() / self.change.std()

    def pairs(self, gain: Tensor, rows: Tensor | slice = slice(None)) -> Tensor:
        """What the labeller reads (M', N, 2 D) of some transitions."""
        return torch.cat((self.slots[rows], gain * self.change[rows]), dim=-1)


def moves(views: list[ParsedVideos], config: ExperimentConfig, device: torch.device) -> Moves:
    """The transitions of demonstrations in which slots move."""
    own, width = config.behaviour, config.env.action_dim
    before, after, actions, episode, task = (list[Tensor]() for _ in range(5))
    for frames, slots in views:
        moving = moving_slots(transitions(frames), slots, own.trim, own.trim_margin)
        before.append(torch.from_numpy(slots[moving.rows]))
        after.append(torch.from_numpy(slots[moving.rows + 1]))
        actions.append(real_actions(frames, moving.rows, width))
        episode.append(torch.from_numpy(moving.episode))
        told = told_tasks(frames, moving, config.env)
        task += [] if told is None else [told]
    seen, then, acted, of = (torch.cat(part).to(device) for part in (before, after, actions, episode))
    return Moves(seen, then - seen, acted, of, torch.cat(task).to(device) if task else None)


def labeller_stage(
    labeller: LatentPolicy, seen: Moves, config: ExperimentConfig, other: Moves | None
) -> RegressionStage:
    """Real actions of the labelled demonstrations from their slots; those of held-out ones only measure."""
    own, gain = config.behaviour, seen.gain()
    rows = labelled_rows(seen.episode, own.labelled_demos)
    criterion = BehaviourLoss(labeller, own.loss)
    criterion.set_keys(action=keys.ACTION)
    return RegressionStage(
        "labeller",
        criterion,
        TensorInputs(seen.pairs(gain, rows), own.slot_noise, "labeller_noise"),
        seen.actions[rows],
        own.batch_size,
        held_out=other and (TensorInputs(other.pairs(gain)), other.actions),
        validated=VALIDATED,
        precision=own.precision,
    )


@torch.no_grad()
def pseudo_labels(labeller: LatentPolicy, seen: Moves, labelled: int) -> Tensor:
    """Actions (M, A) that stand in for the real ones; where these are labelled, they themselves."""
    labeller.eval()
    gain, every = seen.gain(), torch.arange(len(seen.slots), device=seen.slots.device)
    said = torch.cat([labeller(seen.pairs(gain, rows)) for rows in every.split(FRAMES_AT_ONCE)]).clamp(-1, 1)
    return torch.where((seen.episode < labelled)[:, None], seen.actions, said)


def training(record: StageRecord) -> Training:
    """The labeller, and the policy on what it says of all demonstrations."""
    config, device, split = record.config, record.device, record.demos
    own, width = config.behaviour, config.env.action_dim
    require_labelled(own.labelled_demos, split.trained.recordings)  # before anything is computed
    split.trained.require_actions(width)
    require_finite(split, own.labelled_demos)
    savi = record.world.load_savi(device)
    with global_seed(config.seed, 0, record.name):
        labeller, policy = networks(config.model.policy, savi.config.slot_dim, config.env)
        labeller, policy = labeller.to(device), policy.to(device)
    views, others = demonstration_views(config, split, savi, record.prints["slots"])
    seen, other = moves(views, config, device), moves(others, config, device) if others else None

    def parts() -> Iterator[Part]:
        schedule = replace(own, steps=own.decoder_steps, optim=replace(own.optim, lr=own.decoder_lr))
        renamed = {"steps": "behaviour.decoder_steps", "optim.lr": "behaviour.decoder_lr"}
        stage, labelled = labeller_stage(labeller, seen, config, other), {"labelled_demos": own.labelled_demos}
        yield Part(f"{NAME}.labeller", stage, schedule, group="behaviour", renamed=renamed, identity=labelled)
        actions = pseudo_labels(labeller, seen, own.labelled_demos)
        measured = other and (other.slots, other.actions, other.task)
        cloning = oracle_stage(policy, seen.slots, actions, own, measured, seen.task)
        yield Part(f"{NAME}.policy", cloning, own, "policy", "behaviour", identity=labelled)

    said, extra = cloned(NAME, split, len(seen.actions), own.labelled_demos, len(views))
    return Training(parts(), device, lambda _: f"{said}, {record.folder}", extra=extra)
