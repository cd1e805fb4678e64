"""Tasks that other packages bring (entry points `playslot_rl.envs`); ours are the YAML files of `recipes/conf/env`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from playslot_rl.config import plugins
from playslot_rl.config.env import EnvConfig

GROUP: Final = "playslot_rl.envs"
"""Entry points by which a package brings a task: its name, and a `Task`."""


@dataclass(frozen=True)
class Task:
    """A simulated task.

    Attributes:
        name: as it is typed, `env=NAME`.
        entry_point: `module:class` of its environment, as `playslot_rl.envs.pixel_task.PixelTask` says.
        env: its settings; their `name` is that name.
        model: nested values of the group `model` that it asks for, such as `{"savi": {"n_slots": 3}}`.
    """

    name: str
    entry_point: str
    env: EnvConfig
    model: Mapping[str, Any] = field(default_factory=dict)

    @property
    def gym_id(self) -> str:
        """Gymnasium id under which it is registered."""
        return f"{self.name}-v0"


TASKS: Final = plugins.Registry(GROUP, Task)
