"""Records the episodes of a collection: in this process, or by workers beside it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from playslot_rl.collectors.episodes import EpisodeCollector, record
from playslot_rl.collectors.journal import CollectionSpec, Journal, RecordedEpisode, encode
from playslot_rl.collectors.workers import Call, Workers
from playslot_rl.config import CollectorConfig
from playslot_rl.envs import PROCEDURAL
from playslot_rl.envs.grid_shapes import generate
from playslot_rl.envs.rendering import check_rendering
from playslot_rl.storage.atomic import write_bytes

AHEAD = 2  # episodes in a worker's hands: while it records one, the next is there already
CLIPS_AT_ONCE = 64


def storing(journal: Journal) -> Callable[[int], None]:
    """In a worker of this machine: records an episode and writes its file itself, so that only small messages pass."""
    collector = EpisodeCollector(journal.spec)
    return lambda index: journal.add(collector.record(index))


def encoding(spec: CollectionSpec) -> Callable[[int], bytes]:
    """On a machine of a cluster, which needs a GL backend and no shared disk: an episode encoded, to be stored here."""
    collector = EpisodeCollector(spec)
    return lambda index: encode(collector.record(index))


def record_into(
    journal: Journal,
    indices: Sequence[int],
    workers: int,
    settings: CollectorConfig | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Iterator[int]:
    """Record the episodes `indices` of a journal's collection into it; yields each once, when it is stored.

    Args:
        journal: locked by the caller.
        workers: how many; 1 local one records in this process. The episodes do not depend on it, only their order.

    Raises:
        RenderError: there is no working GL backend.
        ConfigError: every draw of an episode starts solved, or Ray is missing.
        OutputError: full disk.
        PlaySlotError: more workers died or hung than `settings.restarts`.
    """
    settings = settings or CollectorConfig()
    workers = max(1, min(workers, len(indices)))
    if not indices:
        return
    drawn = journal.spec.env.name in PROCEDURAL  # quicker than any pool would start
    if drawn or (settings.backend == "local" and workers == 1):
        for episode in (draw if drawn else record)(journal.spec, indices):
            journal.add(episode)
            yield episode.index
        return
    if settings.backend == "local":
        check_rendering()  # a missing GL backend is one line here, many in the workers

    def replaced(reason: str, calls: Sequence[Call]) -> None:
        names = ", ".join(str(index) for (index,) in calls)
        say(f"a worker {reason}: another takes its place (episodes in hand: {names or 'none'})")

    make = partial(storing, journal) if settings.backend == "local" else partial(encoding, journal.spec)
    pool = Workers(make, workers, settings, replaced)
    try:
        for index, content in _recorded(pool, deque(sorted(set(indices)))):
            if content is not None:
                write_bytes(journal.path(index), content)
            yield index
    finally:
        pool.close()


def _recorded(pool: Workers, waiting: deque[int]) -> Iterator[tuple[int, bytes | None]]:
    while waiting or pool.busy:
        # The last episodes go to whoever is free, not on top of another.
        for depth in range(AHEAD if len(waiting) > len(pool) else 1):
            for number in range(len(pool)):
                if waiting and pool.in_hand(number) <= depth:
                    pool.submit(number, waiting.popleft())
        for (index,), content in pool.answers():
            yield index, content


def draw(spec: CollectionSpec, indices: Sequence[int]) -> Iterator[RecordedEpisode]:
    """Draw the episodes `indices` of an environment without a simulator (GridShapes): no policy, no workers.

    Actions say what the objects did, states where they were; reward and success are zero.
    """
    for first in range(0, len(indices), CLIPS_AT_ONCE):
        some = indices[first : first + CLIPS_AT_ONCE]
        seeds = [spec.episode_seed(index) for index in some]
        clips = generate(seeds, spec.steps, spec.env)
        for number, (index, seed) in enumerate(zip(some, seeds, strict=True)):
            yield RecordedEpisode(
                index=index,
                seed=seed,
                redrawn=0,
                frames=clips.frames[number],
                states=clips.states[number],
                actions=clips.actions[number],
                rewards=np.zeros(spec.steps, np.float32),
                success=np.zeros(spec.steps, np.bool_),
            )
