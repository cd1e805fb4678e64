"""Frames read and drawn, each fast and as the libraries do it.

Reading: frame cache and `sample_windows` against `LeRobotDataset` and `DataLoader`; both give batches of float32 frames
(B, T, 3, H, W) in [0, 1] of random windows of the same small data set. Drawing: the fast path against MuJoCo's default
off-screen settings, same scene, same process.
"""

from __future__ import annotations

import contextlib
import itertools
import tempfile
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from torch import Tensor

from playslot_rl import keys
from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.data.source import open_source
from playslot_rl.data.windows import Clips, sample_windows
from playslot_rl.frames import normalise
from playslot_rl.runtime.progress import quiet_datasets
from playslot_rl.runtime.threads import available_cores
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.speed.cases import Sizes

_FPS = 10


def sampling_rates(sizes: Sizes) -> dict[str, float]:
    """Frames a second: `cache`, `stream` (the shuffle buffer holds a quarter of the set), and `lerobot` with as many
    DataLoader workers as there are cores.

    The repeats take turns. Building the cache, which happens once per data set, and starting the workers are not
    counted; the workers end with their turn, so that none reads ahead while the cache is timed.
    """
    rates: dict[str, list[float]] = {"lerobot": [], "stream": [], "cache": []}
    frames = sizes.window_batch * sizes.window
    with tempfile.TemporaryDirectory(prefix="playslot-bench-") as folder, quiet_datasets():
        root = write_dataset(Path(folder) / "data", sizes)
        source, generator = open_source(root, cache=Path(folder) / "cache"), np.random.default_rng(0)

        def cached() -> Tensor:
            """A batch as the training stages read it, as floats."""
            rows = sample_windows(source.starts, source.lengths, sizes.window, sizes.window_batch, generator)
            return normalise(source.pixels(rows))

        streamed = open_source(root, cache=Path(folder) / "cache", buffer=len(source.frames) // 4)
        clips, steps = Clips(streamed, sizes.window, 0.0, 0), itertools.count()

        def decoded() -> Tensor:
            """The same from the data set's files, decoded as they are read."""
            rows = clips.sample(sizes.window_batch, StepGenerators(0, next(steps)).numpy("windows"))
            return normalise(streamed.pixels(rows))

        for _ in range(sizes.repeats + 1):
            rates["cache"].append(frames / _seconds(cached, sizes.cache_batches, sizes))
            rates["stream"].append(frames / _seconds(decoded, sizes.loader_batches * 4, sizes))
            with contextlib.closing(lerobot_batches(root, sizes)) as batches:
                for _ in range(2 * available_cores()):  # what the workers read ahead while they start
                    next(batches)
                rates["lerobot"].append(frames / _seconds(partial(next, batches), sizes.loader_batches, sizes))
    return {name: median(found[1:]) for name, found in rates.items()}


def _seconds(read: Callable[[], Tensor], batches: int, sizes: Sizes) -> float:
    """Seconds a batch."""
    expected = (sizes.window_batch, sizes.window, 3, sizes.image_size, sizes.image_size)
    begin = time.perf_counter()
    for _ in range(batches):
        batch = read()
        assert tuple(batch.shape) == expected, f"got {tuple(batch.shape)}, expected {expected}"
    return (time.perf_counter() - begin) / batches


def write_dataset(root: Path, sizes: Sizes) -> Path:
    """A LeRobot v3.0 data set of `image` frames, as the collectors store them: smooth shapes with a little noise."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    side, generator = sizes.image_size, np.random.default_rng(0)
    feature = {"dtype": "image", "shape": (side, side, 3), "names": ["height", "width", "channels"]}
    dataset: Any = LeRobotDataset.create(
        "playslot/bench",
        fps=_FPS,
        features={keys.FEATURE_IMAGE: feature},
        root=root,
        use_videos=False,
        video_backend="pyav",
    )
    for _ in range(sizes.episodes):
        coarse = generator.integers(0, 250, (sizes.episode_frames, side // 8, side // 8, 3))
        frames = coarse.repeat(8, axis=1).repeat(8, axis=2) + generator.integers(0, 4, (side, side, 3))
        for frame in frames.astype(np.uint8):
            dataset.add_frame({keys.FEATURE_IMAGE: frame, "task": "bench"})
        dataset.save_episode()
    dataset.finalize()
    return root


def lerobot_batches(root: Path, sizes: Sizes) -> Generator[Tensor]:
    """Batches as LeRobot's own training reads them, for ever."""
    import torch
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from torch.utils.data import DataLoader, RandomSampler

    offsets = {keys.FEATURE_IMAGE: [t / _FPS for t in range(sizes.window)]}
    # pyav although there is no video: without it LeRobot tries torchcodec and prints why that does not load.
    dataset: Any = LeRobotDataset("playslot/bench", root=root, delta_timestamps=offsets, video_backend="pyav")
    sampler = RandomSampler(
        dataset, replacement=True, num_samples=1_000_000_000, generator=torch.Generator().manual_seed(0)
    )
    loader: Any = DataLoader(
        dataset,
        batch_size=sizes.window_batch,
        sampler=sampler,
        num_workers=available_cores(),
        multiprocessing_context="fork",
    )
    for batch in loader:
        yield batch[keys.FEATURE_IMAGE]


def render_seconds(config: EnvConfig, sizes: Sizes) -> dict[str, float]:
    """Median seconds a frame of a task, `full` and `fast`; the repeats take turns.

    Raises:
        RenderError: there is no working GL backend.
    """
    from playslot_rl.envs import make_env

    frames = {"full": sizes.full_frames, "fast": sizes.fast_frames}
    seconds: dict[str, list[float]] = {name: [] for name in frames}
    with ExitStack() as stack:
        tasks: dict[str, Any] = {}
        for name in frames:
            tasks[name] = make_env(config, RenderConfig(quality="full" if name == "full" else "fast")).unwrapped
            stack.callback(tasks[name].close)
            tasks[name].reset(seed=0)
        for _ in range(sizes.repeats + 1):
            for name, count in frames.items():
                begin = time.perf_counter()
                for _ in range(count):
                    tasks[name].draw()
                seconds[name].append((time.perf_counter() - begin) / count)
    return {name: median(times[1:]) for name, times in seconds.items()}
