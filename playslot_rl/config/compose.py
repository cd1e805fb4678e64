"""From `key=value` overrides to an `ExperimentConfig`: Hydra's grammar reads them, the dataclasses judge the result.

`env` and `preset` choose a file of the folder of that name in `playslot_rl/recipes/conf`; every other key sets one
value. A command that continues a run (`CONTINUES`) and is given `run=DIR` starts from `DIR/config.json` instead.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import yaml

from playslot_rl.config import CompareConfig, ExperimentConfig, from_dict, metaworld, plugins, to_dict
from playslot_rl.config.arguments import require_digits, require_folders, require_once, require_plain
from playslot_rl.config.baselines import known_methods
from playslot_rl.config.env import VIDEO
from playslot_rl.config.families import GYM, preset_values
from playslot_rl.config.machine import require_machine
from playslot_rl.config.method_keys import read_alone, require_read
from playslot_rl.config.methods import canonical_method
from playslot_rl.config.plain import flatten, merged, multiplied, nearest, put, type_hints
from playslot_rl.config.planning import GOALS, PLANNERS, PROPOSALS
from playslot_rl.config.roles import declared, keys_of
from playslot_rl.config.spelling import quoted, typed_value
from playslot_rl.config.tasks import GROUP as TASKS_GROUP
from playslot_rl.config.tasks import TASKS
from playslot_rl.errors import ConfigError, first_line

PLAIN_ENV: Final = "button_press"
"""The task that nothing typed means, and that one that another package brings starts from: it asks nothing of the
model."""
PRESET: Final = "compact"
"""The preset that nothing typed means."""
FITTED: Final = "playslot_rl.envs.gym_task:fitted"
METHOD_KEYS: Final = ("method", "compare.methods", "compare.reference")
CONF_MODULE: Final = "playslot_rl.recipes.conf"
GROUPS: Final = ("env", "preset")
CONTINUES: Final = frozenset({"evaluate", "export", "inspect", "plan", "play", "train-dynamics", "train-policy"})
"""Commands that take the config of the run they continue."""
VIEWS: Final = frozenset({"train-baseline", "compare"})
"""Commands that with `env=video` read a set as the run that they build on, unless something else is typed."""
VIEWED: Final = (
    "preset", "env.image_size", "env.task", "data.camera", "data.stride", "data.stride_action", "data.resize",
    "data.held_out",
)  # fmt: skip
COMPARISONS: Final = {
    "compare": ("envs", "methods", "demos", "labels", "videos", "worlds", "seeds", "processes"),
    "compare-video": ("methods", "seeds", "vary", "values", "objects", "processes"),
}
"""Commands with a group of their own in the config, and its keys that go without its name."""
SHORT: Final = {"expert": "env.expert"}
"""Keys that go without the name of their group in every command."""
NAMES: Final = {"plan": {"planner": PLANNERS, "proposal": PROPOSALS, "goals": GOALS}}
"""Commands with keys of their group that go without its name, and take one name, several with commas, or `all`."""
PRETRAINED: Final = "pretrained"
"""`run=pretrained` names the task's pretrained world model, `run=pretrained/ENV` one of them: no run folders."""


EXPORTED: Final = "playslot"
"""`type` in the `config.json` of an exported policy, by which LeRobot finds its class."""


def is_pretrained(run: str) -> bool:
    """Whether `run` names a pretrained model instead of a folder."""
    return run.partition("/")[0] == PRETRAINED


def near_run(run: str) -> str:
    """The pretrained model or the run beside it that a name may be meant for, as the end of a message."""
    models = [PRETRAINED, *(f"{PRETRAINED}/{env}" for env in choices("env"))]
    place = Path(run)
    with contextlib.suppress(OSError):
        models += [str(found.parent) for found in place.parent.glob("*/config.json")]
    return nearest(run, models, "run=")


