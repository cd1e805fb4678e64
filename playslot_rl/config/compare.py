"""Config of `playslot compare` (the group `compare` of the experiment's config)."""

from __future__ import annotations

from dataclasses import dataclass, field

from playslot_rl.config.methods import METHODS, require_method
from playslot_rl.config.plain import check
from playslot_rl.config.roles import SEED, Checked, at_least, between, role

LAUNCHERS: dict[str, str] = {
    "basic": "hydra",
    "joblib": "hydra_plugins.hydra_joblib_launcher",
    "submitit_local": "hydra_plugins.hydra_submitit_launcher",
    "submitit_slurm": "hydra_plugins.hydra_submitit_launcher",
    "ray": "hydra_plugins.hydra_ray_launcher",
}
"""Hydra's launchers by name, and the module each of them needs."""


@dataclass(frozen=True)
class CompareConfig(Checked):
    """What is compared. On the command line of `playslot compare` the keys are `methods=`, `demos=`, `labels=`,
    `seeds=`, `processes=` and `hydra.launcher=`, without the group's name.

    Attributes:
        methods: names of `playslot_rl.config.methods`.
        demos: numbers of demonstrations, for the methods that learn from them.
        labels: numbers of labelled demonstrations. Those with latent actions learn from the videos of all `demos`
            and the real actions of so many of them, `slot_bc`, `resnet_bc`, `act` and `diffusion` from these alone, the
            oracles from the actions of all. Empty: they see those of `behaviour.labelled_demos`.
        seeds: training seeds; each has its own draw of demonstrations.
        online_seeds: training seeds of the methods that act, which take the longest; empty means `seeds`.
        evaluation_seed: seed of the evaluation's episodes, the same for every method and training seed.
        processes: that each training runs on, by torchrun; methods that act learn in one, and evaluation is in one.
        launcher: Hydra launcher that runs the jobs; empty runs them one after the other.
        hydra: further overrides for Hydra, such as `hydra.launcher.n_jobs=2`.
    """

    group = "compare."
    methods: tuple[str, ...] = ("playslot", "lapo", "slot_oracle", "resnet_oracle", "dreamer", "sold")
    demos: tuple[int, ...] = field(default=(10, 50, 100, 150), metadata=at_least(1, "numbers of at least 1"))
    labels: tuple[int, ...] = field(default=(), metadata=at_least(1, "numbers of at least 1"))
    seeds: tuple[int, ...] = field(default=(0, 1, 2), metadata=SEED)
    online_seeds: tuple[int, ...] = field(default=(), metadata=SEED)
    evaluation_seed: int = field(default=100, metadata=SEED)
    processes: int = field(default=1, metadata=role("machine") | between(1, 1024, "at least 1, 1024 at most"))
    launcher: str = ""
    hydra: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("methods", "demos", "seeds"):
            values = getattr(self, name)
            check(len(values) > 0, name, values, "at least one")
            check(len(set(values)) == len(values), name, values, "each one once")
        for name in self.methods:
            require_method("methods", name)
        still = [name for name in self.methods if not METHODS[name].acts]
        check(not still, "methods", ",".join(still), "methods that act; `playslot compare-video` compares predictions")
        check(len(set(self.labels)) == len(self.labels), "labels", self.labels, "each one once")
        most = max(self.labels, default=0)
        check(most <= min(self.demos), "labels", most, f"at most the {min(self.demos)} demonstrations of demos=")
        alone = [name for name in self.methods if METHODS[name].labelled_only]
        check(bool(self.labels) or not alone, "labels", self.labels, f"some numbers with methods={','.join(alone)}")
        online = self.online_seeds
        check(set(online) <= set(self.seeds), "compare.online_seeds", online, f"some of seeds={self.seeds}")
        check(len(set(online)) == len(online), "compare.online_seeds", online, "each one once")
        known = ", ".join(LAUNCHERS)
        check(self.launcher in ("", *LAUNCHERS), "hydra.launcher", self.launcher, f"one of {known}")
        check(not self.hydra or bool(self.launcher), "hydra", self.hydra, "hydra.launcher=NAME with it")
