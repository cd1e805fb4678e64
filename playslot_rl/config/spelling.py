"""An `ExperimentConfig` as the `key=value` arguments that make it: the way back from `compose`."""

from __future__ import annotations

from typing import Any

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.compose import CONTINUES, compose, is_pretrained, quoted
from playslot_rl.config.plain import flatten
from playslot_rl.errors import ConfigError


def spelled(config: ExperimentConfig, command: str) -> list[str]:
    """Arguments with which `playslot COMMAND`, no comparison, gets exactly this config; a ConfigError where none do:
    `run` is of another preset or task, and the command takes its config.
    """
    continues = command in CONTINUES and config.run != "" and not is_pretrained(config.run)
    base = [] if continues else [f"env={config.env.name}", f"preset={config.preset}"]
    base += [f"{key}={value}" for key, value in (("run", config.run), ("out", config.out)) if value]
    known, wanted = flatten(to_dict(compose(base, command))), flatten(to_dict(config))
    changed = [f"{key}={_text(value)}" for key, value in wanted.items() if known.get(key) != value]
    arguments = [*base, *(word for word in changed if not word.startswith(("preset=", "env.name=")))]
    if compose(arguments, command) != config:
        raise ConfigError(
            f"run={config.run}: got a run of another preset or task than {config.preset}, {config.env.name}, expected "
            f"the same with processes above 1 ({command} goes on from its config): use processes=1"
        )
    return arguments


def _text(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return "[" + ",".join(quoted(part) if isinstance(part, str) else _text(part) for part in value) + "]"
    return str(value)
