"""Short trainings by which `playslot adopt` chooses slots and prototypes, and learns what a step takes.

Each is a run of its own below `OUT/trials`, finished or carried on like any other.
"""

from __future__ import annotations

import contextlib
import io
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from playslot_rl.config import ExperimentConfig
from playslot_rl.datasets.adoption import (
    FEWEST_TIMED,
    SHORTEST,
    TIMED_SHARE,
    TIMED_STEPS,
    scheduled,
    with_prototypes,
    with_slots,
)
from playslot_rl.datasets.survey import Choice
from playslot_rl.runs import Run

if TYPE_CHECKING:
    from playslot_rl.training.pace import Pace

CARRIED: Final = 0.95
"""Share of the transitions that the prototypes in use have to carry."""
FEWEST: Final = 4
"""Prototypes at least."""
CUT_SHORT: Final = 0.8
"""Share of a trial's planned steps, with fewer of which, for want of time, it cannot be compared with others."""


def _quietly() -> contextlib.AbstractContextManager[Any]:
    """What a trial says of its slots, after a few steps, would mislead: its outcome is the reason of a choice."""
    return contextlib.redirect_stdout(io.StringIO())


def seconds_a_step(config: ExperimentConfig, stage: str, out: Path) -> float:
    """Seconds that a step takes, measured in a small part of the minutes; nothing else of that training is kept."""
    from playslot_rl.recipes import train_dynamics, train_slots
    from playslot_rl.training.pace import Pace

    pace = Pace(60 * config.minutes * TIMED_SHARE, FEWEST_TIMED)
    timed = scheduled(config, stage, TIMED_STEPS)
    once: dict[str, Any] = {"validate_every": TIMED_STEPS, "checkpoint_every": TIMED_STEPS}
    if stage == "dynamics":  # steps with a teacher are much cheaper than rollouts
        once["teacher_steps"] = 0
    timed = replace(timed, **{stage: replace(getattr(timed, stage), **once)})
    with _quietly():
        (train_slots if stage == "slots" else train_dynamics).main(replace(timed, out=str(out)), pace)
    meta = Run(out).own(stage).meta
    return float(meta["seconds"]) / float(meta["steps"])


def paced(steps: int, milliseconds: float, settled: int = 0) -> Pace:
    """The time that so many steps were planned to take."""
    from playslot_rl.training.pace import Pace

    return Pace(steps * milliseconds / 1000, SHORTEST, settled)


def choose_slots(config: ExperimentConfig, out: Path, steps: int, milliseconds: float) -> Choice:
    """The smallest number of slots that reconstructs held-out clips nearly as well as the best of those tried.

    Args:
        config: with everything else chosen.
        out: folder of the trials.
        steps: of each.
        milliseconds: of a step.
    """
    from playslot_rl.recipes import train_slots

    errors = {}
    for slots in sorted(config.adopt.slots):
        folder = out / f"slots_{slots}"
        with _quietly():
            trial = scheduled(replace(with_slots(config, slots), out=str(folder)), "slots", steps)
            train_slots.main(trial, paced(steps, milliseconds))
        meta = Run(folder).own("slots").meta
        if meta["steps"] < CUT_SHORT * steps:
            preset = config.model.savi.n_slots
            return Choice(preset, f"the preset's: the time was enough for {meta['steps']} of {steps} steps of a trial")
        errors[slots] = float(meta["metrics"]["mse"])
    enough = min(errors.values()) * (1 + config.adopt.tolerance)
    slots = min(slots for slots, error in errors.items() if error <= enough)
    listed = ", ".join(f"{slots}: {error:.5f}" for slots, error in errors.items())
    return Choice(slots, f"held-out squared error after {steps} steps by number of slots: {listed}")


def choose_prototypes(config: ExperimentConfig, run: Path, out: Path, steps: int, milliseconds: float) -> Choice:
    """As many prototypes as carry nearly all transitions when there are more than enough.

    Args:
        config: with everything else chosen.
        run: whose slots the trial builds on.
        out: folder of the trial.
        steps: of it.
        milliseconds: of a step.
    """
    import numpy as np

    from playslot_rl.data.cache import Cache
    from playslot_rl.data.slot_cache import slot_cache
    from playslot_rl.evaluation.probes import infer_latents
    from playslot_rl.recipes import train_dynamics
    from playslot_rl.training.record import open_videos
    from playslot_rl.world_model import module_device

    many = config.adopt.prototypes
    trial = scheduled(with_prototypes(config, many), "dynamics", steps)
    with _quietly():
        train_dynamics.main(replace(trial, run=str(run), out=str(out)), paced(steps, milliseconds))
    trained = Run.open(out)
    model = trained.load_world_model(config.device or "cpu")
    source = open_videos(config, config.data.root, "adopt")
    slots = slot_cache(
        source, model.savi, trained.stage("slots").fingerprint, Cache.of(config.data), module_device(model), False
    )
    _, codes, _ = infer_latents(model.inverse_dynamics, slots, source.starts, source.lengths)
    shares = np.sort(np.bincount(codes.reshape(-1), minlength=many) / codes.size)[::-1]
    needed = int(np.searchsorted(np.cumsum(shares), CARRIED)) + 1
    said = (
        f"{min(needed, many)} of {many} prototypes carry {100 * CARRIED:.0f} % of the transitions after {steps} steps"
    )
    return Choice(max(FEWEST, min(needed, many)), said)
