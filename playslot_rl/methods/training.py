"""Training a method: its stages one after the other, each of them from what its `StageSpec` says."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from playslot_rl.config import ExperimentConfig, plugins
from playslot_rl.config.env import VIDEO
from playslot_rl.config.methods import METHODS
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.data.demonstrations import (
    labelled_rows,
    moving_frames,
    require_finite,
    require_labelled,
)
from playslot_rl.envs import RECORDED, check_task
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.methods.online.config import OnlineConfig
from playslot_rl.runs import Run
from playslot_rl.runs.opening import require_parent, run_to_write
from playslot_rl.runtime.processes import here
from playslot_rl.seeds.episodes import EPISODES
from playslot_rl.storage.checkpoints import StageCheckpoint, require_config, require_parents, require_whole
from playslot_rl.training.pace import Pace
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import run_stage


@runtime_checkable
class Checking(Protocol):
    """Settings of a method that refuse what does not fit, before anything is computed."""

    def check(self, name: str, config: ExperimentConfig) -> None:
        """Look, by the dotted name of these settings; a ConfigError or CheckpointError where something does not fit."""


def check_method(config: ExperimentConfig, name: str) -> None:
    """Refuse what a method cannot be trained with, before anything is computed: a ConfigError or CheckpointError."""
    method = METHODS[name]
    if method.online:
        require_online(config, getattr(config.baselines, name), name)
    for group in dict.fromkeys(group for stage in method.stages for group in stage.groups):
        own = attrgetter(group)(config)
        if isinstance(own, Checking):
            own.check(group, config)


def train(config: ExperimentConfig) -> StageCheckpoint:
    """Train `config.method` into `OUT/STAGE`; killed, the same command carries on; finished, it says so.

    Raises:
        ConfigError: what `check_method` refuses.
        CheckpointError: no finished parent, or `out` was begun otherwise.
        DataError: no videos, too few demonstrations, or none with actions.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    method = METHODS[config.method]
    check_method(config, config.method)
    run, config = run_to_write(config), of_recorded(config)
    if method.model is None:
        return train_stage(method.last, config, run)
    parents, sizes = dict[str, StageCheckpoint](), method.last.sizes
    model, world = config.model, Run.of(config, run.folder) if method.slots else None
    if world is not None:
        parents["slots"] = world.stage("slots")
        require_parent(config, run, parents["slots"], "image_size")
        model = replace(model, savi=parents["slots"].sizes[0].savi)

    def ready() -> None:
        run.take(parents[own.name])
        if world is not None:
            run.build_on(world)

    groups = {"model": plugins.call(sizes, config, model)} if sizes else {}
    record, own = StageRecord(method.last, run.folder, config, parents, groups, ready), method.model
    parents[own.name] = _model(own, record, run)
    return run_stage(record, partial(plugins.call, record.spec.parts, record))


def train_stage(spec: StageSpec, config: ExperimentConfig, run: Run, pace: Pace | None = None) -> StageCheckpoint:
    """Train one stage into a run, on `data.root` or the demonstrations, and on the world model of `config.run`; raises
    as `train`.
    """
    if not spec.parents:
        record = StageRecord(spec, run.folder, config, pace=pace)
        return run_stage(record, partial(plugins.call, spec.parts, record))
    world = Run.of(config, run.folder)
    slots = world.own if spec.copies else world.stage
    parents = world.world_stages if "dynamics" in spec.parents else {"slots": slots("slots")}
    for checkpoint in parents.values():
        require_parent(config, run, checkpoint, "image_size")
    groups: dict[str, Any] = {}
    if "dynamics" in parents:
        groups["model"], env = world.world_config
        if config.env.name not in RECORDED or groups["model"].inverse_dynamics.mode == "ground_truth":
            require_parent(config, run, parents["dynamics"], "action_dim")
        elif config.env.action_dim == env.action_dim:  # nothing was typed, and unlabelled videos do not say it
            config = _with_width(StageRecord(spec, run.folder, config))
        groups["env"] = replace(env, action_dim=config.env.action_dim)
        if env.name == VIDEO:  # a model of videos knows no tasks
            groups["env"] = replace(groups["env"], task=config.env.task)
        elif env.tasks and env.serves(config.env):  # maybe one of them
            groups["env"] = config.env
    else:
        groups["model"] = replace(config.model, savi=parents["slots"].sizes[0].savi)
    if spec.sizes:
        groups["model"] = plugins.call(spec.sizes, config, groups["model"])
    ready = partial(run.take, parents["slots"]) if spec.copies else partial(run.build_on, world)
    record = StageRecord(spec, run.folder, config, parents, groups, ready, pace)
    return run_stage(record, partial(plugins.call, spec.parts, record))


