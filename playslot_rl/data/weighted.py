"""Data sets as a config wants them, and several as one, each drawn from as often as its weight says: first the set,
then a window of it.

    P(window w of set i) = weight_i / sum_j weight_j  *  1 / (windows of set i)

Without weights every window of all sets is equally likely, so that a set counts by its size.

Shapes: P sets, E episodes, F frames, B batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl.config import EnvConfig, ExperimentConfig, metaworld, to_dict
from playslot_rl.config.env import VIDEO
from playslot_rl.config.weights import DataRoot, data_roots, is_remote
from playslot_rl.data.action_limits import ours
from playslot_rl.data.agreement import say_once
from playslot_rl.data.cache import Cache
from playslot_rl.data.metadata import read_info, read_record, robot_of
from playslot_rl.data.source import EpisodeFrames, open_sources
from playslot_rl.data.views import IntArray, concatenate, every, text_hash
from playslot_rl.errors import DataError


@dataclass(frozen=True)
class Shares:
    """Which rows belong to which set. An episode's set follows from its first row, however episodes are chosen.

    Attributes:
        ends: int64 (P,), the row after each set's last one.
        weights: float64 (P,), above 0; they need not add up to 1.
        sources: the sets; empty where they are not whole any more.
        fingerprint: of all of them while they are whole: who has another one has only some of their episodes.
    """

    ends: IntArray
    weights: npt.NDArray[np.float64]
    sources: tuple[EpisodeFrames, ...]
    fingerprint: str

    def of(self, starts: IntArray) -> IntArray:
        """The set of each episode, (E,), from the episodes' first rows."""
        found: IntArray = np.searchsorted(self.ends, starts, side="right").astype(np.int64)
        return found

    def among(self, rows: IntArray) -> Shares:
        """Of some rows, sorted, counted anew."""
        return replace(self, ends=np.searchsorted(rows, self.ends).astype(np.int64), sources=())


def weighted(sources: Sequence[EpisodeFrames], weights: Sequence[float | None]) -> EpisodeFrames:
    """Several data sets as one, each with its own frame cache; without any weight as `concatenate`.

    Raises:
        DataError: as `agree`.
    """
    given = [weight for weight in weights if weight is not None]
    if len(sources) == 1:
        return sources[0]
    if not given:
        return concatenate(sources)
    joined = concatenate(sources, weights=True)
    fingerprint = text_hash(f"{joined.fingerprint}/weights {','.join(f'{weight:g}' for weight in given)}")
    ends = np.cumsum([len(source.frames) for source in sources]).astype(np.int64)
    shares = Shares(ends, np.asarray(given, np.float64), tuple(sources), fingerprint)
    return replace(joined, fingerprint=fingerprint, shares=shares)


def draw_episodes(
    shares: Shares, starts: IntArray, places: IntArray, batch: int, generator: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """Draw a set by its weight, then one of the places in its episodes: episode and place in it, int64 (B,) each. A
    DataError where a set has no place at all."""
    groups = shares.of(starts)
    counts = np.bincount(groups, weights=places, minlength=len(shares.ends)).astype(np.int64)
    if (counts == 0).any():
        number = int(np.flatnonzero(counts == 0)[0])
        raise DataError(
            f"data.root: got no window in set {number + 1} of {len(counts)}, expected at least one in each set with a "
            "weight: leave that set out, shorten the training window or hold out fewer episodes"
        )
    drawn = generator.choice(len(counts), size=batch, p=shares.weights / shares.weights.sum())
    within = generator.integers(0, counts[drawn])
    order = np.argsort(groups, kind="stable")  # the episodes of one set after the other
    cumulative = np.cumsum(places[order])
    wanted = within + (np.cumsum(counts) - counts)[drawn]
    position = np.searchsorted(cumulative, wanted, side="right")
    offset = wanted - (cumulative[position] - places[order][position])
    return order[position].astype(np.int64), offset.astype(np.int64)


def _recorded(root: str) -> list[dict[str, Any]]:
    """`env` of our collections that a data set is of, as plain values."""
    record = read_record(Path(root).expanduser()) or {}
    found = [(entry.get("spec") or {}).get("env") or {} for entry in (record, *(record.get("sources") or ()))]
    return [seen for seen in found if isinstance(seen, dict)]


def _require_view(env: EnvConfig, root: str) -> None:
    """Refuse frames of the task that our collectors recorded by another camera than `env.camera`, by a DataError."""
    for seen in _recorded(root):
        got, expected = seen.get("camera", ""), metaworld.seen_by(str(seen.get("task", "")), env.camera)
        if seen.get("name") == env.name and got != expected:
            known = metaworld.seen_by(env.task, got) == got
            raise DataError(
                f"{root}: got frames recorded with env.camera={got}, expected env.camera={expected}: record them anew"
                + (f", or set env.camera={got} here and wherever the model acts" if known else ", or name others")
            )


def say_unlike(env: EnvConfig, roots: str) -> None:
    """Say where our collectors recorded demonstrations in another of Gymnasium's environments, or varied otherwise."""
    for root in data_roots(roots):
        for seen in (seen for seen in _recorded(root.path) if seen.get("name") == env.name):
            varied = {key: value for key, value in (seen.get("variation") or {}).items() if value and key != "seed"}
            own = {key: value for key, value in to_dict(env.variation).items() if value and key != "seed"}
            for key, got, here in (("env.id", seen.get("id", ""), env.id), ("env.variation", varied, own)):
                if got != here:
                    say_once(f"note: {root.path}: demonstrations of {key}={got or 'off'}, taken for {here or 'off'}")


def say_foreign(env: EnvConfig, source: EpisodeFrames, roots: str) -> None:
    """Say which sets that neither their `robot_type` nor our record knows are taken for recordings of a simulator."""
    from playslot_rl.envs import RECORDED  # with Gymnasium

    if env.name in RECORDED:
        return
    named = data_roots(roots)
    for path, _ in named:
        alone = len(named) == 1 or is_remote(path)
        robot = source.robot if alone else robot_of(read_info(Path(path).expanduser()))
        if not ours(robot) and not any(_recorded(path)):
            got = f"robot_type={robot}" if robot else "no robot_type"
            said = f"note: {path}: got {got} and no record of ours, taken for recordings of env={env.name}"
            say_once(f"{said}: if they are a robot's own, train its slots, too, with env={VIDEO}")


def open_configured(config: ExperimentConfig, roots: str | Sequence[str | Path]) -> EpisodeFrames:
    """One or several data sets as one, by `env.image_size` and what `data` says of cameras, caches, size and stride.

    `roots` are folders, or a text with commas and weights (`playslot_rl.config.weights`).

    Raises:
        DataError: as `open_sources`; or the sets do not agree, or our collectors recorded one by another camera.
        ConfigError: a weight that is not above 0.
    """
    named = data_roots(roots) if isinstance(roots, str) else [DataRoot(str(root), None) for root in roots]
    if any(root.weight is not None for root in named):
        parts = [open_configured(config, [root.path]) for root in named]
        return weighted(parts, [root.weight for root in named])
    data, size = config.data, config.env.image_size
    paths = [root.path for root in named]
    for path in paths:
        _require_view(config.env, path)
    buffer = data.shuffle_buffer if data.stream else None
    source = open_sources(paths, data.camera, Cache.of(data), image_size=size, resize=data.resize, buffer=buffer)
    return every(source, data.stride, data.stride_action)
