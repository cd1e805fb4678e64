"""Open-loop action error: what a policy does at the frames of recorded demonstrations beside what was done there. It
needs no simulator, and says nothing of where the policy's own actions would have led.

    e_t = a^(o_0 .. o_t) - a_t,    R2 = 1 - sum (e_t / s)^2 / sum ((m - a_t) / s)^2

with mean m and deviation s of each dimension over the labelled transitions that the policy was trained on. The actor
acts as in closed loop, frame by frame with its memory, only that each next frame is the recorded one.

Note: an action of a demonstrator who could as well have done another counts as the only right one, and where actions
change slowly, repeating the last one is hard to beat: both references stand beside the policy.

Shapes: E episodes, M transitions, A action width, B draws.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict

from playslot_rl import keys
from playslot_rl.acting.actor import Actor
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.config import EnvConfig, ExperimentConfig, plugins
from playslot_rl.config.methods import METHODS, cloning_methods
from playslot_rl.data.action_limits import other_units, said, scaled
from playslot_rl.data.agreement import say_once
from playslot_rl.data.demonstrations import split_demonstrations, transitions
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.tasks import told_tasks
from playslot_rl.data.videos import open_videos, places
from playslot_rl.data.views import chosen_episodes
from playslot_rl.data.weighted import open_configured
from playslot_rl.errors import CheckpointError, ConfigError, DataError
from playslot_rl.evaluation.held_out import trained_on
from playslot_rl.evaluation.intervals import resampled
from playslot_rl.evaluation.success import hardware, run_facts
from playslot_rl.runs import Run
from playslot_rl.storage.atomic import write_json
from playslot_rl.storage.checkpoints import StageCheckpoint, source_commit

PROTOCOL = "actions"
AT_ONCE = 16
"""Episodes side by side."""
Floats = npt.NDArray[np.float64]


def require_offline(method: str) -> None:
    """Refuse a method that gives no policy of demonstrations, by a ConfigError."""
    kind = METHODS[method]
    if kind.online or not kind.acts:
        able = ", ".join(cloning_methods())
        what = "learns by acting" if kind.acts else "predicts videos"
        raise ConfigError(f"method: got {method}, which {what}, with protocol=actions, expected one of {able}")


@dataclass(frozen=True)
class Recorded:
    """Demonstrations that a policy is held against: `source`, labelled all; `untold` are stages that do not say which
    episodes they were trained on."""

    source: EpisodeFrames
    untold: tuple[str, ...]

    @classmethod
    def of(cls, config: ExperimentConfig, run: Run, stages: Mapping[str, StageCheckpoint]) -> Recorded:
        """The held-out demonstrations of the set that the run was trained on, or all of another that `data.demos`
        names. A DataError where none has actions, or a stage was trained on one."""
        named, trained = (c.data.demos or c.data.root for c in (config, run.config))
        own = places(named) == places(trained)
        source = open_videos(config, named, "evaluate") if own else open_configured(config, named)
        if own:
            data = config.data  # where some are kept, these alone: models of videos may have seen others
            most, draw = (0, None) if data.held_out else (config.collect.validation_episodes, data.draw)
            held = split_demonstrations(source, config.demos, data.held_out, most, draw).held_out
            if held is None:
                raise DataError(
                    f"data.held_out: got {data.held_out}, and a policy that was trained on all of {source.name}, "
                    "expected some of its episodes kept: train with data.held_out=N, or name another set by data.demos="
                )
            source = held
        labelled = np.unique(source.numbers[[_labelled(source, episode) for episode in range(source.episodes)]])
        if not len(labelled):
            raise DataError(f"data.demos={named}: got no actions to measure on, expected labelled demonstrations")
        source = chosen_episodes(source, labelled, "labelled")
        return cls(source, require_unseen(source, stages, config.data.held_out or "N" if own else ""))


def require_unseen(
    source: EpisodeFrames, stages: Mapping[str, StageCheckpoint], held_out: int | str
) -> tuple[str, ...]:
    """Refuse, by a DataError, episodes that a stage was trained on; returns the stages that do not say. Stages that
    hold out as many of the set (`held_out`, if it is theirs) would not have been."""
    counts = trained_on(source, {name: stage.meta for name, stage in stages.items()})
    met = {name: count for name, count in counts.items() if count}
    if met:
        which = ", ".join(met)
        same = f"data.held_out={held_out}{' and the same env.task' * (source.turns)}"
        cure = f"train {which} with {same}, too, or name" if held_out else "name"
        raise DataError(
            f"data.demos={source.name}: got {max(met.values())} of {source.recordings} episodes that {which} "
            f"{'were' if len(met) > 1 else 'was'} trained on, expected none: {cure} another set by data.demos="
        )
    return tuple(name for name, count in counts.items() if count is None and stages[name].meta["data"])


def _labelled(source: EpisodeFrames, episode: int) -> bool:
    """Whether a transition of an episode has an action."""
    rows = source.episode_rows(episode)[:-1]
    return source.actions is not None and bool(np.isfinite(source.actions[rows]).all(axis=1).any())


def _seeds(source: EpisodeFrames, env: EnvConfig) -> Sequence[int]:
    """Of the episodes; where there are several tasks they tell which."""
    if told_tasks(source, transitions(source), env) is None or source.tasks is None:
        return range(source.episodes)
    return [len(env.tasks) * i + env.sentences.index(task) for i, task in enumerate(source.tasks.tolist())]


@torch.no_grad()
def acted(actor: Actor, source: EpisodeFrames, seeds: Sequence[int]) -> npt.NDArray[np.float32]:
    """What an actor would do at each row, in the units of the data set, (F, A); NaN where no transition begins."""
    width = source.require_actions().shape[1]
    found = np.full((len(source.frames), width), np.nan, np.float32)
    if actor.shown_goals:
        last = dict(zip(seeds, source.starts + source.lengths - 1, strict=True))
        actor.goals = lambda some: source.pixels(np.array([last[seed] for seed in some])).to(actor.device)
    for first in range(0, source.episodes, AT_ONCE):
        starts, steps = (part[first : first + AT_ONCE] for part in (source.starts, source.lengths - 1))
        loop = ClosedLoop(actor)
        loop.reset(seeds[first : first + AT_ONCE])
        for step in range(int(steps.max())):
            running = np.flatnonzero(steps > step)
            rows = starts[running] + step
            values = {keys.PIXELS: source.pixels(rows).to(actor.device)}
            if keys.STATE in actor.in_keys:
                values[keys.STATE] = torch.from_numpy(source.require_states()[rows]).to(actor.device)
            seen = loop.step(TensorDict(values, [len(rows)]), running.tolist())
            found[rows] = actor.executed(seen.get(keys.ACTION)).cpu().numpy()
    return found


@dataclass(frozen=True)
class Errors:
    """Errors summed over the transitions of each episode: absolute and squared (E, A), and transitions (E,)."""

    absolute: Floats
    squared: Floats
    rows: Floats

    @classmethod
    def of(cls, errors: Floats, episode: npt.NDArray[np.int64]) -> Errors:
        """Of errors (M, A)."""
        count = int(episode.max()) + 1
        absolute, squared = np.zeros((2, count, errors.shape[1]))
        np.add.at(absolute, episode, np.abs(errors))
        np.add.at(squared, episode, errors**2)
        return cls(absolute, squared, np.bincount(episode, minlength=count).astype(np.float64))

    def mae(self, drawn: Floats) -> Floats:
        """Mean over the dimensions for draws of episodes (B, E): (B,)."""
        found: Floats = self._mean(self.absolute, drawn).mean(axis=1)
        return found

    def rmse(self, drawn: Floats) -> Floats:
        found: Floats = np.sqrt(self._mean(self.squared, drawn)).mean(axis=1)
        return found

    def r2(self, drawn: Floats, constant: Errors, deviation: Floats) -> Floats:
        """Against the constant, each dimension by its deviation (A,); those that never changed are left out."""
        moves = deviation > 0
        own, other = (part.squared[:, moves] / deviation[moves] ** 2 for part in (self, constant))
        least = (drawn @ other).sum(axis=1)
        known = np.where(least > 0, least, np.nan)  # a draw of episodes in which the constant is right says nothing
        found: Floats = 1 - (drawn @ own).sum(axis=1) / known
        return found

    def _mean(self, sums: Floats, drawn: Floats) -> Floats:
        mean: Floats = (drawn @ sums) / (drawn @ self.rows)[:, None]
        return mean


def scores(errors: Errors, constant: Errors, deviation: Floats) -> dict[str, Any]:
    """`mae`, `rmse`, `r2` (None where no action ever changed), and `ci95` of each, over episodes (None of one)."""
    ways: dict[str, Callable[[Floats], Floats]] = {
        "mae": errors.mae,
        "rmse": errors.rmse,
        "r2": lambda drawn: errors.r2(drawn, constant, deviation),
    }
    found, intervals = dict[str, Any](), dict[str, Any]()
    for name, way in ways.items():
        value = float(way(np.ones((1, len(errors.rows))))[0])
        found[name] = value if np.isfinite(value) else None
        some = len(errors.rows) > 1 and found[name] is not None
        bounds = (-np.inf, 1.0) if name == "r2" else (0.0, np.inf)
        intervals[name] = list(resampled(way, len(errors.rows), bounds)) if some else None
    return {**found, "ci95": intervals}


def error_text(row: Mapping[str, Any]) -> str:
    """`4.2 (3.9 to 4.6), R2 0.71 (0.66 to 0.75)`: mean absolute error in the data set's units and R2, with their
    intervals as far as `ci95` has them: one of each, or the error's alone.
    """
    known = row.get("ci95") or {}
    known = known if isinstance(known, Mapping) else {"mae": known}
    texts = []
    for name, form in (("mae", ".3g"), ("r2", ".2f")):
        ends = known.get(name)
        interval = f" ({ends[0]:{form}} to {ends[1]:{form}})" if ends else ""
        texts += [] if row[name] is None else [f"{row[name]:{form}}{interval}"]
    return ", R2 ".join(texts)


def measure_actions(
    actor: Actor, source: EpisodeFrames, taught: Mapping[str, Any], seeds: Sequence[int]
) -> dict[str, Any]:
    """Errors of an actor on labelled demonstrations: `episodes`, `rows`, what `scores` says, `per_dimension`,
    `references` and `per_episode`.

    Args:
        taught: `action_mean` and `action_deviation` (A,) of what it was trained on.
    """
    mean, deviation = (np.asarray(taught[key], np.float64) for key in ("action_mean", "action_deviation"))
    actions = source.require_actions(len(mean)).astype(np.float64)
    moves = transitions(source)
    kept = np.isfinite(actions[moves.rows]).all(axis=1)
    rows, episode, begins = moves.rows[kept], moves.episode[kept], moves.step[kept] == 0
    before = actions[np.maximum(rows - 1, 0)]
    before = np.where((begins | ~np.isfinite(before).all(axis=1))[:, None], mean, before)
    said = acted(actor, source, seeds).astype(np.float64)[rows]
    ways = {PROTOCOL: said, "constant": mean[None], "previous": before}
    own, constant, previous = (Errors.of(way - actions[rows], episode) for way in ways.values())
    count = len(rows)
    names = [f"action_{i}" for i in range(len(mean))] if source.limits is None else source.limits.names
    dimensions = zip(names, own.absolute.sum(0), own.squared.sum(0), constant.absolute.sum(0), strict=True)
    one = np.eye(len(own.rows))
    return {
        "episodes": len(own.rows),
        "rows": count,
        **scores(own, constant, deviation),
        "per_dimension": [
            {"name": n, "mae": a / count, "rmse": float(np.sqrt(s / count)), "constant_mae": c / count}
            for n, a, s, c in dimensions
        ],
        "references": {
            "constant": {
                "is": "the mean action of the labelled training rows",
                **scores(constant, constant, deviation),
            },
            "previous": {
                "is": "the recorded action of the step before, at the first step the constant",
                **scores(previous, constant, deviation),
            },
        },
        "per_episode": {"rows": own.rows.tolist(), "mae": own.mae(one).tolist(), "rmse": own.rmse(one).tolist()},
    }


def _require_alike(source: EpisodeFrames, meta: Mapping[str, Any]) -> None:
    """Refuse the taught actions in another order, by a DataError; say where the rate, or the unit, is another: the ends
    (`ActionLimits.plain`) that some numbers never are between, or that all are far narrower or wider than."""
    if (fps := meta.get("fps")) and f"{fps:g}" != f"{source.fps:g}":
        say_once(f"note: {source.name}: got {source.fps:g} frames a second, where the policy was taught by {fps:g}")
    taught = meta.get("actions")
    if not taught or not scaled(taught):
        return
    names = () if source.limits is None else source.limits.names
    if sorted(names) == sorted(taught["names"]) and [*names] != [*taught["names"]]:
        got, expected = ", ".join(names), ", ".join(taught["names"])
        raise DataError(f"{source.name}: got actions in the order {got}, expected {expected}, as the policy was taught")
    low, high = (np.asarray(taught[end], np.float32) for end in ("low", "high"))
    actions = source.require_actions(len(low))
    if source.limits is None:
        least, most = np.nanmin(actions, 0), np.nanmax(actions, 0)
    else:  # without the outliers
        least, most = source.limits.low, source.limits.high
    far = (low < high) & ((least > high) | (most < low) | other_units(high - low, most - least))
    if len(far := np.flatnonzero(far)):
        met = ", ".join(f"{taught['names'][i]} {least[i]:.6g}..{most[i]:.6g}" for i in far)
        known = said({key: [taught[key][i] for i in far] for key in ("names", "low", "high")})
        say_once(f"note: {source.name}: got {met}, where the policy was taught {known}: are the units the same?")


def policy_stages(run: Run, method: str) -> dict[str, StageCheckpoint]:
    """The stage of a method's policy, first, and all that it builds on."""
    last = run.stage(METHODS[method].last.name)
    world = ("slots", "dynamics")
    return {last.stage: last} | {
        name: run.stage(name) if name in world else run.own(name) for name in last.meta.get("parents", {})
    }


