"""Training of the slot oracle: sizes are `model.policy`, the schedule is `behaviour`, as for PlaySlot's policy."""

from __future__ import annotations

import torch
from torch import Tensor

from playslot_rl.data.demonstrations import moving_slots, real_actions, require_finite, told_tasks, transitions
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.demonstrated import ParsedVideos, cloning_alone, demonstration_views
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training
from playslot_rl.training.stage_behaviour import oracle_stage


def training(record: StageRecord) -> Training:
    config = record.config
    device, split, width = record.device, record.demos, config.env.action_dim
    split.trained.require_actions(width)  # before anything is computed
    require_finite(split)
    savi = record.world.load_savi(device)
    with global_seed(config.seed, 0, record.name):
        sizes, tasks = savi.config.slot_dim, len(config.env.tasks)
        oracle = LatentPolicy(config.model.policy, sizes, width, acts=True, tasks=tasks).to(device)

    behaviour = config.behaviour

    def examples(views: list[ParsedVideos]) -> tuple[Tensor, Tensor, Tensor | None]:
        trim, margin = behaviour.trim, behaviour.trim_margin
        moves = [moving_slots(transitions(frames), cached, trim, margin) for frames, cached in views]
        rows = [moving.rows for moving in moves]
        told = [told_tasks(frames, moving, config.env) for (frames, _), moving in zip(views, moves, strict=True)]
        task = torch.cat([each.to(device) for each in told if each is not None]) if config.env.tasks else None
        slots = [torch.from_numpy(cached[at]) for (_, cached), at in zip(views, rows, strict=True)]
        actions = [real_actions(frames, at, width) for (frames, _), at in zip(views, rows, strict=True)]
        return torch.cat(slots).to(device), torch.cat(actions).to(device), task

    views, others = demonstration_views(config, split, savi, record.prints["slots"])
    slots, actions, task = examples(views)
    stage = oracle_stage(oracle, slots, actions, behaviour, examples(others) if others else None, task)
    part = Part(record.name, stage, config.behaviour, group="behaviour")
    return cloning_alone(record, part, len(slots), views=len(views))
