"""Every key of the config is read by the library, outside the classes that declare it.

The sources are parsed, and attributes are followed by the types that are written down: of parameters, class bodies,
results, and of what is assigned from them. So `config.precision` counts for a key only where `config` is the key's own
group, not wherever some object has a `precision`. What a stage inherits is read for it by the loops that run any stage.
"""

from __future__ import annotations

import ast
import dataclasses
import typing
from collections.abc import Iterator
from pathlib import Path

import pytest

import playslot_rl
from playslot_rl import config as config_package
from playslot_rl.cli import COMMANDS
from playslot_rl.config import ExperimentConfig
from playslot_rl.config.plain import type_hints

ROOT = Path(playslot_rl.__file__).parents[1]
FOLDERS = ("playslot_rl", "recipes", "collectors", "envs")
LOOPS = (
    "playslot_rl/training/",
    "playslot_rl/losses/dynamics.py",
    "playslot_rl/modules/predictors/",
    "playslot_rl/methods/cloning.py",
    "playslot_rl/methods/lapo/",
    "playslot_rl/methods/frozen_encoder/",
    "playslot_rl/methods/lerobot_policy/",
    "playslot_rl/methods/online/",
    "playslot_rl/methods/video/",
)
"""Where a config known only by its base class is any stage's; elsewhere it is a stage of exactly that class."""

CHECKED: dict[str, str] = {
    f"baselines.{method}.world": "read by playslot_rl.methods.training of whatever method builds on a model"
    for method in ("autoencoder_bc", "inverse_bc", "lapo", "lapo_slots", "laom", "clam", "caddy_policy", "caddy_oracle")
}
"""Keys that say something although no computation reads them."""


hints_of = type_hints


def config_classes(cls: type) -> dict[str, type]:
    """The config classes under one, by name."""
    found = {cls.__name__: cls}
    hints = hints_of(cls)
    for field in dataclasses.fields(cls):
        if dataclasses.is_dataclass(hints[field.name]):
            found |= config_classes(typing.cast(type, hints[field.name]))
    for base in cls.__mro__[1:-1]:
        found[base.__name__] = base
    return found


def leaves(cls: type, prefix: str = "") -> Iterator[tuple[str, type, str]]:
    """Dotted key, class and name of every leaf."""
    hints = hints_of(cls)
    for field in dataclasses.fields(cls):
        if dataclasses.is_dataclass(hints[field.name]):
            yield from leaves(typing.cast(type, hints[field.name]), f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", cls, field.name


class Reads:
    """Which attributes of which config classes some sources read.

    Args:
        sources: path and text of each module.
    """

    def __init__(self, sources: dict[str, str]) -> None:
        self.configs = config_classes(ExperimentConfig)
        self.found: set[tuple[str, str]] = set()
        self.shared: set[tuple[str, str]] = set()  # of them, those in LOOPS
        self.in_loops = False
        self.classes: dict[str, dict[str, str]] = {}  # attribute -> type, of classes that are no configs
        self.results: dict[str, str] = {}  # function -> type
        trees = {path: ast.parse(source) for path, source in sources.items()}
        for _ in range(2):  # what one module assigns, another reads
            for path, tree in trees.items():
                self.in_loops = path.startswith(LOOPS)
                self.block(tree.body, {}, "")

    def named(self, node: ast.expr | None) -> str:
        """The class that an annotation names, `X`, `X | None`, `module.X` or quoted; empty for others."""
        match node:
            case ast.Constant(value=str() as text):
                return self.named(ast.parse(text, mode="eval").body)
            case ast.BinOp(left=left, right=right):
                return self.named(left) or self.named(right)
            case ast.Name(id=name) | ast.Attribute(attr=name):
                return name if name in self.configs or name in self.classes else ""
        return ""

    def attribute(self, owner: str, name: str) -> str:
        """Type of an attribute; reading it of a config counts."""
        if owner not in self.configs:
            return self.classes.get(owner, {}).get(name, "")
        self.found.add((owner, name))
        if self.in_loops:
            self.shared.add((owner, name))
        hint = hints_of(self.configs[owner]).get(name)
        return getattr(hint, "__name__", "") if dataclasses.is_dataclass(hint) else ""

    def type_of(self, node: ast.expr | None, names: dict[str, str]) -> str:
        match node:
            case ast.Name(id=name):
                return names.get(name, "")
            case ast.Attribute(value=value, attr=name):
                return self.attribute(self.type_of(value, names), name)
            case ast.Call(func=ast.Name(id="replace"), args=[first, *_]):
                return self.type_of(first, names)
            case ast.Call(func=ast.Name(id="getattr"), args=[owner, ast.Constant(value=str() as name), *_]):
                return self.attribute(self.type_of(owner, names), name)
            case ast.Call(func=ast.Name(id=name)):
                return name if name in self.configs or name in self.classes else self.results.get(name, "")
            case ast.Call(func=ast.Attribute(value=value, attr=name)):
                return self.attribute(self.type_of(value, names), f"{name}()") or self.results.get(name, "")
            case ast.BoolOp(values=values):
                return next((kind for value in values if (kind := self.type_of(value, names))), "")
            case ast.IfExp(body=body, orelse=other):
                return self.type_of(body, names) or self.type_of(other, names)
        return ""

    def assign(self, target: ast.expr, value: ast.expr | None, kind: str, names: dict[str, str], owner: str) -> None:
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) and len(target.elts) == len(value.elts):
            for one, its in zip(target.elts, value.elts, strict=True):
                self.assign(one, its, "", names, owner)
            return
        kind = kind or self.type_of(value, names)
        if isinstance(target, ast.Name) and kind:
            names[target.id] = kind
        elif isinstance(target, ast.Attribute) and kind and self.type_of(target.value, names) == owner:
            self.classes.setdefault(owner, {})[target.attr] = kind

    def block(self, statements: list[ast.stmt], names: dict[str, str], owner: str) -> None:
        for statement in statements:
            self.statement(statement, names, owner)

    def statement(self, node: ast.stmt, names: dict[str, str], owner: str) -> None:
        match node:
            case ast.ClassDef(name=name, body=body, bases=bases):
                inherited = {k: v for base in bases for k, v in self.classes.get(self.named(base), {}).items()}
                known = self.classes.setdefault(name, {})
                known |= {k: v for k, v in inherited.items() if k not in known}
                for line in body:
                    if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
                        known[line.target.id] = self.named(line.annotation) or known.get(line.target.id, "")
                self.block(body, dict(names), name)
            case ast.FunctionDef(name=name, args=args, body=body, returns=returns, decorator_list=decorators):
                result, marks = self.named(returns), {d.id for d in decorators if isinstance(d, ast.Name)}
                static = "staticmethod" in marks
                if owner and "property" in marks:
                    self.classes[owner][name] = result
                elif result:
                    self.results[name] = result
                inner = dict(names)
                for number, argument in enumerate([*args.posonlyargs, *args.args, *args.kwonlyargs]):
                    own = owner and number == 0 and not static
                    inner[argument.arg] = owner if own else self.named(argument.annotation)
                self.block(body, inner, owner)
            case _:
                self.simple(node, names, owner)

    def simple(self, node: ast.stmt, names: dict[str, str], owner: str) -> None:
        for part in ast.iter_child_nodes(node):
            for inner in () if isinstance(part, (ast.stmt, ast.ExceptHandler)) else ast.walk(part):
                read = isinstance(inner, ast.Attribute) and isinstance(inner.ctx, ast.Load)
                if isinstance(inner, ast.expr) and (read or isinstance(inner, ast.Call)):
                    self.type_of(inner, names)
                elif isinstance(inner, ast.NamedExpr):
                    self.assign(inner.target, inner.value, "", names, owner)
        match node:
            case ast.Assign(targets=targets, value=value):
                for target in targets:
                    self.assign(target, value, "", names, owner)
            case ast.AnnAssign(target=target, value=value, annotation=annotation):
                self.assign(target, value, self.named(annotation), names, owner)
        for block in ("body", "orelse", "finalbody"):
            self.block(getattr(node, block, []), names, owner)
        for handler in getattr(node, "handlers", []):
            self.block(handler.body, names, owner)

    def unread(self) -> list[str]:
        """Keys of which nothing is read, neither of their group nor, by the loops, of a base class of it."""
        return [
            key
            for key, cls, name in leaves(ExperimentConfig)
            if (cls.__name__, name) not in self.found
            and not any((base.__name__, name) in self.shared for base in cls.__mro__[1:-1])
        ]