def choices(group: str) -> list[str]:
    """Names of the YAML files of a group (`env` or `preset`), sorted; then the tasks that other packages bring."""
    names = [entry.name for entry in resources.files(f"{CONF_MODULE}.{group}").iterdir()]
    files = sorted(name.removesuffix(".yaml") for name in names if name.endswith(".yaml"))
    return files + (sorted(plugins.brought(TASKS_GROUP)) if group == "env" else [])


def compose(overrides: Sequence[str] = (), command: str = "") -> ExperimentConfig:
    """Build the validated config of one command, which decides whether `run=DIR` brings its stored config; a
    ConfigError for arguments, keys, values or sizes that do not fit, and for a run folder without a usable
    `config.json`.
    """
    for argument in overrides:
        require_plain(argument.partition("=")[0].strip().lstrip("+"), argument)
    pairs = _parse(_short_keys(overrides, command))
    for group in GROUPS:
        if group in pairs:
            _check_choice(group, pairs[group])
    try:
        run = _expand_home(_unquote(pairs.get("run", "")))
        if command == "adopt":
            pairs.setdefault("env", VIDEO)
        continues = command in CONTINUES and run != "" and not is_pretrained(run)
        if is_pretrained(run) and run != PRETRAINED:
            pairs.setdefault("env", run.partition("/")[2])  # the task that the model is named after
            _check_choice("env", pairs["env"])
        if run and not is_pretrained(run) and command in VIEWS and pairs.get("env") == VIDEO:
            pairs = {**_views(Path(run)), **pairs}
        if continues:
            config, typed = _from_run(Path(run), pairs, command == "play"), _typed(pairs)
        else:
            values, typed = _presets(pairs.get("env", PLAIN_ENV), pairs.get("preset", PRESET)), _typed(pairs)
            config = from_dict(ExperimentConfig, _with_task(values, typed))
            if config.env.id and not {"env.action_dim", "env.max_steps"} <= pairs.keys():  # only the environment knows
                config = from_dict(ExperimentConfig, _with_task(values, typed, plugins.call(FITTED, config.env)))
        require_machine(config, {key: value for key, value in pairs.items() if key not in GROUPS})
        require_read(config, flatten(typed), command)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(str(error)) from error
    _check_choice("env", config.env.name)
    return config


def compose_each(overrides: Sequence[str], command: str = "") -> list[ExperimentConfig]:
    """The config of a command, or with `envs=metaworld/drawer-open,block_push_easy` one for each task; a ConfigError as
    of `compose`, and for keys that are of one task.
    """
    pairs = dict(argument.partition("=")[::2] for argument in _short_keys(overrides, command))
    names = pairs.get("compare.envs", "").strip().removeprefix("[").removesuffix("]")
    if command == "collect" and "env.max_steps" in pairs:  # of evaluation, which there is none of
        lengths = {f"collect.{policy}_steps": pairs["env.max_steps"] for policy in ("random", "expert")}
        overrides = [*overrides, *(f"{key}={steps}" for key, steps in lengths.items() if key not in pairs)]
    if command != "compare" or not names.strip():
        return [compose(overrides, command)]
    for key in ("env", "env.task", "env.id", "data.root", "data.demos"):
        if key in pairs:
            raise ConfigError(f"{key}: got {pairs[key]} with envs=, expected none: it is of one task")
    tasks = [_unquote(task.strip()).partition("/") for task in names.split(",")]
    gym, found = any(env == GYM for env, _, _ in tasks), []
    for env, slash, own in tasks:
        chosen = [f"{'env.id' if env == GYM else 'env.task'}={own}"] if slash else []
        others = ("expert", "env.expert", "env.success") if gym and env != GYM else ()  # of Gymnasium's alone
        own_keys = [one for one in overrides if one.partition("=")[0].strip().lstrip("+") not in others]
        found.append(compose([*own_keys, f"env={env}", *chosen], command))
    return found


