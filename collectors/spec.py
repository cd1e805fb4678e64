"""What a collection is: everything its content depends on, and nothing else (not the number of workers)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from playslot_rl.config import EnvConfig, ExperimentConfig, RenderConfig, from_dict
from playslot_rl.config.plain import nearest
from playslot_rl.envs import PROCEDURAL, gym_id
from playslot_rl.errors import ConfigError
from playslot_rl.seeds.episodes import EPISODES, LARGEST_SEED, episode_seed

FORMAT = 1
OFFSETS = {"random": 0, "expert": EPISODES // 2}
"""First episode of a seed: its first half is for random episodes, its second half for the expert's."""


@dataclass(frozen=True)
class CollectionSpec:
    """A collection; `noise` is the deviation of that on the expert's actions, and `env.max_steps` equals `steps`."""

    policy: str
    episodes: int
    steps: int
    seed: int
    noise: float = 0.0
    storage: Literal["image", "video"] = "image"
    env: EnvConfig = field(default_factory=EnvConfig)
    render: RenderConfig = field(default_factory=RenderConfig)
    format: int = FORMAT

    @classmethod
    def make(cls, config: ExperimentConfig, policy: str, episodes: int, steps: int, seed: int) -> CollectionSpec:
        """Check the request and name it.

        Raises:
            ConfigError: unknown policy or environment, an expert where there is none, actions of another width than the
                environment's, too few or too many episodes or steps, or a seed beyond 32 bits.
        """
        if policy not in OFFSETS:
            hint = nearest(policy, OFFSETS, "policy=") or "; choose one of these"
            raise ConfigError(f"unknown policy: got {policy!r}, expected one of {', '.join(sorted(OFFSETS))}{hint}")
        if config.env.name not in PROCEDURAL:
            from playslot_rl.envs import pixel_task

            gym_id(config.env.name)
            pixel_task.check_actions(config.env)
        elif policy != "random":
            raise ConfigError(
                f"policy: got {policy} for env={config.env.name}, expected random: its shapes move by themselves; "
                "leave policy out"
            )
        else:
            from playslot_rl.envs import grid_shapes

            grid_shapes.check_actions(config.env)
        if not 1 <= episodes <= EPISODES // 2:
            raise ConfigError(f"episodes: got {episodes}, expected 1 to {EPISODES // 2}; split larger sets over seeds")
        if steps < 2:
            raise ConfigError(f"steps: got {steps}, expected at least 2; set collect.{policy}_steps")
        if not 0 <= seed <= LARGEST_SEED + 1:  # `pipeline` collects some episodes with the seed after the typed one
            raise ConfigError(f"seed: got {seed}, expected 0 to {LARGEST_SEED}; choose a smaller one")
        noise = config.collect.noise if policy == "expert" else 0.0
        env = replace(config.env, max_steps=steps)
        return cls(policy, episodes, steps, seed, noise, config.collect.storage, env, config.render)

    def episode_seed(self, index: int) -> int:
        return episode_seed("collection", self.seed, OFFSETS[self.policy] + index)

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dict; groups of the environment that have their default values (those of other tasks) left out.

        So a data set made before a task with settings of its own was added is still the same collection.
        """
        values, default = asdict(self), asdict(EnvConfig())
        values["env"] = {k: v for k, v in values["env"].items() if not isinstance(v, dict) or v != default[k]}
        return values

    def difference(self, stored: object) -> str:
        """First setting in which a stored record differs, as `name: got X, expected Y`; empty if none does.

        The record may lack settings that did not exist when it was written.
        """
        found: dict[str, Any] = {}
        if isinstance(stored, dict):
            try:
                found = from_dict(CollectionSpec, stored).to_dict()
            except (TypeError, ValueError):
                found = stored  # the difference names what is foreign in it
        return difference(found, self.to_dict())


def difference(got: dict[str, Any], expected: dict[str, Any]) -> str:
    """First setting in which two records differ, as `name: got X, expected Y`; empty if none does."""
    for name in sorted(set(got) | set(expected)):
        a, b = got.get(name), expected.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            inner = difference(a, b)
            if inner:
                return f"{name}.{inner}"
        elif a != b:
            return f"{name}: got {a!r}, expected {b!r}"
    return ""
