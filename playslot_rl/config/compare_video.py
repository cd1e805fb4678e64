"""Config of `playslot compare-video` (the group `compare_video` of the experiment's config)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from playslot_rl.config.compare import check_lists
from playslot_rl.config.methods import METHODS, Method
from playslot_rl.config.plain import check
from playslot_rl.config.roles import OPEN_FRACTION, SEED, YEAR_MINUTES, Checked, above_zero, at_least, between, role
from playslot_rl.seeds.episodes import EPISODES

VARIANTS: Final[Mapping[str, tuple[str, str]]] = {"playslot_m": ("playslot", "PlaySlot (InvDyn_M)")}
"""Rows that are a method with other settings, by name: the method, and a title. `playslot` itself has InvDyn_S."""


def video_methods() -> tuple[str, ...]:
    """What can be compared: methods that predict frames, and variants of them."""
    return (*(name for name, method in METHODS.items() if method.load.video), *VARIANTS)


def method_of(name: str) -> Method:
    """The method that a row is of."""
    return METHODS[VARIANTS[name][0] if name in VARIANTS else name]


def title_of(name: str) -> str:
    """As tables name a row."""
    return VARIANTS[name][1] if name in VARIANTS else METHODS[name].title


@dataclass(frozen=True)
class CompareVideoConfig(Checked):
    """What is compared. On the command line the keys are `methods=`, `seeds=`, `vary=`, `values=`, `objects=`,
    `processes=` and `hydra.launcher=`, without the group's name.

    Attributes:
        methods: names of methods that predict frames; `playslot_m` is PlaySlot with InvDyn_M.
        seeds: training seeds.
        trained_seed, trained_frames: seed frames and predicted frames of a training clip, the same for all methods.
        shown: numbers of seed frames that are tested, each with `predicted` frames after them.
        predicted: frames that a test predicts.
        test: data sets of the test clips, separated by commas, each a table of its own. Empty records them with
            `data.root` empty, and else keeps some of its episodes.
        tested_on: policies of the test sets that are recorded; of drawn clips there is but one kind.
        tested: fraction of the episodes kept for the test where there is no such data set; validation clips are others.
        episodes: that a recorded test set has.
        vary: setting under `model.inverse_dynamics`, `model.predictor` or `dynamics` that PlaySlot is trained with in
            each of `values`, such as `model.inverse_dynamics.mode`; empty trains it as the config says.
        values: of that setting.
        objects: with `env=grid_shapes`, numbers of objects: one comparison each, and one table of all.
        clips: clips of these that are scored, at most.
        pictures: of so many of them the predictions are drawn.
        budget_minutes: wall-clock budget of each training, from its measured steps a second, models on frames with
            SAVi's time on top; 0: the preset's steps.
        rates: factors of the preset's learning rate, of which each method takes the best on validation clips; the grid
            is widened, twice at most, where that is at its edge. One of them means no choice.
        trial_steps: steps of each trial, which is the training in small: its phases are as much shorter.
        processes, launcher, hydra: as for `compare`.
    """

    group = "compare_video."
    methods: tuple[str, ...] = ("svg", "caddy", "slotformer", "ocvp_seq", "playslot")
    seeds: tuple[int, ...] = field(default=(0, 1, 2), metadata=SEED)
    trained_seed: int = field(default=6, metadata=at_least(1))
    trained_frames: int = field(default=8, metadata=at_least(1))
    shown: tuple[int, ...] = field(default=(6, 1), metadata=at_least(1, "numbers of at least 1"))
    predicted: int = field(default=15, metadata=at_least(1))
    test: str = field(default="", metadata=role("folder"))
    tested_on: tuple[Literal["expert", "random"], ...] = ("expert",)
    vary: str = ""
    values: tuple[str, ...] = ()
    objects: tuple[int, ...] = field(default=(), metadata=between(1, 5, "numbers of 1 to 5"))
    episodes: int = field(default=40, metadata=at_least(2, largest=EPISODES))
    tested: float = field(default=0.1, metadata=OPEN_FRACTION)
    clips: int = field(default=64, metadata=at_least(2))
    pictures: int = field(default=3, metadata=at_least(1))
    budget_minutes: float = field(default=0.0, metadata=at_least(0, "0 (the preset's steps) or more", YEAR_MINUTES))
    rates: tuple[float, ...] = field(default=(0.3, 1.0, 3.0), metadata=above_zero(largest=1e40))
    trial_steps: int = field(default=150, metadata=at_least(2))
    processes: int = field(default=1, metadata=role("machine") | between(1, 1024, "at least 1, 1024 at most"))
    launcher: str = ""
    hydra: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        known_methods = video_methods()
        for name in self.methods:
            check(name in known_methods, f"{self.group}methods", name, f"one of {', '.join(known_methods)}")
        check_lists(self, self.group, ("methods", "seeds", "shown", "rates", "tested_on"), "values", "objects")
        check(bool(self.vary) == bool(self.values), f"{self.group}values", self.values, "vary=SETTING and values=A,B")
        trained = self.trained_seed + self.trained_frames
        check(
            max(self.shown) < trained,
            f"{self.group}shown",
            self.shown,
            f"fewer than a training clip's {trained} frames",
        )