def library() -> dict[str, str]:
    declared = Path(config_package.__file__).parent
    paths = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    return {path.relative_to(ROOT).as_posix(): path.read_text() for path in paths if declared not in path.parents}


@pytest.mark.integration
def test_every_key_is_read() -> None:
    assert sorted(Reads(library()).unread()) == sorted(CHECKED)


def test_a_key_counts_for_its_own_group_only() -> None:
    source = """
class Stage:
    def __init__(self, config: ExperimentConfig, part: LAPOConfig) -> None:
        self.config, lapo = config.dynamics, part

    def loss(self) -> float:
        return self.config.precision + self.config.optim.lr
"""
    unread = Reads({"playslot_rl/new.py": source}).unread()
    assert "dynamics.precision" not in unread
    assert {"slots.precision", "behaviour.precision", "dynamics.steps", "model.savi.encoder"} <= set(unread)
    assert not any(key.endswith(".optim.lr") for key in unread)  # an optimiser's keys are read by one function


def test_what_stages_inherit_counts_for_all_of_them_in_the_loops_only() -> None:
    source = "def f(config: StageConfig | None = None) -> int:\n    return config.steps\n"
    steps = {f"{stage}.steps" for stage in ("slots", "dynamics", "behaviour", "baselines.lapo.policy")}
    assert steps.isdisjoint(Reads({"playslot_rl/training/fit.py": source}).unread())
    assert steps & set(Reads({"elsewhere.py": source}).unread()) == steps - {"baselines.lapo.policy.steps"}


# --- the help of a command lists what its recipe reads ------------------------------------------------------------

STORED = {
    "evaluate": {"out", "data.stride"},
    "export": {"method", "env.name"},
    "plan": {"method"},
    "compare": {"out"},
}
"""Keys that a recipe reads of what a run has stored, or only to refuse them."""


MOVED = {f"train-{stage}": f"playslot_rl/methods/playslot/{stage}.py" for stage in ("slots", "dynamics", "policy")}
"""Where what a recipe does is a method's."""


def listed(command: str) -> tuple[str, ...]:
    return COMMANDS[command].reads.split()


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "doctor"])
def test_what_a_recipe_reads_is_listed(command: str) -> None:
    path = MOVED.get(command, f"recipes/{command.replace('-', '_')}.py")
    found = Reads({path: (ROOT / path).read_text()}).found
    keys = {
        key: any(f"{key}.".startswith(f"{of}.") for of in listed(command))
        for key, cls, name in leaves(ExperimentConfig)
        if (cls.__name__, name) in found
    }
    assert keys
    unlisted = {key for key, there in keys.items() if not there}
    assert unlisted <= STORED.get(command, set())


def test_a_command_lists_nothing_that_is_no_key() -> None:
    keys = [key for key, _, _ in leaves(ExperimentConfig)] + ["env", "preset"]
    for command in COMMANDS:
        assert all(any(f"{key}.".startswith(f"{of}.") for key in keys) for of in listed(command)), command
