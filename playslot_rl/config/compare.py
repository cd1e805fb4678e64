"""Config of `playslot compare` (the group `compare` of the experiment's config)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from playslot_rl.config.methods import METHODS, require_method
from playslot_rl.config.plain import check
from playslot_rl.config.roles import SEED, UNSAID, Checked, at_least, between, role
from playslot_rl.seeds.episodes import TEST_BLOCKS

LAUNCHERS: dict[str, str] = {
    "basic": "hydra",
    "joblib": "hydra_plugins.hydra_joblib_launcher",
    "submitit_local": "hydra_plugins.hydra_submitit_launcher",
    "submitit_slurm": "hydra_plugins.hydra_submitit_launcher",
    "ray": "hydra_plugins.hydra_ray_launcher",
}
"""Hydra's launchers by name, and the module each of them needs."""


def check_lists(config: Any, prefix: str, filled: Sequence[str], *more: str) -> None:
    """Refuse a list of a comparison that names something twice, one of `filled` that is empty, and no launcher."""
    for name in (*filled, *more):
        values = getattr(config, name)
        check(len(values) > 0 or name in more, f"{prefix}{name}", values, "at least one")
        check(len(set(values)) == len(values), f"{prefix}{name}", values, "each one once")
    check(config.launcher in ("", *LAUNCHERS), "hydra.launcher", config.launcher, f"one of {', '.join(LAUNCHERS)}")
    check(not config.hydra or bool(config.launcher), "hydra", config.hydra, "hydra.launcher=NAME with it")


@dataclass(frozen=True)
class CompareConfig(Checked):
    """What is compared. On the command line of `playslot compare` the keys are `envs=`, `methods=`, `demos=`,
    `labels=`, `videos=`, `worlds=`, `seeds=`, `processes=` and `hydra.launcher=`, without the group's name.

    Attributes:
        envs: tasks, instead of `env`: `block_push_easy`, `metaworld/drawer-open`, `gym/FetchReach-v4`, each compared
            in a folder of its own.
        methods: names of `playslot_rl.config.methods`.
        demos: numbers of demonstrations, for the methods that learn from them.
        labels: numbers of labelled demonstrations. Those with latent actions learn from the videos of all `demos`
            and the real actions of so many of them, oracles from the actions of all, the other rows that clone (BC,
            ACT, Diffusion Policy) from the labelled ones alone. Empty: those of `behaviour.labelled_demos`.
        videos: numbers of unlabelled videos that policies clone beside `labels`, instead of `demos`.
        worlds: world models, and models such as LAPO's, each with all seeds: `run`, `runs`, the rest trained.
        runs: run folders of further world models, separated by commas.
        seeds: training seeds; each has its own draw of demonstrations.
        online_seeds: training seeds of the methods that act, which take the longest; empty means `seeds`.
        evaluation_seed: block of evaluation episodes, the same for all; from 2^31 on a test's.
        block: `test` takes one that nobody has seen, drawn once for the folder.
        reference: method whose differences to the others are shown.
        tasks: finished comparisons of other tasks, separated by commas, for the table over all.
        processes: that each training runs on, by torchrun; methods that act learn in one, and evaluation is in one.
        launcher: Hydra launcher that runs the jobs; empty runs them one after the other.
        hydra: further overrides for Hydra, such as `hydra.launcher.n_jobs=2`.
    """

    group = "compare."
    envs: tuple[str, ...] = field(default=(), metadata=UNSAID)
    methods: tuple[str, ...] = ("playslot", "lapo", "slot_oracle", "resnet_oracle", "dreamer", "sold")
    demos: tuple[int, ...] = field(default=(10, 50, 100, 150), metadata=at_least(1, "numbers of at least 1"))
    labels: tuple[int, ...] = field(default=(), metadata=at_least(1, "numbers of at least 1"))
    videos: tuple[int, ...] = field(default=(), metadata=UNSAID | at_least(0, "numbers of 0 or more"))
    worlds: int = field(default=1, metadata=UNSAID | between(1, 100, "1 to 100"))
    runs: str = field(default="", metadata=UNSAID | role("folder"))
    seeds: tuple[int, ...] = field(default=(0, 1, 2), metadata=SEED)
    online_seeds: tuple[int, ...] = field(default=(), metadata=SEED)
    evaluation_seed: int = field(default=100, metadata=SEED)
    block: Literal["development", "test"] = field(default="development", metadata=UNSAID)
    reference: str = field(default="playslot", metadata=UNSAID)
    tasks: str = field(default="", metadata=UNSAID | role("folder"))
    processes: int = field(default=1, metadata=role("machine") | between(1, 1024, "at least 1, 1024 at most"))
    launcher: str = ""
    hydra: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_lists(self, "", ("methods", "demos", "seeds"), "envs", "labels", "videos")
        for name in self.methods:
            require_method("methods", name)
        still = [name for name in self.methods if not METHODS[name].acts]
        check(not still, "methods", ",".join(still), "methods that act; `playslot compare-video` compares predictions")
        most = max(self.labels, default=0)
        if self.videos:
            check(bool(self.labels), "videos", self.videos, "numbers of labelled demonstrations, labels=, with them")
            check(self.demos == CompareConfig.demos, "demos", self.demos, "none with videos=, which says how many")
        else:
            check(most <= min(self.demos), "labels", most, f"at most the {min(self.demos)} demonstrations of demos=")
        self._check_rest()

    def _check_rest(self) -> None:
        further = [part for part in self.runs.split(",") if part.strip()]
        check(len(further) < self.worlds, "compare.runs", self.runs, f"fewer than the {self.worlds} of worlds=")
        frozen = self.evaluation_seed >= TEST_BLOCKS
        seed = self.evaluation_seed
        check(not frozen or self.block == "test", "compare.evaluation_seed", seed, "compare.block=test with a test's")
        drawn = frozen or self.block == "development" or seed == CompareConfig.evaluation_seed
        check(drawn, "compare.evaluation_seed", seed, f"none, or {TEST_BLOCKS} and above, with compare.block=test")
        known = ", ".join(self.methods)
        check(
            self.reference in (type(self).reference, *self.methods),
            "compare.reference",
            self.reference,
            f"one of {known}",
        )
        alone = [name for name in self.methods if METHODS[name].labelled_only]
        check(bool(self.labels) or not alone, "labels", self.labels, f"some numbers with methods={','.join(alone)}")
        online = self.online_seeds
        check(set(online) <= set(self.seeds), "compare.online_seeds", online, f"some of seeds={self.seeds}")
        check(len(set(online)) == len(online), "compare.online_seeds", online, "each one once")

    @property
    def numbers(self) -> tuple[int, ...]:
        """All numbers of demonstrations, rising: `demos`, or the labelled ones and the unlabelled `videos`."""
        if not self.videos:
            return tuple(sorted(self.demos))
        return tuple(sorted({labels + videos for labels in self.labels for videos in self.videos}))
