"""How `playslot adopt` spends its minutes: what is left, less what comes after a training, is shared out each time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from playslot_rl.config import ExperimentConfig
from playslot_rl.datasets.survey import Choice
from playslot_rl.recipes.adopt_decisions import Decisions
from playslot_rl.recipes.adopt_trials import FEWEST_TIMED, SHORTEST, TIMED_SHARE, TIMED_STEPS, steps_within

SHARES: Final = {"slots_trials": 0.18, "slots": 0.42, "dynamics_trial": 0.06, "dynamics": 0.28}
"""Of the time; the rest is for looking, parsing and the report card. A stage has the share of a trial that is left out,
too."""
PASSES: Final = 3
"""A training step takes so many times as long as parsing its frames."""
PICTURES: Final = 1000
"""Frames that a report card draws, whatever it is measured on."""
PROBED: Final = 0.001
"""Seconds that its probes take for a transition."""
FEWEST: Final = 8
"""Episodes of a report card, at least."""


@dataclass(frozen=True)
class Plan:
    """The time of an adoption.

    Attributes:
        decide: what was decided, and what is spent.
        seconds: that it may take.
        frames, episodes: of the data set, as far as the stride leaves them.
        actions: whether there are any, to be probed.
    """

    decide: Decisions
    seconds: float
    frames: int
    episodes: int
    actions: bool

    def left(self) -> float:
        """Seconds."""
        return self.seconds - self.decide.spent

    def parsing(self, config: ExperimentConfig, milliseconds: float) -> float:
        """Seconds that a frame takes to be parsed, from those of a training step."""
        return milliseconds / 1000 / (PASSES * config.slots.batch_size * config.slots.clip_frames)

    def card(self, episodes: int, a_frame: float) -> float:
        """Seconds that a report card on so many episodes takes, from those of a frame."""
        frames = min(episodes, self.episodes) * self.frames / self.episodes
        return PICTURES * a_frame + frames * (3 * a_frame + (PROBED if self.actions else 0.0))

    def afterwards(self, a_frame: float) -> float:
        """Seconds for a report card, a tenth of all at most if it does with fewer episodes."""
        from playslot_rl.evaluation.card import DEFAULT_EPISODES

        return max(self.card(FEWEST, a_frame), min(self.card(DEFAULT_EPISODES, a_frame), self.seconds / 10))

    def card_episodes(self, a_frame: float) -> Choice:
        """As many as the time that is left is enough for."""
        from playslot_rl.evaluation.card import DEFAULT_EPISODES

        fits = [n for n in range(FEWEST, DEFAULT_EPISODES + 1) if self.card(n, a_frame) <= self.left()]
        return Choice(max(fits, default=FEWEST), "as many as there is time for")

    def steps(self, name: str, run: Path, stage: str, seconds: float, milliseconds: float, before: float) -> int:
        """Steps of a stage, decided when it begins.

        Args:
            name: of the stage, in words.
            seconds: that it may take.
            milliseconds: of a step.
            before: seconds that an earlier version, which planned all at the beginning, gave it.
        """
        key = f"steps of {name}"
        if key not in self.decide.made and (run / stage).is_dir():  # begun by that version
            return steps_within(before, milliseconds / 1000)
        fits = steps_within(seconds, milliseconds / 1000)
        return self.decide(key, lambda: Choice(fits, f"{max(0.0, seconds):.0f} s at {milliseconds:.0f} ms a step"))

    def timing(self, milliseconds: float) -> float:
        """Seconds in which the step of a stage is measured."""
        whole = TIMED_STEPS * milliseconds / 1000
        return max(whole * FEWEST_TIMED / TIMED_STEPS, min(whole, self.seconds * TIMED_SHARE))

    def trial(self, of: str, seconds: float, milliseconds: float) -> int:
        """Steps of a trial."""
        fits = steps_within(seconds, milliseconds / 1000)
        return self.decide(f"steps of a trial of {of}", lambda: Choice(fits, "as many as there is time for"))

    def warn(self, milliseconds: float, afterwards: float) -> None:
        """Say it where not even the shortest trainings fit."""
        need = self.decide.spent + afterwards + 2 * SHORTEST * milliseconds / 1000
        if need > self.seconds:
            print(
                f"note: minutes={self.seconds / 60:g} are too few for the shortest trainings on this machine: it will "
                f"take about {need / 60:.1f}",
                flush=True,
            )
