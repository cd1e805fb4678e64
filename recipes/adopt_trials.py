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
    too_short,
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


def timed(config: ExperimentConfig, stage: str, trials: Path) -> Choice:
    """Milliseconds that a step takes, measured in a small part of the minutes; nothing else of it is kept."""
    from playslot_rl.recipes import train_dynamics, train_slots
    from playslot_rl.training.pace import Pace

    pace = Pace(60 * config.minutes * TIMED_SHARE, FEWEST_TIMED)
    short, out = scheduled(config, stage, TIMED_STEPS), trials / f"time_{stage}_{config.model.savi.n_slots}"
    once: dict[str, Any] = {"validate_every": TIMED_STEPS, "checkpoint_every": TIMED_STEPS}
    if stage == "dynamics":  # steps with a teacher are much cheaper than rollouts
        once["teacher_steps"] = 0
    short = replace(short, **{stage: replace(getattr(short, stage), **once)})
    with _quietly():
        (train_slots if stage == "slots" else train_dynamics).main(replace(short, out=str(out)), pace)
    meta = Run(out).own(stage).meta
    seconds = float(meta["seconds"]) / float(meta["steps"])
    return Choice(max(1, round(1000 * seconds)), "measured here, the first steps included")


def paced(steps: int, milliseconds: float, settled: int = 0) -> Pace:
    """The time that so many steps were planned to take."""
    from playslot_rl.training.pace import Pace

    return Pace(steps * milliseconds / 1000, SHORTEST, settled)


def choose_slots(config: ExperimentConfig, out: Path, steps: int, milliseconds: float) -> Choice:
    """The smallest number of slots that reconstructs held-out clips nearly as well as the best of those tried, by
    trials of so many steps below `out`.
    """
    from playslot_rl.recipes import train_slots

    tried, errors = sorted(config.adopt.slots), dict[int, float]()
    if len(tried) == 1:
        return Choice(tried[0], "as asked for")
    if few := too_short(steps, "the scene is not taken apart", config.model.savi.n_slots):
        return few
    for slots in tried:
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


def choose_prototypes(config: ExperimentConfig, run: Path, steps: int, milliseconds: float) -> Choice:
    """As many prototypes as carry nearly all transitions when there are more than enough, by a trial of so many steps
    on the slots of `run`.
    """
    import numpy as np

    from playslot_rl.data.cache import Cache
    from playslot_rl.data.slot_cache import slot_cache
    from playslot_rl.data.videos import open_videos
    from playslot_rl.evaluation.probes import infer_latents
    from playslot_rl.recipes import train_dynamics
    from playslot_rl.world_model import module_device

    many, out = config.adopt.prototypes, run / "trials" / "prototypes"
    if few := too_short(steps, "one prototype holds all", config.model.inverse_dynamics.n_prototypes):
        return few
    trial = scheduled(with_prototypes(config, many), "dynamics", steps)
    with _quietly():
        train_dynamics.main(replace(trial, run=str(run), out=str(out)), paced(steps, milliseconds))
    trained = Run.open(out)
    model = trained.load_world_model(config.device or "cpu")
    source = open_videos(config, config.data.root, "adopt", False)
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
