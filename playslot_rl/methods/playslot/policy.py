"""Training of PlaySlot's policy: latent policy with the slot oracle beside it, action decoder, and both together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from playslot_rl.config import BehaviourStageConfig, DynamicsStageConfig, ExperimentConfig, ModelConfig
from playslot_rl.data.demonstrations import (
    Demonstrations,
    label_demonstrations,
    require_finite,
    require_labelled,
    with_copies,
)
from playslot_rl.data.slot_cache import SlotRows
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.methods.cloning import slot_sizes
from playslot_rl.runs.opening import require_task
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.demonstrated import cloned, demonstration_views, policy_taken_over
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training
from playslot_rl.training.stage import Stage
from playslot_rl.training.stage_behaviour import CloneStage, FinetuneStage, after_cloning, cloning_settings
from playslot_rl.world_model import Agent


def sizes(config: ExperimentConfig, model: ModelConfig) -> ModelConfig:
    whiten, decoder = config.behaviour.whiten, slot_sizes(config, model).action_decoder
    policy = replace(config.model.policy, whiten=whiten, gain=config.behaviour.gain)
    return replace(model, policy=policy, action_decoder=replace(decoder, whiten=whiten))


def training(record: StageRecord) -> Training:
    """The frozen world model's view of the demonstrations; fresh policy, oracle and decoder on top of it."""
    config, split, device = record.config, record.demos, record.device
    behaviour = config.behaviour
    split.trained.require_actions()  # before anything is computed
    require_labelled(behaviour.labelled_demos, split.trained.recordings)
    require_finite(split, None if behaviour.oracle else behaviour.labelled_demos)
    world = record.world.load_world_model(device)
    if (config.env.tasks or world.env.tasks) and not world.env.serves(config.env):
        require_task(config, world.env, ("task",))
    world.config, world.env = record.groups["model"], record.groups["env"]
    with global_seed(config.seed, 0, "policy"):
        agent = Agent.untrained(world, oracle=behaviour.oracle).to(device)
    views, others = demonstration_views(config, split, world.savi, record.prints["slots"])

    def label(frames: EpisodeFrames, slots: SlotRows) -> Demonstrations:
        return label_demonstrations(world, frames, slots, device, behaviour.trim, behaviour.trim_margin)

    demos = with_copies([label(*view) for view in views])
    held_out = next((label(*view) for view in others), None)
    dynamics = record.parents["dynamics"].group(DynamicsStageConfig, "dynamics")
    horizon = dynamics.seed_frames - 1 + dynamics.predicted_frames
    demos.labelled(behaviour.labelled_demos)  # none that say anything are refused before anything is trained

    def parts() -> Iterator[Part]:
        cloning = cloning_settings(behaviour)
        clone = CloneStage(agent.policy, agent.oracle, demos, cloning, held_out, horizon)
        yield Part("policy", clone, cloning, group="behaviour")
        agent.eval()
        decoder, given = agent.action_decoder, (held_out, horizon)

        def finetune() -> FinetuneStage:
            return FinetuneStage(clone.stages["policy"], decoder, demos, behaviour, *given)

        part = partial(_part, behaviour)
        yield from after_cloning(decoder, agent.policy, demos, behaviour, part, finetune, *given)

    said, extra = cloned("policy", split, len(demos.slots), behaviour.labelled_demos, len(views))
    return Training(
        parts(),
        device,
        lambda _: f"{said}, {record.folder}",
        extra={
            **extra,
            "held_out_demos": 0 if held_out is None else len(held_out.lengths),
            "data_root": record.roots,
        },
        adopt=policy_taken_over(config, record, behaviour.steps),
    )


def _part(behaviour: BehaviourStageConfig, name: str, stage: Stage, steps: int, lr: float) -> Part:
    own, group = replace(behaviour, steps=steps, optim=replace(behaviour.optim, lr=lr)), name.partition("_")[0]
    renamed = {"steps": f"behaviour.{group}_steps", "optim.lr": f"behaviour.{group}_lr"}
    return Part(name, stage, own, folder=name, group="behaviour", renamed=renamed)
