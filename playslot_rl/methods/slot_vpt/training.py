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

from playslot_rl.config import BehaviourStageConfig, ExperimentConfig
from playslot_rl.data.demonstrations import FRAMES_AT_ONCE, labelled_rows, require_finite, require_labelled
from playslot_rl.methods.slot_vpt.load import networks
from playslot_rl.methods.slot_vpt.method import NAME
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.demonstrated import ParsedVideos, cloned, demonstration_views, moves
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training
from playslot_rl.training.stage_behaviour import oracle_stage
from playslot_rl.training.stage_regression import RegressionStage


class Changes(NamedTuple):
    """Transitions: slots before (M, N, D) and their change to those after, real actions (M, A), the demonstration of
    each int64 (M,), and what a policy is told (M, ...).
    """

    slots: Tensor
    change: Tensor
    actions: Tensor
    episode: Tensor
    told: Tensor | None

    @classmethod
    def of(cls, views: list[ParsedVideos], config: ExperimentConfig, device: torch.device) -> Changes:
        """Those of demonstrations in which slots move."""
        seen = moves(views, config, device)
        after = [torch.from_numpy(slots[at.rows + 1]) for (_, slots), at in zip(views, seen.found, strict=True)]
        episode = torch.cat([torch.from_numpy(at.episode) for at in seen.found]).to(device)
        return cls(seen.slots, torch.cat(after).to(device) - seen.slots, seen.actions, episode, seen.told)

    def scale(self) -> Tensor:
        """k, which is finite where nothing moves, too."""
        return self.slots.std() / self.change.std().clamp_min(torch.finfo(self.change.dtype).eps)

    def pairs(self, scale: Tensor, rows: Tensor | slice = slice(None)) -> Tensor:
        """What the labeller reads (M', N, 2 D) of some transitions."""
        return torch.cat((self.slots[rows], scale * self.change[rows]), dim=-1)


def labeller_stage(
    labeller: LatentPolicy, seen: Changes, scale: Tensor, own: BehaviourStageConfig, other: Changes | None
) -> RegressionStage:
    """Real actions of the labelled demonstrations from their slots; those of held-out ones only measure."""
    rows = labelled_rows(seen.episode, own.labelled_demos)
    measured = other and (other.pairs(scale), other.actions, None)
    return oracle_stage(labeller, seen.pairs(scale, rows), seen.actions[rows], own, measured, name="labeller")


@torch.no_grad()
def pseudo_labels(labeller: LatentPolicy, seen: Changes, scale: Tensor, labelled: int) -> Tensor:
    """Actions (M, A) that stand in for the real ones; where these are labelled, they themselves."""
    labeller.eval()
    every = torch.arange(len(seen.slots), device=seen.slots.device)
    said = torch.cat([labeller(seen.pairs(scale, rows)) for rows in every.split(FRAMES_AT_ONCE)]).clamp(-1, 1)
    return torch.where((seen.episode < labelled)[:, None], seen.actions, said)


def training(record: StageRecord) -> Training:
    """The labeller, and the policy on what it says of all demonstrations."""
    config, device, split = record.config, record.device, record.demos
    own, width = config.behaviour, config.env.action_dim
    split.trained.require_actions(width)  # before anything is computed
    require_labelled(own.labelled_demos, split.trained.recordings)
    require_finite(split, own.labelled_demos)
    savi = record.world.load_savi(device)
    with global_seed(config.seed, 0, record.name):
        labeller, policy = networks(config.model.policy, savi.config.slot_dim, config.env)
        labeller, policy = labeller.to(device), policy.to(device)
    views, others = demonstration_views(config, split, savi, record.prints["slots"])
    seen, other = Changes.of(views, config, device), Changes.of(others, config, device) if others else None
    scale = seen.scale()

    def parts() -> Iterator[Part]:
        schedule = replace(own, steps=own.decoder_steps, optim=replace(own.optim, lr=own.decoder_lr))
        renamed = {"steps": "behaviour.decoder_steps", "optim.lr": "behaviour.decoder_lr"}
        stage, labelled = labeller_stage(labeller, seen, scale, own, other), {"labelled_demos": own.labelled_demos}
        yield Part(f"{NAME}.labeller", stage, schedule, group="behaviour", renamed=renamed, identity=labelled)
        actions = pseudo_labels(labeller, seen, scale, own.labelled_demos)
        measured = other and (other.slots, other.actions, other.told)
        cloning = oracle_stage(policy, seen.slots, actions, own, measured, seen.told)
        yield Part(f"{NAME}.policy", cloning, own, "policy", "behaviour", identity=labelled)

    said, extra = cloned(NAME, split, len(seen.actions), own.labelled_demos, len(views))
    return Training(parts(), device, lambda _: f"{said}, {record.folder}", extra=extra)
