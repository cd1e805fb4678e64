"""What a model card says in commands: how its policy is used, and how it is made again.

They come from the config of its run, and name no folder of this machine.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.compose import compose, is_pretrained
from playslot_rl.config.plain import flatten
from playslot_rl.config.roles import keys_of
from playslot_rl.config.weights import data_roots
from playslot_rl.data.videos import place
from playslot_rl.data.videos import places as set_places
from playslot_rl.envs import ENVIRONMENTS, RECORDED, task_config
from playslot_rl.sharing.folder import SharedPolicyConfig

RUN: Final = "runs/again"
WORLD: Final = "runs/world"
VIDEOS: Final = "data/videos"
DEMOS: Final = "data/demonstrations"
START: Final = "runs/start"
GROUPS: Final = ("env", "render", "collect", "data", "model", "slots", "dynamics", "behaviour", "evaluation")
"""Parts of a config that a result depends on; intervals of logging and the like do no harm in between."""
BEHAVIOUR: Final = (
    "env",
    "render",
    "collect",
    "data",
    "model.policy",
    "model.action_decoder",
    "behaviour",
    "evaluation",
)
"""Those a policy on the shipped world model depends on."""


@dataclass(frozen=True)
class Result:
    """A measured success rate, the mean agent steps to the first success of the episodes that had one, and rate and
    interval of other policies in simulation, on the same seeds, by name.
    """

    protocol: str
    episodes: int
    seed: int
    success_rate: float
    ci95: tuple[float, float]
    mean_steps: float | None
    references: dict[str, tuple[float, tuple[float, float]]]


def reproduce(
    config: ExperimentConfig,
    source: Mapping[str, Any],
    results: Sequence[Result],
    world: ExperimentConfig | None = None,
) -> list[str]:
    """Command lines from nothing (from the data sets, where these were recorded elsewhere) to the evaluated policy;
    `world` is the config of its world model's run, where that is another one.
    """
    evaluate = [
        _line("evaluate", f"run={RUN}", f"protocol={r.protocol}", f"episodes={r.episodes}", f"seed={r.seed}")
        for r in results
    ]
    made = _from_recordings if recorded_elsewhere(config, source) else _from_nothing
    return [*made(config, source, world), *evaluate]


def recorded_elsewhere(config: ExperimentConfig, source: Mapping[str, Any]) -> bool:
    return config.env.name in RECORDED or bool(source.get("recorded_elsewhere"))


def _from_nothing(config: ExperimentConfig, source: Mapping[str, Any], other: ExperimentConfig | None) -> list[str]:
    seed = source.get("seed")
    base, seeded = _base(config), _seeded(seed)
    changed, recorded, demos = changes(config, BEHAVIOUR), source.get("recorded") or {}, source.get("demos")
    episodes = recorded.get("episodes") or demos
    first = [f"demos={demos}"] if demos is not None and demos != episodes else []
    if not source.get("shipped_world_model"):
        world = source.get("world_model_seed", seed)
        # Those that are held out the pipeline itself keeps apart.
        whole = demos is None or episodes in (demos, demos + config.data.held_out)
        if other is None and world in (None, seed) and whole:
            return [_line("pipeline", *base, *seeded, *changes(config, GROUPS), f"out={RUN}")]
        collected, first_run = f"data.demos={WORLD}/data/expert", other or config
        return [
            _line("pipeline", *_base(first_run), *_seeded(world), *changes(first_run, GROUPS), f"out={WORLD}"),
            _line("train-policy", f"run={WORLD}", *base, *seeded, *first, *changed, collected, f"out={RUN}"),
        ]
    count = [] if episodes is None else [f"episodes={episodes}"]
    start = [f"seed={recorded['seed']}"] if recorded else seeded
    recording = [text for text in changed if text.startswith(("env.", "render.", "collect."))]
    recording = [text for text in recording if not text.startswith("env.max_steps=")]  # of `collect.expert_steps`
    return [
        _line("collect", *base, "policy=expert", *count, *start, *recording, f"out={DEMOS}"),
        _line("train-policy", "run=pretrained", *base, *seeded, *first, *changed, f"data.demos={DEMOS}", f"out={RUN}"),
    ]


def _from_recordings(config: ExperimentConfig, source: Mapping[str, Any], other: ExperimentConfig | None) -> list[str]:
    seed = source.get("seed")
    videos, shown, demos = _named(config, other)
    base, behaviour, taught = _base(config), _kept(config), f"data.demos={demos}"
    own = [*base, *_seeded(seed), *behaviour, *changes(config, BEHAVIOUR)]
    if source.get("shipped_world_model"):
        return [_line("train-policy", "run=pretrained", *own, taught, f"out={RUN}")]
    first, world = other or config, source.get("world_model_seed", seed)
    settings = [*changes(first, GROUPS), f"data.root={videos}"]
    alike = other is None and world in (None, seed)
    if alike and config.env.name not in RECORDED:
        return [_line("pipeline", *base, *_seeded(seed), *behaviour, *settings, taught, f"out={RUN}")]
    folder = RUN if alike else WORLD
    if other is None:  # the world model's run says the rest
        own = [*([] if alike else _seeded(seed)), *behaviour]
    among = [f"data.demos={shown}", *_kept(first)] if shown else []
    return [
        _line("train-slots", *_base(first), *_seeded(world), *settings, *among, f"out={folder}"),
        _line("train-dynamics", f"run={folder}"),
        _line("train-policy", f"run={folder}", *own, taught, f"out={RUN}"),
    ]


def _kept(config: ExperimentConfig) -> list[str]:
    """Which demonstrations are trained on."""
    held_out = [f"data.held_out={config.data.held_out}"] if config.data.held_out else []
    return [*([] if config.demos is None else [f"demos={config.demos}"]), *held_out]


def _base(config: ExperimentConfig) -> list[str]:
    return [*config.env.typed, f"preset={config.preset}"]


def _seeded(seed: int | None) -> list[str]:
    return [] if seed is None else [f"seed={seed}"]


def _named(config: ExperimentConfig, other: ExperimentConfig | None = None) -> tuple[str, str, str]:
    """`data.root` of the world model's run (`other`, where it is another one), its `data.demos` where it held some of
    its videos out as demonstrations, and `data.demos`; one name for each folder, however the runs wrote it.
    """
    first = other or config
    shown, demos = first.data.demos or first.data.root, config.data.demos or config.data.root
    if not {*set_places(shown)} & {*set_places(first.data.root)}:
        shown = ""
    folders = list(dict.fromkeys([*set_places(demos), *set_places(shown)]))
    names = {folder: DEMOS if len(folders) == 1 else f"{DEMOS}_{i}" for i, folder in enumerate(folders, 1)}
    videos = set_places(first.data.root)
    for number, folder in enumerate(videos, 1):
        names.setdefault(folder, VIDEOS if len(videos) == 1 else f"{VIDEOS}_{number}")
    root, seen, taught = (
        ",".join(one._replace(path=names[place(one.path)]).text for one in data_roots(text))
        for text in (first.data.root, shown, demos)
    )
    return root or VIDEOS, seen, taught or DEMOS


def changes(config: ExperimentConfig, groups: tuple[str, ...]) -> list[str]:
    """`key=value` of what differs from the run's preset, in some groups of keys; a ConfigError where the preset or the
    environment is not one of this version.
    """
    free, machine, folders = (keys_of(ExperimentConfig, role) for role in ("free", "machine", "folder"))
    width = [f"env.action_dim={config.env.action_dim}"] if config.env.id else []  # it is not asked for: it may be gone
    preset = flatten(to_dict(compose([*_base(config), *width])))
    found = []
    for key, value in flatten(to_dict(config)).items():
        group, _, name = key.rpartition(".")
        # A folder of one invocation, such as `behaviour.policy_from`, is where a finished part was taken from.
        unsaid = machine | folders if group == "data" else machine & folders
        if not any(key.startswith(f"{one}.") for one in groups) or key in unsaid:
            continue
        # Where patience ends a stage, when it looks decides where.
        stage: Any = getattr(config, group, None)
        looks = name == "validate_every" and bool(getattr(stage, "patience", 0))
        if (key in free and not looks) or (key in preset and preset[key] == value):
            continue
        if key in folders and value and not is_pretrained(str(value)):
            value = START  # no folder of this machine
        found.append(f"{key}={value if isinstance(value, str) else json.dumps(value, separators=(',', ':'))}")
    return found


def _line(command: str, *arguments: str) -> str:
    return shlex.join(["playslot", command, *arguments])


def places(config: ExperimentConfig, source: Mapping[str, Any], world: ExperimentConfig | None = None) -> str:
    """What the folders in the commands stand for, a paragraph; empty where the commands make them."""
    if not recorded_elsewhere(config, source):
        return ""
    videos, _, demos = _named(config, world)
    alone = config.env.name == "video" and len(data_roots(videos)) == 1  # it takes one set
    adopt = f"; `playslot adopt data.root={videos} out={RUN}` would choose sizes and steps anew" if alone else ""
    names = dict.fromkeys(root.path for root in data_roots(f"{videos},{demos}"))
    stand = "stands for the data set" if len(names) == 1 else "stand for the data sets"
    return (
        f"{' and '.join(f'`{name}`' for name in names)} {stand}, recorded elsewhere, whose "
        f"fingerprints are above{adopt}.\n\n"
    )


def rate_words(policy: SharedPolicyConfig) -> str:
    """How often the policy wants a frame."""
    rate, stride = policy.fps, policy.stride
    if stride == 1:
        return f"{rate:g} a second" if rate else "as many a second as in the demonstrations"
    of = f" of {rate * stride:g}" if rate else ""
    now = f"{rate:g} a second" if rate else f"1 / {stride} of the demonstrations' rate"
    return f"{now}: one frame in {stride}{of}, and each action is held until the next"


def _real(policy: SharedPolicyConfig, why: str) -> str:
    """How a robot runs it, and why LeRobot has no simulator for it."""
    told = f" `lerobot-rollout` needs `--fps={policy.fps:g}`: its own is 30." if policy.fps else ""
    told += f" Its `--task=` says which: `--task={shlex.quote(policy.told[0])}`." if policy.told else ""
    task = f', "task": {json.dumps(policy.told[0], ensure_ascii=False)}' if policy.told else ""
    return REAL.format(why=why, camera=policy.camera, rate=rate_words(policy), told=told, task=task)


def use(policy: SharedPolicyConfig, experiment: ExperimentConfig | None = None) -> str:
    """The paragraph on LeRobot's programs, as Markdown."""
    own, known = policy.env, experiment or ExperimentConfig()
    task_name = "/".join(filter(None, (own.name, own.task)))
    if own.name not in ENVIRONMENTS or own.id:  # LeRobot makes only tasks with a name
        return _real(policy, NOWHERE)
    task = task_config(task_name)
    alike = replace(own, image_size=task.image_size, frame_skip=task.frame_skip, max_steps=task.max_steps)
    if alike != task:
        return _real(policy, CHANGED)
    acting = own.every(policy.stride)
    options = {
        "image_size": (own.image_size, 64),
        "quality": (known.render.quality, "fast"),
        "frame_skip": (acting.frame_skip, task.frame_skip),
        "episode_length": (acting.max_steps, task.max_steps),
    }
    command = ["lerobot-eval", "--policy.path=THIS_FOLDER", "--env.type=playslot", f"--env.task={task_name}"]
    command += [f"--env.{name}={value}" for name, (value, default) in options.items() if value != default]
    if policy.camera != keys.FEATURE_IMAGE:
        command.append(f"--rename_map={json.dumps({keys.FEATURE_IMAGE: policy.camera})}")
    command += ["--eval.n_episodes=10", "--eval.batch_size=1", f"--seed={known.evaluation.seed_offset}"]
    return SIMULATED.format(command=shlex.join(command))


SIMULATED: Final = """\
In LeRobot, with `playslot_rl` and `lerobot_policy_playslot` installed; the seed is the first of ours that no
training has seen:

```bash
{command}
```"""
NOWHERE: Final = "No simulator of this task ships with `playslot_rl`: `lerobot-eval` has nothing to run it in."
CHANGED: Final = "`lerobot-eval` has no options for what was changed of this task; `playslot evaluate` runs it."
REAL: Final = """\
{why}
It is shown the frames of the robot, {rate}.{told} In LeRobot's own terms, with `playslot_rl` and
`lerobot_policy_playslot` installed:

```python
from lerobot.policies import make_pre_post_processors
from lerobot_policy_playslot.modeling_playslot import PlaySlotPolicy

policy = PlaySlotPolicy.from_pretrained("THIS_FOLDER")
before, after = make_pre_post_processors(policy.config, "THIS_FOLDER")
policy.reset()
action = after(policy.select_action(before({{"{camera}": picture{task}}})))  # picture (3, H, W), float in [0, 1]
```"""