def _parse(overrides: Sequence[str]) -> dict[str, str]:
    pairs: dict[str, str] = {}
    typed: list[str] = []
    for argument in overrides:
        key, equals, value = argument.partition("=")
        key = key.strip().lstrip("+")
        if not equals or not key or key.startswith("~"):
            raise ConfigError(f"got the argument {argument!r}, expected key=value, such as preset=compact")
        hint = hint_of(key)
        if hint is None:
            raise ConfigError(_unknown_key(key))
        if key in METHOD_KEYS:
            value = _method_names(key, value)
        if key == "port" and not value.strip():
            value = "0"  # `port=`: any
        require_digits(key, value, hint)
        if key in keys_of(ExperimentConfig, "folder"):
            require_folders(key, _unquote(value))
        typed.append(key)
        pairs[key] = _unquote(value) if key in GROUPS else value
    require_once(typed)
    return pairs


def _method_names(key: str, value: str) -> str:
    """A method, or some in brackets, by the names that the config knows."""
    text = _unquote(value.strip())
    words = text.removeprefix("[").removesuffix("]").split(",")
    try:
        names = ",".join(canonical_method(_unquote(word.strip()), key != "method") for word in words if word.strip())
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from None
    return f"[{names}]" if text.startswith("[") else names


def _short_keys(overrides: Sequence[str], command: str) -> list[str]:
    """The short keys of a command by their full names in the config: `expert=` as `env.expert`, `demos=10,50` as
    `compare.demos=[10,50]`, `planner=all` as `plan.planner=[cem,...]`, `hydra.launcher=joblib` as
    `compare.launcher=joblib`; other `hydra.` keys of a comparison are gathered, as they are, in `compare.hydra`.
    """
    kept, hydra = [], []
    group, lists, named = command.replace("-", "_"), COMPARISONS.get(command, ()), NAMES.get(command, {})
    for argument in overrides:
        key, equals, value = argument.partition("=")
        name = key.strip().lstrip("+")
        if equals and name in SHORT:
            argument = f"{SHORT[name]}={value}"
        own, inside = name.removeprefix(f"{group}."), _unquote(value.strip()).removeprefix("[").removesuffix("]")
        if equals and own in named:
            kept.append(f"{group}.{own}=[{','.join(named[own]) if inside == 'all' else inside}]")
        elif equals and name in lists:
            if name == "values":  # of whatever kind the setting is: text until then
                inside = ",".join(quoted(_unquote(part.strip())) for part in inside.split(",") if part.strip())
            kept.append(f"{group}.{name}={inside if name in ('vary', 'worlds', 'processes') else f'[{inside}]'}")
        elif equals and lists and name == "hydra.launcher":
            kept.append(f"{group}.launcher={value}")
        elif equals and lists and name.startswith("hydra."):
            hydra.append(argument.strip())
        else:
            kept.append(argument)
    require_once([argument.partition("=")[0].strip().lstrip("+") for argument in hydra])
    inside = ",".join(quoted(argument) for argument in hydra)
    return [*kept, f"{group}.hydra=[{inside}]"] if hydra else kept


def hint_of(key: str) -> Any:
    """Type of a dotted key of the config, or None where there is no such key."""
    hint: Any = ExperimentConfig
    for part in key.split("."):
        if not dataclasses.is_dataclass(hint):
            return None
        hint = type_hints(hint).get(part)
    return hint


def _unknown_key(key: str) -> str:
    """The message for an unknown key: the keys of its deepest known group, and the nearest key of all, or those of
    that name in some group."""
    group = key.rpartition(".")[0]
    while group and not dataclasses.is_dataclass(hint_of(group)):
        group = group.rpartition(".")[0]
    level = hint_of(group) if group else ExperimentConfig
    names = [f"{group}.{f.name}" if group else f.name for f in dataclasses.fields(level)]
    known = [*flatten(to_dict(ExperimentConfig())), *declared(ExperimentConfig, "unsaid")]
    alike = [name for name in known if name.endswith(f".{key}")]
    hint = f"; did you mean {' or '.join(alike)}?" if 0 < len(alike) <= 3 else nearest(key, [*names, *known])
    return f"unknown key {key}: expected one of {', '.join(sorted(names))}{hint}"


def _check_choice(group: str, name: str) -> None:
    known = choices(group)
    if name not in known:
        hint = nearest(name, known, f"{group}=")
        raise ConfigError(f"unknown {group} {name!r}: expected one of {', '.join(known)}{hint}")


