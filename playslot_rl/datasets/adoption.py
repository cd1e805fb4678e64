"""How `playslot adopt` decides: what was chosen is kept, minutes are shared out, and settings follow from both."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from playslot_rl.config import EnvConfig, ExperimentConfig, SAViConfig
from playslot_rl.data.demonstrations import say_averaged
from playslot_rl.data.views import IntArray
from playslot_rl.data.windows import split_episodes
from playslot_rl.datasets.survey import Choice, Survey, choose_size, choose_stride
from playslot_rl.errors import ConfigError
from playslot_rl.evaluation.card import DEFAULT_EPISODES
from playslot_rl.runs import Run
from playslot_rl.storage.atomic import write_json

SHARES: Final = {"slots_trials": 0.18, "slots": 0.42, "dynamics_trial": 0.06, "dynamics": 0.28}
"""Of the time; the rest is for looking, parsing and the report card. A stage has the share of a trial that is left out,
too."""
TIMED_STEPS: Final = 24
FEWEST_TIMED: Final = 2
TIMED_SHARE: Final = 0.03  # of the time, which steps that are timed may take: then fewer are
SHORTEST: Final = 20  # steps of a training at least, however little time there is
TELLING: Final = 150
"""Steps from which on a trial says something: before that slots are not taken apart and one prototype holds all."""
PASSES: Final = 3  # a training step takes so many times as long as parsing its frames
PICTURES: Final = 1000  # frames that a report card draws, whatever it is measured on
PROBED: Final = 0.001  # seconds that its probes take for a transition
FEWEST: Final = 8  # episodes of a report card, at least


class Decisions:
    """What was decided (`made`), by name, in `RUN/adopt.json`, so that a second call decides the same.

    A ConfigError where the run was begun with other `facts`, which the decisions depend on. This process `began` with
    the work at that `time.monotonic()`.
    """

    def __init__(self, run: Path, facts: dict[str, Any], began: float) -> None:
        self.path = run / "adopt.json"
        stored: dict[str, Any] = json.loads(self.path.read_text()) if self.path.is_file() else {}
        facts = json.loads(json.dumps(facts))
        for key, value in stored.get("facts", facts).items():
            if facts.get(key, value) != value:  # versions before kept where the data set lies, not what it is
                raise ConfigError(
                    f"{key}: got {facts.get(key)}, expected {value}, with which out={run} was begun: leave it, or use "
                    "another out="
                )
        self.facts, self.made = facts, dict[str, Any](stored.get("choices", {}))
        self._before, self._began = float(stored.get("spent", 0.0)), began

    @property
    def spent(self) -> float:
        """Seconds of wall clock, with those of earlier processes up to the last that they noted."""
        return self._before + time.monotonic() - self._began

    def note(self, least: float = 0.0) -> None:
        """Write what is spent, which is so many seconds at least: a process that was killed noted less than it took."""
        self._before += max(0.0, least - self.spent)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_json(self.path, {"facts": self.facts, "choices": self.made, "spent": round(self.spent, 1)})

    def __call__(self, name: str, decide: Callable[[], Choice]) -> int:
        """The value of a decision, made now if it was not made before; it is said and written."""
        if name not in self.made:
            value, reason = decide()
            self.made[name] = {"value": value, "reason": reason}
            self.note()
        print(f"{name}: {self.made[name]['value']} ({self.made[name]['reason']})", flush=True)
        return int(self.made[name]["value"])


@dataclass(frozen=True)
class Budget:
    """The `seconds` of an adoption: what is left, less what comes after a training, is shared out each time.

    `frames` and `episodes` are those of the data set as far as the stride leaves them; `actions` are probed.
    """

    decide: Decisions
    seconds: float
    frames: int
    episodes: int
    actions: bool

    def left(self) -> float:
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
        return max(self.card(FEWEST, a_frame), min(self.card(DEFAULT_EPISODES, a_frame), self.seconds / 10))

    def card_episodes(self, a_frame: float) -> Choice:
        """As many as the time that is left is enough for."""
        fits = [n for n in range(FEWEST, DEFAULT_EPISODES + 1) if self.card(n, a_frame) <= self.left()]
        return Choice(max(fits, default=FEWEST), "as many as there is time for")

    def steps(self, name: str, run: Path, stage: str, seconds: float, milliseconds: float, before: float) -> int:
        """Steps of a stage that may take so many seconds, decided when it begins; `before` is what an earlier version,
        which planned all at the beginning, gave it.
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


def steps_within(seconds: float, seconds_a_step: float) -> int:
    """Optimiser steps that fit into some seconds."""
    return max(SHORTEST, int(seconds / max(seconds_a_step, 1e-6)))


