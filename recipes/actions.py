"""Commands with actions and options of their own, `playslot dataset ACTION ...`: the arguments, and what is printed."""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import re
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from playslot_rl.storage.folders import require_outside

Argument = tuple[str, dict[str, Any]]
"""Name and settings of `ArgumentParser.add_argument`."""


def argument(name: str, metavar: str, says: str, **settings: Any) -> Argument:
    return name, {"metavar": metavar, "help": says, **settings}


def flag(name: str, says: str) -> Argument:
    return name, {"action": "store_true", "help": says}


@dataclass(frozen=True)
class Action:
    """One action: what `--help` says about it, in a line and in a paragraph, its arguments, and what it does.

    Attributes:
        does: `module:function`, imported when it is run; takes the arguments by name.
        either: arguments of which at most one may be given.
        writes: the argument that names what it writes.
    """

    summary: str
    details: str
    examples: tuple[str, ...]
    does: str
    arguments: tuple[Argument, ...]
    either: tuple[Argument, ...] = ()
    writes: str = "out"


def make_parser(
    command: str, kind: type[argparse.ArgumentParser] = argparse.ArgumentParser
) -> tuple[dict[str, Action], argparse.ArgumentParser]:
    """The actions and the parser of `playslot COMMAND`, a module beside this one; `kind` says how bad arguments end."""
    module = importlib.import_module(f"playslot_rl.recipes.{command}")
    actions: dict[str, Action] = module.ACTIONS
    width = max(map(len, actions))
    lines = "\n".join(f"  {name:<{width}}  {action.summary}" for name, action in actions.items())
    prog = f"playslot {command}"
    top = kind(
        prog=prog,
        usage=f"{prog} {module.USAGE}",
        description=module.DESCRIPTION,
        epilog=f"actions:\n{lines}\n\n`{prog} ACTION --help` explains one of them.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parsers = top.add_subparsers(prog=prog, dest="action", metavar="ACTION", required=True, parser_class=kind)
    for name, action in actions.items():
        examples = "\n".join(f"  {example}" for example in action.examples)
        sub = parsers.add_parser(
            name,
            description=f"{action.summary}\n\n{textwrap.fill(action.details, 100)}",
            epilog=f"examples:\n{examples}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        for key, settings in action.arguments:
            sub.add_argument(key, **settings)
        if action.either:
            group = sub.add_mutually_exclusive_group()
            for key, settings in action.either:
                group.add_argument(key, **settings)
    return actions, top


def run_action(actions: Mapping[str, Action], options: argparse.Namespace) -> int:
    """Do what the parsed arguments ask for; the exit code is 0, or 1 for a data set that is not sound. An OutputError
    where it would write into the data set that it reads, or into another.
    """
    values = dict(vars(options))
    action, as_json = actions[values.pop("action")], values.pop("json", False)
    if values.get(action.writes) is not None:
        read = [values[name] for name in ("root", "roots") if name in values and name != action.writes]
        flat = [root for one in read for root in (one if isinstance(one, list) else [one])]
        written, key = Path(values[action.writes]), "--out " if action.writes == "out" else ""
        require_outside(written, flat, key, "file" if written.suffix == ".html" else "folder")
    try:
        result = pkgutil.resolve_name(action.does)(**values)
        lines = result if isinstance(result, list) else result.lines()
        print(result.to_json() if as_json else "\n".join(lines))
        return 0 if getattr(result, "ok", True) else 1
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(
            str(error) or "interrupted; no data set was changed, run the same command again"
        ) from error


def whole(smallest: int, largest: int) -> Callable[[str], int]:
    """The type of an option that takes whole numbers from `smallest` to `largest`."""

    def parse(text: str) -> int:
        value = int(text) if re.fullmatch(r"[+-]?[0-9]{1,100}", text.strip()) else None
        if value is None or not smallest <= value <= largest:
            said = text if len(text) <= 40 else f"{text[:40]}..."
            raise argparse.ArgumentTypeError(f"got {said!r}, expected a whole number from {smallest} to {largest}")
        return value

    return parse


JSON: Final = flag("--json", "print one JSON object instead of text")
