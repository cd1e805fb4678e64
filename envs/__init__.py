"""Simulated tasks: Gymnasium environments and their TorchRL form.

Importing this package registers the Gymnasium ids, which loads Gymnasium and nothing else; simulator and torch are
loaded when first used.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, cast

from playslot_rl import keys
from playslot_rl.config import BlocksConfig, EnvConfig, RenderConfig
from playslot_rl.config.env import VIDEO
from playslot_rl.config.families import FAMILIES, OGBENCH, member, own_camera
from playslot_rl.config.metaworld import NAME as METAWORLD
from playslot_rl.config.metaworld import NEAR
from playslot_rl.config.plain import nearest
from playslot_rl.config.tasks import TASKS
from playslot_rl.errors import ConfigError

if TYPE_CHECKING:
    import gymnasium as gym
    from torchrl.envs import EnvBase

    from playslot_rl.envs.pixel_task import PixelTask

_OURS: Final = {
    "button_press": ("PlaySlot/ButtonPress-v0", "playslot_rl.envs.metaworld:MetaWorldEnv"),
    METAWORLD: ("PlaySlot/MetaWorld-v0", "playslot_rl.envs.metaworld:MetaWorldEnv"),
    OGBENCH: ("PlaySlot/OGBench-v0", "playslot_rl.envs.ogbench:CubeTask"),
    "block_push": ("PlaySlot/BlockPush-v0", "playslot_rl.envs.block_push:BlockPushEnv"),
    "block_push_easy": ("PlaySlot/BlockPushEasy-v0", "playslot_rl.envs.block_push:BlockPushEnv"),
    "block_reach": ("PlaySlot/BlockReach-v0", "playslot_rl.envs.block_push:BlockReachEnv"),
    "block_pick": ("PlaySlot/BlockPick-v0", "playslot_rl.envs.block_push:BlockPickEnv"),
    "dmc_ball_in_cup_catch": ("PlaySlot/DMCBallInCupCatch-v0", "playslot_rl.envs.dmc:DMControlTask"),
    "dmc_cartpole_balance": ("PlaySlot/DMCCartpoleBalance-v0", "playslot_rl.envs.dmc:DMControlTask"),
    "gym": ("PlaySlot/Gym-v0", "playslot_rl.envs.gym_task:GymTask"),
}


SET_ID: Final = "PlaySlot/MetaWorldMT10-v0"
"""Gymnasium id of a set of Meta-World's tasks."""


class _Environments(Mapping[str, tuple[str, str]]):
    def __getitem__(self, name: str) -> tuple[str, str]:
        return _OURS[name] if name in _OURS else (TASKS[name].gym_id, TASKS[name].entry_point)

    def __iter__(self) -> Iterator[str]:
        return iter((*_OURS, *TASKS))

    def __len__(self) -> int:
        return len(_OURS) + len(TASKS)


ENVIRONMENTS: Final[Mapping[str, tuple[str, str]]] = _Environments()
"""Name in the configuration -> Gymnasium id and entry point, those of other packages last; `block_ids` has more ids of
the blocks family."""

PROCEDURAL = ("grid_shapes",)
"""Environments that are drawn, not simulated: they give videos, there is nothing to act on and no success."""

RECORDED = ("sketchy", VIDEO)
"""Videos that were recorded elsewhere: settings for training on them. `video` is any LeRobot data set."""


EASY: Final = BlocksConfig(distractors=0, colour="mediumblue")
"""One cube, always of the same colour."""


GYM: Final = EnvConfig("gym", frame_skip=1, max_steps=50, warmup_steps=0)
"""Any registered Gymnasium environment; `id` and `action_dim` are to be set."""


def family_config(name: str, task: str = "") -> EnvConfig:
    """Of a task of an environment that has several: as many agent steps as its expert takes, without warm-up; a
    ConfigError for an unknown task."""
    own: dict[str, Any] = {"action_dim": 5, "frame_skip": 4} if name == OGBENCH else {}
    try:
        made = EnvConfig(name, warmup_steps=0, task=task or FAMILIES[name].default, **own)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    return replace(made, max_steps=member(name, made.task).steps, camera=own_camera(name, made.task))


def play_config(env: EnvConfig) -> EnvConfig:
    """The task as unlabelled videos show it: OGBench's with random goals, others as they are."""
    return replace(env, goals="random") if env.name == OGBENCH else env


def block_config(name: str, blocks: BlocksConfig) -> EnvConfig:
    """25 agent steps of two environment steps, without warm-up."""
    return EnvConfig(name, frame_skip=2, max_steps=25, warmup_steps=0, blocks=blocks)


