"""The commands that make a policy again, from its run's config: never a folder of this machine."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from typing import Any, Final

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.sharing.source import Result
from playslot_rl.storage.resume import flatten

RUN: Final = "runs/again"
WORLD: Final = "runs/world"
GROUPS: Final = ("env", "render", "collect", "model", "slots", "dynamics", "behaviour", "evaluation")
"""Parts of a config that a result depends on; intervals of logging and the like do no harm in between."""
BEHAVIOUR: Final = ("env", "render", "collect", "model.policy", "model.action_decoder", "behaviour", "evaluation")
"""Those a policy on the shipped world model depends on."""


def reproduce(config: ExperimentConfig, source: Mapping[str, Any], results: Sequence[Result]) -> list[str]:
    """Command lines from nothing to the evaluated policy.

    Args:
        config: of the run.
        source: see `playslot_rl.sharing.source.read_source`.
        results: what was measured of it.
    """
    seed = source.get("seed")
    base = [f"env={config.env.name}", f"preset={config.preset}"]
    seeded = [] if seed is None else [f"seed={seed}"]
    evaluate = [
        _line("evaluate", f"run={RUN}", f"protocol={r.protocol}", f"episodes={r.episodes}", f"seed={r.seed}")
        for r in results
    ]
    changed, recorded, demos = changes(config, BEHAVIOUR), source.get("recorded") or {}, source.get("demos")
    episodes = recorded.get("episodes") or demos
    first = [f"demos={demos}"] if demos is not None and demos != episodes else []
    if not source.get("shipped_world_model"):
        world = source.get("world_model_seed", seed)
        if world in (None, seed) and not first:
            return [_line("pipeline", *base, *seeded, *changes(config, GROUPS), f"out={RUN}"), *evaluate]
        again = [] if world is None else [f"seed={world}"]
        collected = f"data.demos={WORLD}/data/expert"
        return [
            _line("pipeline", *base, *again, *changes(config, GROUPS), f"out={WORLD}"),
            _line("train-policy", f"run={WORLD}", *base, *seeded, *first, *changed, collected, f"out={RUN}"),
            *evaluate,
        ]
    count = [] if episodes is None else [f"episodes={episodes}"]
    start = [f"seed={recorded['seed']}"] if recorded else seeded
    where = "data/demonstrations"
    recording = _of(changed, "env", "render", "collect")
    return [
        _line("collect", *base, "policy=expert", *count, *start, *recording, f"out={where}"),
        _line("train-policy", "run=pretrained", *base, *seeded, *first, *changed, f"data.demos={where}", f"out={RUN}"),
        *evaluate,
    ]


def changes(config: ExperimentConfig, groups: tuple[str, ...]) -> list[str]:
    """`key=value` of what differs from the run's preset, in some groups of keys.

    Raises:
        ConfigError: the preset or the environment is not one of this version.
    """
    from playslot_rl.config.compose import compose
    from playslot_rl.config.roles import keys_of

    free = keys_of(ExperimentConfig, "free")
    preset = flatten(to_dict(compose([f"env={config.env.name}", f"preset={config.preset}"])))
    return [
        f"{key}={_value(value)}"
        for key, value in flatten(to_dict(config)).items()
        if any(key.startswith(f"{group}.") for group in groups)
        and key not in free
        and (key not in preset or preset[key] != value)
    ]


def _of(assignments: list[str], *groups: str) -> list[str]:
    return [text for text in assignments if text.startswith(tuple(f"{group}." for group in groups))]


def _value(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


def _line(command: str, *arguments: str) -> str:
    return shlex.join(["playslot", command, *arguments])
