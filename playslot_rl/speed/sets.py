"""What is done to whole data sets: export from the journal, verify, parse into the slot cache.

The recorded episodes are smooth shapes with a little noise, as `speed/frames.py` stores them; nothing is simulated.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np

from playslot_rl.collectors.export import export
from playslot_rl.collectors.journal import Journal, RecordedEpisode
from playslot_rl.collectors.spec import CollectionSpec
from playslot_rl.config import EnvConfig, ExperimentConfig
from playslot_rl.data.slot_cache import parse_episodes
from playslot_rl.data.source import open_source
from playslot_rl.datasets.verify import verify
from playslot_rl.errors import DataError
from playslot_rl.speed.cases import Sizes, Variant, build_savi


def set_rates(sizes: Sizes) -> dict[str, float]:
    """Episodes a second of `export` and `verify`, frames a second of `slot_cache`.

    An export is what `playslot collect` does once all episodes are in the journal: writing and reading back.

    Raises:
        DataError: what was exported is not sound.
    """
    seconds: dict[str, list[float]] = {"export": [], "verify": [], "slot_cache": []}
    with tempfile.TemporaryDirectory(prefix="playslot-bench-") as folder:
        journal = write_journal(Path(folder) / "journal", sizes)
        savi = build_savi(Variant("savi_step", precision="fp32", channels_last=False), sizes)
        for number in range(sizes.repeats + 1):
            root, begin = Path(folder) / f"set-{number}", time.perf_counter()
            export(journal, root)
            seconds["export"].append(time.perf_counter() - begin)
            begin = time.perf_counter()
            found = verify(root)
            seconds["verify"].append(time.perf_counter() - begin)
            if not found.ok:
                raise DataError(f"bench: got a data set with {found.errors[0]}, expected a sound one")
            source = open_source(root, cache=Path(folder) / "cache")
            few = replace(source, starts=source.starts[: sizes.parsed], lengths=source.lengths[: sizes.parsed])
            begin = time.perf_counter()
            parsed = sum(len(slots) for slots in parse_episodes(few, savi))
            seconds["slot_cache"].append(time.perf_counter() - begin)
    counts = {"export": sizes.episodes, "verify": sizes.episodes, "slot_cache": parsed}
    return {name: counts[name] / median(times[1:]) for name, times in seconds.items()}


def write_journal(folder: Path, sizes: Sizes) -> Journal:
    """A complete journal."""
    env = replace(EnvConfig(), image_size=sizes.image_size)
    steps, side, generator = sizes.episode_frames - 1, sizes.image_size, np.random.default_rng(0)
    spec = CollectionSpec.make(replace(ExperimentConfig(), env=env), "random", sizes.episodes, steps, 0)
    journal = Journal(folder, spec)
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
