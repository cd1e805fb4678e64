"""Which keys the methods that a command trains read: what is typed for others alone changes nothing, and is refused.

A stage declares its keys once (`StageSpec.reads`), a method its own group (`Method.config`). They are judged in the
groups that methods share, and in what says which demonstrations they learn from.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

from playslot_rl.config.compare_video import method_of
from playslot_rl.config.experiment import ExperimentConfig
from playslot_rl.config.methods import METHODS, Method, stage_named
from playslot_rl.config.plain import flatten, to_dict
from playslot_rl.config.roles import declared, keys_of
from playslot_rl.config.spelling import typed_value
from playslot_rl.config.stage_spec import BASELINES, StageSpec
from playslot_rl.errors import ConfigError

GROUPS: Final = ("model", "slots", "dynamics", "behaviour", BASELINES.rstrip("."))
DRAW: Final = "data.draw"
DEMOS: Final = ("demos", DRAW, "compare.demos")
"""What says which demonstrations there are to learn from."""
LABELLED: Final = "behaviour.labelled_demos"
LABELS: Final = "compare.labels"
WORLD: Final = ("slots", "dynamics")
MOST: Final = 3
"""Keys that a message names instead of one, at most."""


@dataclass(frozen=True)
class Chosen:
    """The methods of a command.

    Attributes:
        command: of `playslot`.
        config: its config.
        methods: as they are trained.
        stages: their own.
        world: those of their world models; who has trained one before may type again what it was trained with.
    """

    command: str
    config: ExperimentConfig
    methods: tuple[Method, ...]
    stages: tuple[StageSpec, ...]
    world: tuple[StageSpec, ...] = ()

    def reads(self, key: str) -> bool:
        """Whether one of the methods reads a key, by its dotted name; true of keys that are not the methods' affair."""
        if key in DEMOS:
            learn = any(stage.data in ("demos", "labelled") for stage in self.stages)
            return learn and (key, self.command) != (DRAW, "compare")
        if key == LABELS:
            return any(method.some_labelled or method.labelled_only for method in self.methods)
        if key == LABELLED and self.command == "compare" and self.config.compare.labels:
            return False
        if key.partition(".")[0] not in GROUPS or _within(key, self._own):
            return True
        beside = f"{key.rpartition('.')[0]}.steps"  # whoever trains for so many steps looks as often as is said there
        named = beside if key in keys_of(ExperimentConfig, "free") else key
        own = [self._read_by(stage) for stage in self.stages] + [stage.reads for stage in self.world]
        return any(_within(one, names) for one in (key, named) for names in own)

    def instead(self, key: str) -> str:
        """What to type, as the end of a message."""
        if key == LABELLED and self.reads("demos"):
            labels = self.command == "compare" and self.reads(LABELS)
            return f"expected {'labels' if labels else 'demos'}=, how many demonstrations with actions are learned from"
        if key == DRAW and self.command == "compare":
            return "expected seeds=, each of which draws its own demonstrations"
        of_world = any(_within(key, stage_named(name).reads) for name in WORLD)
        if self.command == "compare" and of_world and any(method.slots for method in self.methods):
            return "expected none with run=, whose world model is there: train one with it, or leave run= out"
        own = key.removeprefix(BASELINES).split(".")
        for first in range(1, len(own)):
            alike = [one for one in self._keys if one.endswith("." + ".".join(own[first:]))]
            if 0 < len(alike) <= MOST:
                return f"expected {' or '.join(f'{one}=' for one in alike)}"
        return "expected none: leave it out"

    @property
    def said(self) -> str:
        """The methods as they are typed, and that they do not read a key."""
        if self.command == "train-baseline":
            return f"method={self.config.method}, which does not read it"
        names = self.config.compare.methods if self.command == "compare" else self.config.compare_video.methods
        return f"methods={','.join(names)}, which {'do' if len(names) > 1 else 'does'} not read it"

    def _read_by(self, stage: StageSpec) -> tuple[str, ...]:
        """What a method's stage reads; of a world model that is named, what it must share says the world model."""
        named = self.command == "compare" and not self.world
        return (*stage.keys, *stage.settings, *stage.also) if named else stage.reads

    @cached_property
    def _own(self) -> tuple[str, ...]:
        return tuple(f"{BASELINES}{method.name}" for method in self.methods if method.config is not None)

    @cached_property
    def _keys(self) -> tuple[str, ...]:
        """The keys of the methods' groups that they read themselves."""
        own, known = replace(self, world=()), flatten(to_dict(self.config))
        return tuple(key for key in known if key.partition(".")[0] in GROUPS and own.reads(key))


def _within(key: str, names: Iterable[str]) -> bool:
    """Whether a key is one of some keys, or in one of some groups."""
    return any(f"{key}.".startswith(f"{name}.") for name in names)


def chosen(config: ExperimentConfig, command: str) -> Chosen | None:
    """The methods that a command trains; None for commands that have no choice."""
    if command == "train-baseline":
        method = METHODS[config.method]
        world = tuple(name for name in WORLD if name in method.last.parents)
        return Chosen(command, config, (method,), _stages(method), tuple(map(stage_named, world)))
    if command == "compare":
        methods, own = tuple(METHODS[name] for name in config.compare.methods), config.compare
        named = [part for part in (config.run, *own.runs.split(",")) if part.strip()]
        world = () if len(named) >= own.worlds else WORLD  # nothing of it is trained here
        stages = tuple(stage for method in methods for stage in _stages(method))
    elif command == "compare-video":
        methods, world = tuple(map(method_of, config.compare_video.methods)), WORLD[:1]
        stages = tuple(stage_named("dynamics") if method.imagines else method.last for method in methods)
    else:
        return None
    parents = tuple(map(stage_named, world)) if any(method.slots for method in methods) else ()
    return Chosen(command, config, methods, stages, parents)


def _stages(method: Method) -> tuple[StageSpec, ...]:
    """Those that a method trains beside a world model."""
    return (method.last,) if method.model is None else (method.model, method.last)


def require_read(config: ExperimentConfig, typed: Mapping[str, Any], command: str) -> None:
    """Refuse what was typed, by dotted names, that another key sets, or that no method of the command reads, by a
    ConfigError.
    """
    methods, setters = chosen(config, command), declared(ExperimentConfig, "set_by")
    for key, value in typed.items():
        if key in setters:
            raise ConfigError(f"{key}: got {typed_value(value)}, expected none: {setters[key]}= sets it")
        if methods is not None and not methods.reads(key):
            name, text = key.removeprefix("compare."), typed_value(value)
            got = text.strip("[]") if name in ("demos", "labels") else text
            raise ConfigError(f"{name}: got {got} with {methods.said}, {methods.instead(key)}")


def read_alone(config: ExperimentConfig, command: str) -> dict[str, Any]:
    """A config as plain values by dotted names, without those that no method of the command reads."""
    methods, values = chosen(config, command), flatten(to_dict(config))
    return {key: value for key, value in values.items() if methods is None or methods.reads(key)}