def block_ids() -> dict[str, tuple[str, EnvConfig]]:
    """Entry point and config of the blocks family's ids: every variant with every task, and the easy setting."""
    found = {}
    for variant in ("Push", "Reach", "Pick"):
        entry = f"playslot_rl.envs.block_push:Block{variant}Env"
        for task, suffix in {"red": "Red", "reddest": "Reddest", "odd": "Odd", "odd_groups": "OddGroups"}.items():
            config = block_config(f"block_{variant.lower()}", BlocksConfig(task=task))  # type: ignore[arg-type]
            found[f"PlaySlot/Block{variant}{suffix}-v0"] = entry, config
        found[f"PlaySlot/Block{variant}-v0"] = found[f"PlaySlot/Block{variant}Odd-v0"]
    easy = block_config("block_push_easy", EASY)
    return {**found, "PlaySlot/BlockPushEasy-v0": ("playslot_rl.envs.block_push:BlockPushEnv", easy)}


def dmc_config(name: str, actions: int) -> EnvConfig:
    """500 agent steps of two environment steps, as published."""
    return EnvConfig(name, action_dim=actions, frame_skip=2, max_steps=500, warmup_steps=0)


def dmc_ids() -> dict[str, tuple[str, EnvConfig]]:
    """Entry point and config of the ids of the DeepMind Control Suite (the extra `dmc`)."""
    actions = {"dmc_ball_in_cup_catch": 2, "dmc_cartpole_balance": 1}
    return {_OURS[name][0]: (_OURS[name][1], dmc_config(name, count)) for name, count in actions.items()}


_PLAIN: Final[dict[str, Any]] = {"order_enforce": False, "disable_env_checker": True}


def _settings() -> dict[str, tuple[str, EnvConfig]]:
    return {**block_ids(), **dmc_ids()}


def register() -> None:
    """Register the Gymnasium ids; calling it again does nothing."""
    from gymnasium.envs.registration import register as gym_register
    from gymnasium.envs.registration import registry

    wanted: dict[str, tuple[str, dict[str, Any]]] = {name: (entry, {}) for name, entry in _OURS.values()}
    wanted.update({_OURS[name][0]: (_OURS[name][1], {"env": family_config(name)}) for name in FAMILIES})
    wanted[SET_ID] = "playslot_rl.envs.task_set:TaskSet", {"env": family_config(METAWORLD, "MT10")}
    wanted.update({name: (entry, {"env": config}) for name, (entry, config) in _settings().items()})
    for name, (entry, kwargs) in wanted.items():
        if name not in registry:
            gym_register(id=name, entry_point=entry, kwargs=kwargs, **_PLAIN)


def gym_id(name: str) -> str:
    """Gymnasium id of a configured environment name; a ConfigError where there is no such simulator."""
    if name in (*PROCEDURAL, *RECORDED):
        known = ", ".join(sorted(ENVIRONMENTS))
        raise ConfigError(f"env={name}: got an environment without a simulator, expected one of {known}")
    if name not in ENVIRONMENTS:
        hint = nearest(name, ENVIRONMENTS, "env=") or "; choose one of these"
        raise ConfigError(f"unknown environment: got {name!r}, expected one of {', '.join(sorted(ENVIRONMENTS))}{hint}")
    found, entry = ENVIRONMENTS[name]
    if name not in _OURS:
        from gymnasium.envs.registration import register as gym_register
        from gymnasium.envs.registration import registry

        if found not in registry:
            gym_register(id=found, entry_point=entry, **_PLAIN)
    return found


def task_config(env: EnvConfig | str | None = None) -> EnvConfig:
    """A task's config, given itself or by its name, with the settings that `env=NAME` has (also as
    `metaworld/TASK`, `ogbench/TASK`); None means ButtonPress. A ConfigError for an unknown name, or something else."""
    if isinstance(env, str) and env.partition("/")[0] in FAMILIES:
        return family_config(env.partition("/")[0], env.partition("/")[2])
    if isinstance(env, str):
        default = "", GYM if env == GYM.name else EnvConfig(env)
        name = gym_id(env)
        return TASKS[env].env if env in TASKS else _settings().get(name, default)[1]
    given: Any = EnvConfig() if env is None else env
    if not isinstance(given, EnvConfig):
        known = ", ".join(sorted(ENVIRONMENTS))
        raise ConfigError(f"env: got {type(given).__name__}, expected an EnvConfig or a name, one of {known}")
    return given


def make_env(env: EnvConfig | str | None = None, render: RenderConfig | None = None) -> gym.Env[Any, Any]:
    """Make a task (`playslot_rl.envs.pixel_task.PixelTask`) as a Gymnasium environment without wrappers, so that
    `expert_action()` can be called on it; a RenderError where there is no working GL backend.
    """
    made = _without_renderer(task_config(env), render)
    task_env(made).open_renderer()
    return made


