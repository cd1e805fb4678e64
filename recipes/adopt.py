"""`playslot adopt data.root=SET out=RUN minutes=60`: any LeRobot set with a camera becomes a playable world model.

    look at the set -> frame size, stride -> trials -> slots, prototypes -> SAVi, dynamics -> report card

What was chosen, and why, is written to `RUN/adopt.json` as soon as it is known: a second call goes on from there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.weights import data_roots
from playslot_rl.data.agreement import open_files
from playslot_rl.data.cache import cache_folder
from playslot_rl.data.prints import files_fingerprint
from playslot_rl.datasets.adoption import (
    SHARES,
    Budget,
    Decisions,
    for_frames,
    scheduled,
    shortest,
    with_prototypes,
    with_slots,
)
from playslot_rl.datasets.survey import survey
from playslot_rl.errors import ConfigError, DataError
from playslot_rl.recipes import inspect, train_dynamics, train_slots
from playslot_rl.recipes.adopt_trials import choose_prototypes, choose_slots, paced, timed
from playslot_rl.runs import Run
from playslot_rl.runs.opening import run_to_write

if TYPE_CHECKING:
    from playslot_rl.training.pace import Pace


def main(config: ExperimentConfig) -> None:
    """Choose, train and report."""
    if config.env.name != "video":
        raise ConfigError(f"env: got {config.env.name}, expected video: adopt reads recorded videos; leave env= out")
    if [root.weight for root in data_roots(config.data.root)] != [None]:
        raise ConfigError(
            f"data.root: got {config.data.root or 'nothing'}, expected one data set, such as data.root=SET"
        )
    if "," in config.data.camera:
        raise ConfigError(f"data.camera: got {config.data.camera}, expected one: adopt reads one camera")
    began = time.monotonic()
    run = run_to_write(config).folder
    seen = survey(config.data.root, config.data.camera)
    shown = max(1, len(seen.lengths) - config.data.held_out)
    seen, least = replace(seen, lengths=seen.lengths[:shown]), shortest(config)
    if np.median(seen.lengths) < least:
        raise DataError(
            f"{seen.root}: got episodes of {np.median(seen.lengths):.0f} frames (median), expected at least {least} in "
            "half of them: record longer episodes"
        )
    asked = {"minutes": config.minutes, "seed": config.seed, "preset": config.preset, **to_dict(config.adopt)}
    content = files_fingerprint(open_files(config.data.root), seen.camera, cache_folder(config.data.cache))
    decide = Decisions(run, {"data": content, "camera": seen.camera, **asked}, began)
    config = replace(for_frames(config, seen, decide), out=str(run), run="")
    kept = -(-seen.lengths // config.data.stride)
    budget = Budget(decide, 60 * config.minutes, int(kept.sum()), len(kept), seen.action_dim > 0)

    config, milliseconds = _chosen_slots(config, run, budget)
    _train(train_slots.main, config, "slots", milliseconds, budget)
    a_frame = budget.parsing(config, milliseconds)
    config, milliseconds = _chosen_prototypes(config, run, budget, budget.afterwards(a_frame))
    _train(train_dynamics.main, config, "dynamics", milliseconds, budget)
    episodes = decide("episodes of the report card", lambda: budget.card_episodes(a_frame))
    print(f"look at it: playslot play run={run} data.root={config.data.root}", flush=True)
    inspect.main_if_needed(replace(config, run=str(run), out="", episodes=episodes))


def _train(
    train: Callable[[ExperimentConfig, Pace], None],
    config: ExperimentConfig,
    stage: str,
    milliseconds: int,
    budget: Budget,
) -> None:
    """Train a stage in the time that its steps were planned to take."""
    own: Any = getattr(config, stage)
    before = budget.decide.spent
    train(config, paced(own.steps, milliseconds, getattr(own, "teacher_steps", 0)))
    meta = Run(Path(config.out)).own(stage).meta
    if budget.decide.spent > before + 1:  # not one that was finished before
        budget.decide.note(before + float(meta["seconds"]))


def _chosen_slots(config: ExperimentConfig, run: Path, budget: Budget) -> tuple[ExperimentConfig, int]:
    """The config with the number of slots and with the steps that fit, and milliseconds of a step."""
    trials, tried, decide = run / "trials", config.adopt.slots, budget.decide
    milliseconds = decide("milliseconds a step of SAVi", lambda: timed(with_slots(config, max(tried)), "slots", trials))
    a_frame, all_shares = budget.parsing(config, milliseconds), sum(SHARES.values())
    # Afterwards all frames are parsed, steps of the dynamics timed, a report card made.
    afterwards = budget.afterwards(a_frame) + budget.frames * a_frame + budget.timing(milliseconds)
    if "slots" not in decide.made:
        budget.warn(milliseconds, afterwards)
    share = (budget.left() - afterwards) * SHARES["slots_trials"] / all_shares / len(tried)
    slots = decide(
        "slots", lambda: choose_slots(config, trials, budget.trial("slots", share, milliseconds), milliseconds)
    )
    if slots != max(tried):
        milliseconds = decide(
            f"milliseconds a step with {slots} slots", lambda: timed(with_slots(config, slots), "slots", trials)
        )
    own = SHARES["slots"] + (0.0 if (trials / f"slots_{slots}").is_dir() else SHARES["slots_trials"])
    rest = SHARES["dynamics_trial"] + SHARES["dynamics"]
    seconds = (budget.left() - afterwards) * own / (own + rest)
    steps = budget.steps("SAVi", run, "slots", seconds, milliseconds, budget.seconds * own)
    if steps < config.slots.steps / 2:
        enough = math.ceil(config.slots.steps * milliseconds / 1000 / 60 / SHARES["slots"])
        print(
            f"note: minutes={config.minutes:g} are {steps} steps of SAVi on this machine; the preset's "
            f"{config.slots.steps} would take minutes={enough}",
            flush=True,
        )
    return scheduled(with_slots(config, slots), "slots", steps, config.adopt.patience), milliseconds


def _chosen_prototypes(
    config: ExperimentConfig, run: Path, budget: Budget, afterwards: float
) -> tuple[ExperimentConfig, int]:
    """The config with the number of prototypes and with the steps that fit, and milliseconds of a step."""
    trials, child, decide = run / "trials", replace(config, run=str(run)), budget.decide
    milliseconds = decide("milliseconds a step of the dynamics", lambda: timed(child, "dynamics", trials))
    trial, own = SHARES["dynamics_trial"], SHARES["dynamics"]
    share = (budget.left() - afterwards) * trial / (trial + own)
    prototypes = decide(
        "prototypes",
        lambda: choose_prototypes(config, run, budget.trial("prototypes", share, milliseconds), milliseconds),
    )
    few = not (trials / "prototypes").is_dir()
    seconds, before = budget.left() - afterwards, budget.seconds * (own + (trial if few else 0.0))
    steps = budget.steps("the dynamics", run, "dynamics", seconds, milliseconds, before)
    return scheduled(with_prototypes(config, prototypes), "dynamics", steps, config.adopt.patience), milliseconds