def of_recorded(config: ExperimentConfig) -> ExperimentConfig:
    """Of a set that was recorded elsewhere, the config with the demonstrations as videos, too, where none are named,
    and the width of their actions where none is typed."""
    method, data = METHODS[config.method], config.data
    if config.env.name not in RECORDED or not method.acts or not (data.root or data.demos):
        return config
    config = replace(config, data=replace(data, root=data.root or data.demos))
    return config if config.env.action_dim != 1 else _with_width(StageRecord(method.last, Path(config.out), config))


def _with_width(record: StageRecord) -> ExperimentConfig:
    """The config with the width of the demonstrations' actions, where some are named that have any."""
    actions, config = record.videos.actions if record.roots else None, record.config
    return config if actions is None else replace(config, env=replace(config.env, action_dim=actions.shape[1]))


def train_model(config: ExperimentConfig, spec: StageSpec, folder: Path) -> StageCheckpoint:
    """Train the model of unlabelled videos that methods build on into a run, or find it there; raises as `train`."""
    method = spec.name if spec.name in METHODS else config.method
    world = config.run if spec.parents else ""
    return train_stage(spec, replace(config, method=method, out=str(folder), run=world), Run(folder))


def _model(spec: StageSpec, record: StageRecord, run: Run) -> StageCheckpoint:
    """The model that a method builds on: of the run that `baselines.METHOD.world` names, or trained into its own.

    What the method will clone is looked at before a model is trained for it.
    """
    config, labelled = record.config, record.spec.data == "demos" and METHODS[record.config.method].some_labelled
    count = config.behaviour.labelled_demos if labelled else None
    record.data.require_actions(config.env.action_dim)
    if count is not None:
        require_labelled(count, record.demos.trained.recordings)
    require_finite(record.demos, count)
    world = getattr(getattr(config.baselines, config.method), "world", "")
    if not world:
        if not run.has(spec.name) and not spec.parents:
            _require_moving(record, count)
        return train_model(config, spec, run.folder)
    other = Run(Path(world))
    if not other.has(spec.name):
        raise CheckpointError(
            f"baselines.{config.method}.world={world}: got no {other.place(spec.name)}, expected a run with "
            f"{spec.title}: name another, or leave it out to train one"
        )
    model = other.own(spec.name)
    require_whole(model)
    require_parent(config, run, model, "image_size")
    require_parents(model, {name: record.parents[name] for name in spec.parents})
    shared = [key for key in record.spec.keys if key in spec.keys]
    wanted = StageRecord(replace(spec, keys=tuple(shared), settings=()), run.folder, config).finishes()
    require_config(model, wanted, record.spec.typed)
    mine, theirs = StageRecord(spec, run.folder, config).labels, model.meta.get("labelled", "none")
    if mine != theirs:
        raise CheckpointError(
            f"baselines.{config.method}.world={world}: got {spec.title} of the labels {theirs}, expected {mine}: leave "
            "it out to train one"
        )
    return model


def _require_moving(record: StageRecord, labelled: int | None) -> None:
    threshold, margin = record.config.behaviour.trim_pixels, record.config.behaviour.trim_margin
    moves = moving_frames(record.demos.trained, threshold, margin)
    if labelled is not None:
        labelled_rows(moves.episode, labelled)
    if record.demos.held_out is not None:
        moving_frames(record.demos.held_out, threshold, margin)


def require_online(config: ExperimentConfig, online: OnlineConfig, method: str) -> None:
    """Refuse what cannot be learned by acting, before anything is started: a ConfigError for several processes, an
    environment without simulator, blocks without dense reward, or more episodes than a seed has.
    """
    if here().world > 1:
        raise ConfigError(
            f"method={method}: got {here().world} processes, expected one: it learns by acting; start it without "
            "torchrun or accelerate launch"
        )
    check_task(config.env, success=True)
    if config.data.stride > 1:
        raise ConfigError(
            f"data.stride: got {config.data.stride}, expected 1: {method} learns by acting, not from data"
        )
    if config.env.name.startswith("block_") and config.env.blocks.reward != "dense":
        raise ConfigError(
            f"env.blocks.reward: got {config.env.blocks.reward} with method={method}, expected dense: "
            "methods that learn by acting need a dense reward; set env.blocks.reward=dense"
        )
    episodes = online.steps // config.env.max_steps + online.envs
    if episodes > EPISODES:
        raise ConfigError(
            f"steps: got {episodes} episodes, expected at most {EPISODES}; lower it, or raise env.max_steps"
        )