def asked(config: ExperimentConfig) -> dict[str, Any]:
    """What decides, beside the policy, what it is measured on."""
    return {"demos": config.data.demos or config.data.root, "held_out": config.data.held_out}


def evaluate_actions(run: Run, config: ExperimentConfig, device: torch.device) -> dict[str, Any]:
    """Measure the policy of `config.method`, and write `RUN/evaluation/actions/eval_info.json`.

    Raises:
        ConfigError: the method acts in a simulator only.
        CheckpointError: there is no trained policy, or one of an earlier version.
        DataError: no demonstrations to measure on that nothing was trained on.
    """
    require_offline(config.method)
    facts, stages = run_facts(run.folder, config.method), policy_stages(run, config.method)
    taught = next(iter(stages.values())).meta
    if "action_mean" not in taught:
        raise CheckpointError(
            f"run={run.folder}: got a policy of an earlier version, expected one that knows the mean of its labelled "
            "actions: train it again"
        )
    recorded = Recorded.of(config, run, stages)
    _require_alike(recorded.source, taught)
    began, actor = time.perf_counter(), plugins.call(METHODS[config.method].load.actor, run, device)
    actor.eval()
    source = recorded.source
    result = {
        "method": config.method,
        "protocol": PROTOCOL,
        **measure_actions(actor, source, taught, _seeds(source, config.env)),
        "labelled_demos": facts.labelled_demos,
        "demos": facts.demos,
        "asked": asked(config),
        "data": {"name": source.name, "fingerprint": source.fingerprint},
        "untold": list(recorded.untold),
        "wall_seconds": round(time.perf_counter() - began, 2),
        "fingerprints": facts.fingerprints,
        "commit": source_commit(),
        "trained_at": facts.trained_at,
        "hardware": hardware(),
    }
    write_json(run.folder / "evaluation" / PROTOCOL / "eval_info.json", result)
    return result