def too_short(steps: int, what: str, preset: int) -> Choice | None:
    """The preset's number where the time allows no trial that would say anything."""
    if steps >= TELLING:
        return None
    return Choice(preset, f"the preset's: the time is enough for {steps} steps of a trial, and below {TELLING} {what}")


def with_slots(config: ExperimentConfig, slots: int) -> ExperimentConfig:
    return replace(config, model=replace(config.model, savi=replace(config.model.savi, n_slots=slots)))


def with_prototypes(config: ExperimentConfig, prototypes: int) -> ExperimentConfig:
    own = replace(config.model.inverse_dynamics, n_prototypes=prototypes)
    return replace(config, model=replace(config.model, inverse_dynamics=own))


def scheduled(config: ExperimentConfig, stage: str, steps: int, patience: int = 0) -> ExperimentConfig:
    """The config with so many steps of `slots` or `dynamics`: warm-up and teacher forcing shrink with them."""
    own: Any = getattr(config, stage)
    share = min(1.0, steps / own.steps)
    tenth = max(1, steps // 10)
    changes: dict[str, Any] = {"steps": steps, "validate_every": tenth, "checkpoint_every": tenth, "patience": patience}
    changes["optim"] = replace(own.optim, warmup_steps=round(own.optim.warmup_steps * share))
    if stage == "dynamics":
        changes["teacher_steps"] = round(own.teacher_steps * share)
    return replace(config, **{stage: replace(own, **changes)})


def shortest(config: ExperimentConfig) -> int:
    """Frames that a clip of the dynamics has at least."""
    return max(3, config.dynamics.seed_frames + 1)


def clip_room(lengths: IntArray, least: int, validation: float, seed: int) -> tuple[int, float]:
    """The longest clip that nine tenths of the episodes which have one at all have room for, and one of those held out.

    Args:
        lengths: frames of each episode that the stride leaves; half of them have the `least` of a clip.
        validation: fraction of the episodes that is held out by a split of that seed; larger in what is returned where
            all that were held out are too short.
    """
    room = np.sort(lengths[lengths >= least])
    longest = int(room[len(room) // 10])
    for share in (validation, 0.1, 0.2, 0.5):
        held_out = lengths[split_episodes(len(lengths), share, seed)[1]].max()
        if share >= validation and held_out >= least:
            return min(longest, int(held_out)), share
    return longest, 0.0  # measured on what is trained on


def savi_for(savi: SAViConfig, size: int) -> SAViConfig:
    """The preset's SAVi, which is for 64 pixels, for frames of another size: one doubling more or less in the decoder,
    and, of the strided encoder, as many tokens.
    """
    widths, strides = savi.decoder_channels, savi.encoder_strides
    if savi.decoder == "pixel_shuffle":
        doublings = int(math.log2(size // 8))
        widths = (*widths, *widths[-1:] * doublings)[:doublings]
    if savi.encoder == "strided" and size > 64:
        strides = (*strides[:-1], 2)
    return replace(savi, decoder_channels=widths, encoder_strides=strides)


def for_frames(config: ExperimentConfig, seen: Survey, decide: Decisions) -> ExperimentConfig:
    """The config with frame size, stride, and clips that the episodes have room for."""
    size = decide("frame size", lambda: choose_size(seen))
    stride = decide("stride", lambda: choose_stride(seen, size))
    if seen.action_dim:
        say_averaged(replace(config.data, stride=stride))
    kept = -(-seen.lengths // stride)
    typical, dynamics = int(np.median(kept)), config.dynamics
    longest, validation = clip_room(kept, shortest(config), config.data.validation, config.seed)
    predicted = min(dynamics.predicted_frames, longest - dynamics.seed_frames)
    return replace(
        config,
        env=replace(
            config.env,
            image_size=size,
            action_dim=seen.action_dim or config.env.action_dim,
            max_steps=max(2, typical - 1),
        ),
        model=replace(config.model, savi=savi_for(config.model.savi, size)),
        data=replace(config.data, camera=seen.camera, stride=stride, resize=True, validation=validation),
        slots=replace(
            config.slots,
            clip_frames=min(config.slots.clip_frames, longest),
            start_from=start_for(config.slots.start_from, size),
        ),
        dynamics=replace(dynamics, predicted_frames=predicted),
    )


def start_for(where: str, size: int) -> str:
    """What SAVi starts from: a model of frames of another size has other weights."""
    if where and Run.open(where).stage("slots").group(EnvConfig, "env").image_size != size:
        print(f"note: frames of {size} pixels, other than those of slots.start_from={where}: SAVi starts from scratch")
        return ""
    return where