def _unquote(value: str) -> str:
    if len(value) >= 2 and value[0] == value[-1] and value[0] in "'\"":
        return value[1:-1]
    return value


def _expand_home(folders: str) -> str:
    """Replace a leading `~`, which shells leave alone after `key=`, in each of some comma-separated folders."""
    return ",".join(os.path.expanduser(folder) for folder in folders.split(","))  # noqa: PTH111  Path drops a final /


def _assignments(pairs: Mapping[str, str]) -> list[str]:
    """Hydra overrides that set (`++`) values; text is quoted, since commas, equals signs and brackets in a path mean
    something to Hydra.
    """
    assignments, folders = [], keys_of(ExperimentConfig, "folder")
    for key, value in pairs.items():
        if key in GROUPS:
            continue
        if hint_of(key) is str and value != "null":
            text = _expand_home(_unquote(value)) if key in folders else _unquote(value)
            value = quoted(text)
        assignments.append(f"++{key}={value}")
    return assignments


@functools.cache
def _said(group: str, name: str) -> dict[str, Any]:
    """What a YAML file says, beside what another of its folder (`as`) does; nothing where there is none. Not to be
    changed.
    """
    path = resources.files(f"{CONF_MODULE}.{group}") / f"{name}.yaml"
    if not path.is_file():
        return {}
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times as fast, where libyaml is there
    own: dict[str, Any] = yaml.load(path.read_text(encoding="utf-8"), loader)
    return merged(_said(group, own.pop("as")), own) if "as" in own else own


@functools.cache
def _presets(env: str, preset: str) -> dict[str, Any]:
    """What the YAML files of a task and a preset say, the later one over the earlier one; not to be changed.

    A preset with `of` and `times` is that preset, for this task, with numbers multiplied, and others set (`sets`).
    """
    task = TASKS[env] if env in plugins.brought(TASKS_GROUP) else None
    name = env if task is None else PLAIN_ENV
    values: dict[str, Any] = {"env": _said("env", name)}
    for group, file in (("preset", preset), ("env_model", name), ("env_preset", f"{name}_{preset}")):
        values = merged(values, _said(group, file))
    if "times" in values:
        grown = multiplied(merged(to_dict(ExperimentConfig()), _presets(env, values["of"])), values["times"])
        return merged(grown, values.get("sets", {})) | {"preset": values["preset"]}
    return values if task is None else merged(values, {"env": to_dict(task.env), "model": dict(task.model)})


def _with_task(
    values: dict[str, Any], typed: Mapping[str, Any], fitted: Mapping[str, Any] = MappingProxyType({})
) -> dict[str, Any]:
    """What a preset says, changed by what the environment itself says and how long its task lasts, and then by what was
    typed."""
    env = merged(merged(values["env"], fitted), typed.get("env", {}))
    own = preset_values(env, values["preset"], values["dynamics"]["predicted_frames"], plugins.brought(TASKS_GROUP))
    width = {"env": {"action_dim": fitted["action_dim"]}} if fitted else {}
    if typed.get("compare", {}).get("videos"):  # instead of the numbers of the preset
        own = {**own, "compare": {**own.get("compare", {}), "demos": CompareConfig.demos}}
    return merged(merged(merged(values, width), own), typed)


