"""What is timed of data: sets exported, verified, parsed into slots and read as windows; frames drawn.

The recorded episodes are smooth shapes with a little noise; nothing is simulated.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from playslot_rl.collectors.export import export
from playslot_rl.collectors.journal import CollectionSpec, Journal, RecordedEpisode
from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.data.clips import Clips
from playslot_rl.data.slot_cache import parse_episodes
from playslot_rl.data.source import open_sources
from playslot_rl.data.windows import sample_windows
from playslot_rl.datasets.verify import verify
from playslot_rl.envs import make_env
from playslot_rl.errors import DataError
from playslot_rl.frames import normalise
from playslot_rl.modules.savi import SAVi
from playslot_rl.runtime.progress import quiet_datasets
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.speed.cases import Sizes
from playslot_rl.speed.timing import in_turns


def set_rates(sizes: Sizes) -> dict[str, float]:
    """Rates of a data set: episodes a second of `export` and `verify`, frames a second of the rest.

    An export is what `playslot collect` does once all episodes are in the journal: writing and reading back. `cache`
    and `stream` are windows as the training stages read them, from the frame cache and (with a shuffle buffer of a
    quarter of the set) from the files. Building the cache, which happens once a data set, is not counted.

    Raises:
        DataError: what was exported is not sound.
    """
    with tempfile.TemporaryDirectory(prefix="playslot-bench-") as name, quiet_datasets():
        folder, numbers = Path(name), itertools.count()
        journal, root = write_journal(folder / "journal", sizes), folder / "set"
        export(journal, root)
        found = verify(root)
        if not found.ok:
            raise DataError(f"bench: got a data set with {found.errors[0]}, expected a sound one")
        source = open_sources(root, cache=folder / "cache")
        few = replace(source, starts=source.starts[: sizes.parsed], lengths=source.lengths[: sizes.parsed])
        savi = SAVi(sizes.config.model.savi, sizes.config.env.image_size)
        took = in_turns(
            {
                "export": lambda: export(journal, folder / f"set-{next(numbers)}"),
                "verify": lambda: verify(root),
                "slot_cache": lambda: list(parse_episodes(few, savi)),
                **window_readers(root, folder / "cache", sizes),
            },
            sizes.rounds,
        )
    windows = sizes.window_batch * sizes.window
    counts = {"export": sizes.episodes, "verify": sizes.episodes, "slot_cache": int(few.lengths.sum())}
    return {name: counts.get(name, windows) / value for name, value in took.items()}


def window_readers(root: Path, cache: Path, sizes: Sizes) -> dict[str, Callable[[], Tensor]]:
    """What reads a batch of windows, float (B, T, 3, H, W) in [0, 1]."""
    source = open_sources(root, cache=cache)
    streamed = open_sources(root, cache=cache, buffer=len(source.frames) // 4)
    clips, steps, generator = Clips(streamed, sizes.window, 0.0, 0), itertools.count(), np.random.default_rng(0)

    def cached() -> Tensor:
        rows = sample_windows(source.starts, source.lengths, sizes.window, sizes.window_batch, generator)
        return normalise(source.pixels(rows))

    def decoded() -> Tensor:
        rows = clips.sample(sizes.window_batch, StepGenerators(0, next(steps)).numpy("windows"))
        return normalise(streamed.pixels(rows))

    return {"stream": decoded, "cache": cached}


def write_journal(folder: Path, sizes: Sizes) -> Journal:
    """A complete journal."""
    env = EnvConfig(image_size=sizes.config.env.image_size)
    steps, side, generator = sizes.episode_frames - 1, env.image_size, np.random.default_rng(0)
    journal = Journal(folder, CollectionSpec.make(replace(sizes.config, env=env), "random", sizes.episodes, steps, 0))
    for index in range(sizes.episodes):
        coarse = generator.integers(0, 250, (steps + 1, side // 8, side // 8, 3))
        frames = coarse.repeat(8, axis=1).repeat(8, axis=2) + generator.integers(0, 4, (side, side, 3))
        journal.add(
            RecordedEpisode(
                index=index,
                seed=index,
                redrawn=0,
                frames=frames.astype(np.uint8),
                states=generator.random((steps + 1, 4), np.float32),
                actions=generator.uniform(-1, 1, (steps, env.action_dim)).astype(np.float32),
                rewards=np.zeros(steps, np.float32),
                success=np.zeros(steps, bool),
            )
        )
    return journal


def render_seconds(config: EnvConfig, rounds: int) -> dict[str, float]:
    """Seconds a frame of a task, `full` (MuJoCo's default off-screen settings) and `fast`.

    Raises:
        RenderError: there is no working GL backend.
    """
    with ExitStack() as stack:
        draw: dict[str, Callable[[], Any]] = {}
        for name in ("full", "fast"):
            task: Any = make_env(config, RenderConfig(quality="full" if name == "full" else "fast")).unwrapped
            stack.callback(task.close)
            task.reset(seed=0)
            draw[name] = task.draw
        return in_turns(draw, rounds)