def _without_renderer(env: EnvConfig, render: RenderConfig | None = None) -> gym.Env[Any, Any]:
    name = SET_ID if env.tasks else gym_id(env.name)
    from playslot_rl.envs.rendering import import_mujoco

    import_mujoco()
    _check_variation(env)
    import gymnasium

    return gymnasium.make(name, env=env, render=render or RenderConfig(), render_mode="rgb_array")


def state_width(env: EnvConfig) -> int:
    """Width S of a task's proprioception, which only the task itself knows: it is made, and drawn nothing of."""
    made = _without_renderer(env)
    try:
        return int(task_env(made).observation_space[keys.STATE].shape[0])  # type: ignore[index]
    finally:
        made.close()


def task_env(env: gym.Env[Any, Any]) -> PixelTask:
    """The task under any Gymnasium wrappers."""
    return cast("PixelTask", env.unwrapped)


def _creator(name: str) -> Any:
    """What makes the environments of a configured name."""
    found = gym_id(name)
    import gymnasium
    from gymnasium.envs.registration import load_env_creator

    entry_point = gymnasium.spec(found).entry_point
    return load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point


def without_expert(env: EnvConfig) -> ConfigError:
    """What is raised where a task that has no expert is asked for its action."""
    return ConfigError(
        f"env={env.name}: got a task without an expert, expected one that shows how it is solved: record with "
        "policy=random, or learn from its reward (method=dreamer)"
    )


def check_task(env: EnvConfig, expert: bool = False, success: bool = False) -> None:
    """Refuse, by a ConfigError, a task that there is not, another width than its actions', a camera or a variation that
    it has not, one that does not say what data sets say of it, and one without an expert, or a measure of success,
    where one is asked for.
    """
    creator = _creator(env.name)
    from playslot_rl.envs.pixel_task import ACTION_DIM, check_actions

    width = getattr(creator, "actions_of", None)
    check_actions(env, ACTION_DIM if width is None else width(env))
    missing = [name for name in ("control_hz", "task") if name not in task_metadata(env)]
    if missing:
        expected = "control_hz (environment steps a second) and task (a sentence) in that of its class"
        raise ConfigError(f"env={env.name}: got metadata without {' and '.join(missing)}, expected {expected}")
    _check_variation(env)
    if expert and not getattr(creator, "has_expert", True):
        raise without_expert(env)
    if env.camera not in ("", NEAR) and not (env.name == GYM.name and expert):  # else it is made below
        _without_renderer(env).close()
    if env.name == GYM.name:
        from playslot_rl.envs import gym_task

        gym_task.warn_of_success(env.id, env.success)
        if expert:
            gym_task.check_expert(env)
        if success:
            gym_task.require_success(env)


def _in_mujoco(env: EnvConfig) -> bool:
    known = getattr(_creator(env.name), "in_mujoco", None)
    return known is None or known(env)


def _check_variation(env: EnvConfig) -> None:
    got, task = f"env.variation: got {', '.join(env.variation.words)}", " ".join(env.typed)
    if env.variation.on and not _in_mujoco(env):
        raise ConfigError(f"{got}, expected none: {task} draws itself")
    if env.name == GYM.name and (env.variation.textures or env.variation.colours):
        raise ConfigError(f"{got}, expected neither textures nor colours: {task} names no parts; leave them off")


def has_parts(env: EnvConfig) -> bool:
    """Whether a task knows which object each pixel shows: MuJoCo does, or `segment` of a class that draws itself."""
    if env.name in PROCEDURAL or _in_mujoco(env):
        return True
    from playslot_rl.envs.pixel_task import PixelTask

    return env.name != GYM.name and _creator(env.name).segment is not PixelTask.segment


def task_metadata(env: EnvConfig) -> dict[str, Any]:
    """Gymnasium's metadata of a task, without making it: `control_hz`, `task` (a sentence), `action` (its numbers)."""
    creator = _creator(env.name)
    describe = getattr(creator, "metadata_of", None)  # a family of tasks says what is to be done in each
    metadata: dict[str, Any] = getattr(creator, "metadata", {}) if describe is None else describe(env)
    return metadata


def make_torchrl_env(env: EnvConfig | str | None = None, render: RenderConfig | None = None) -> EnvBase:
    """Make a task (`make_env`) for TorchRL: batch size (), reads `keys.ACTION` float32 (A,) and writes `keys.PIXELS`
    uint8 (3, H, W), `keys.STATE` float32 (S,), `keys.SUCCESS` bool (1,), reward, done, terminated and truncated.
    `set_seed(s)` makes `s` the seed of the next episode; later resets draw theirs from the environment's generator.
    """
    task = make_env(env, render)  # before torchrl, which imports mujoco too
    from playslot_rl.envs.torchrl import TensorView, wrap

    return wrap(TensorView(task))


register()  # `gymnasium.make("playslot_rl.envs:ID")` imports this package and expects its ids to be there