def _typed(pairs: Mapping[str, str]) -> dict[str, Any]:
    """What was typed, read by Hydra's grammar, as a plain nested dict. Nothing is interpolated."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    typed: dict[str, Any] = {}
    with _explained():
        for override in OverridesParser.create().parse_overrides(_assignments(pairs)):
            if override.is_sweep_override():
                raise ConfigError(
                    f"cannot read the arguments: got several values for {override.key_or_group}, expected one "
                    "(a list goes in brackets)"
                )
            change: dict[str, Any] = {}
            put(change, override.key_or_group, override.value())
            typed = merged(typed, change)
    return typed


@contextlib.contextmanager
def _explained() -> Iterator[None]:
    """Hydra's and OmegaConf's errors in one line."""
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(f"cannot read the arguments: {first_line(error)}; expected key=value pairs") from error


def _from_run(run: Path, pairs: Mapping[str, str], play: bool) -> ExperimentConfig:
    """The stored config of a run, or, to play, that of an exported policy, changed by what the user typed; `out` is the
    run where it is not given."""
    stored = stored_config(run, play)
    for group in GROUPS:
        if group in pairs:
            have = stored.preset if group == "preset" else stored.env.name
            if pairs[group] != have:
                raise ConfigError(
                    f"got {group}={pairs[group]} with run={run}, which was made with {group}={have}: "
                    f"leave {group} out, or start a new run with out="
                )
    values = to_dict(stored)
    defaults = to_dict(ExperimentConfig())
    values.update({key: defaults[key] for key in keys_of(ExperimentConfig, "call")})
    typed = _typed(pairs)
    if stored.env.name == metaworld.NAME:  # one of its tasks may have nothing small to see from near
        task = str(typed.get("env", {}).get("task", stored.env.task))
        values["env"]["camera"] = metaworld.seen_by(task, stored.env.camera)
    config = from_dict(ExperimentConfig, merged(values, typed))
    return config if config.out else dataclasses.replace(config, out=str(run))


def _views(run: Path) -> dict[str, str]:
    """How a run of recorded videos read them, as it would be typed; nothing of another task."""
    stored = stored_config(run)
    known = flatten(to_dict(stored)) if stored.env.name == VIDEO else {}
    return {key: typed_value(known[key]) for key in VIEWED if key in known}


def stored_config(run: Path, exported: bool = False) -> ExperimentConfig:
    """`RUN/config.json`; a ConfigError where it is missing or not one of this version. With `exported` that of an
    exported policy is taken, too, as far as it says one.
    """
    path = run / "config.json"
    if not path.is_file():
        cure = f"{near_run(str(run))}; make one with `playslot pipeline out={run}`"
        if (run / "meta" / "info.json").is_file():
            raise ConfigError(f"run={run}: got a data set, expected the folder of a run: data sets are data.root=")
        raise ConfigError(f"run={run}: got no {path}, expected the folder of a run{cure}")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise ValueError(f"got a {type(values).__name__}, expected a group of keys")
        if values.get("type") != EXPORTED:
            return from_dict(ExperimentConfig, known_methods(values))
        if exported:
            data = {key: values[key] for key in ("resize", "stride") if key in values}
            data |= {"camera": next(iter(values.get("input_features", {})), "")}
            said = {"env": values.get("env", {}), "model": values.get("model", {}), "data": data}
            return from_dict(ExperimentConfig, said)
    except ValueError as error:
        raise ConfigError(f"{path} cannot be used: {error}; restore it or start a new run") from error
    raise ConfigError(
        f"run={run}: got an exported policy, expected the run that it was exported from: `playslot play` and "
        "playslot_rl.load take such a folder"
    )


def spelled(config: ExperimentConfig, command: str) -> list[str]:
    """The way back from `compose`: arguments with which `playslot COMMAND`, no comparison, gets this config in all that
    it reads; a ConfigError where none do: `run` is of another preset or task, and the command takes its config.
    """
    continues = command in CONTINUES and config.run != "" and not is_pretrained(config.run)
    base = [] if continues else [*config.env.typed, f"preset={config.preset}"]
    base += [f"{key}={value}" for key, value in (("run", config.run), ("out", config.out)) if value]
    known, wanted = flatten(to_dict(compose(base, command))), read_alone(config, command)
    changed = [f"{key}={typed_value(value)}" for key, value in wanted.items() if known.get(key) != value]
    arguments = [*base, *(word for word in changed if not word.startswith(("preset=", "env.name=")))]
    if read_alone(compose(arguments, command), command) != wanted:
        raise ConfigError(
            f"run={config.run}: got a run of another preset or task than {config.preset}, {config.env.name}, expected "
            f"the same with processes above 1 ({command} goes on from its config): use processes=1"
        )
    return arguments
