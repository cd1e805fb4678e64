"""Training of the slot oracle: sizes are `model.policy`, the schedule is `behaviour`, as for PlaySlot's policy."""

from __future__ import annotations

from playslot_rl.data.demonstrations import require_finite
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.demonstrated import cloning_alone, demonstration_views, moves
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training
from playslot_rl.training.stage_behaviour import oracle_stage
from playslot_rl.world_model import untrained_oracle


def training(record: StageRecord) -> Training:
    config = record.config
    device, split = record.device, record.demos
    split.trained.require_actions(config.env.action_dim)  # before anything is computed
    require_finite(split)
    savi = record.world.load_savi(device)
    with global_seed(config.seed, 0, record.name):
        oracle = untrained_oracle(config.model.policy, savi.config.slot_dim, config.env).to(device)
    views, others = demonstration_views(config, split, savi, record.prints["slots"])
    seen, other = moves(views, config, device), moves(others, config, device) if others else None
    measured = other and (other.slots, other.actions, other.told)
    stage = oracle_stage(oracle, seen.slots, seen.actions, config.behaviour, measured, seen.told)
    part = Part(record.name, stage, config.behaviour, group="behaviour")
    return cloning_alone(record, part, len(seen.slots), views=len(views))
