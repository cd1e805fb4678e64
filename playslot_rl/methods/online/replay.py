"""The replay: whole episodes on TorchRL's buffers, sampled as sequences.

Shapes: n episodes of L frames (`env.max_steps` + 1), B sequences of T frames, A action dim.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from typing import Final

import torch
from tensordict import TensorDict, TensorDictBase

from playslot_rl import keys
from playslot_rl.errors import ConfigError
from playslot_rl.methods.online.config import OnlineConfig

STREAM: Final = "stream"
"""Zero everywhere: to the sampler all episodes are one trajectory, and sequences run across them."""


class Replay:
    """A ring of the latest episodes.

    Every frame comes with `keys.ACTION` and `keys.REWARD`, of the step that led to it (the reward as the task gave it;
    `sample` multiplies it by `reward_scale`), and `keys.IS_FIRST` and `keys.IS_LAST`. A sequence no longer than an
    episode lies within one; a longer one runs on into the next episode, with its `IS_FIRST`.

    Attributes:
        capacity: episodes it holds.

    Raises:
        ConfigError: the capacity is less than one sequence or one episode.
    """

    def __init__(self, config: OnlineConfig, episode_frames: int) -> None:
        from torchrl.data import LazyMemmapStorage, LazyTensorStorage, SliceSampler, TensorDictReplayBuffer

        self.batch_size, self.sequence = config.batch_size, config.sequence or episode_frames
        self.reward_scale = config.reward_scale
        self.episode_frames, self.capacity = episode_frames, config.capacity // episode_frames
        if self.capacity * episode_frames < max(self.sequence, episode_frames):
            need = max(self.sequence, episode_frames) + episode_frames
            raise ConfigError(f"capacity: got {config.capacity} frames, expected at least {need}: raise it")
        rows = self.capacity * episode_frames
        within = self.sequence <= episode_frames
        self._buffer = TensorDictReplayBuffer(
            storage=LazyMemmapStorage(rows) if config.replay_on_disk else LazyTensorStorage(rows),
            # The flags of the replay stay as they are: a sequence that starts within an episode is no first frame.
            sampler=SliceSampler(
                slice_len=self.sequence,
                traj_key=keys.EPISODE if within else STREAM,
                truncated_key=None,
                init_key=None,
                cache_values=True,
            ),
            batch_size=self.batch_size * self.sequence,
        )
        self.episodes = 0

    def __len__(self) -> int:
        """Frames it holds."""
        return len(self._buffer)

    @property
    def ready(self) -> bool:
        return len(self) >= self.sequence

    def add(self, episodes: TensorDictBase) -> None:
        """Append episodes, batch size [n, L]; the oldest make room."""
        n, frames = episodes.batch_size
        if n == 0:
            return
        if frames != self.episode_frames:
            raise ValueError(f"replay: got episodes of {frames} frames, expected {self.episode_frames}")
        number = torch.arange(self.episodes, self.episodes + n).unsqueeze(-1).expand(n, frames)
        rows = episodes.clone(recurse=False).set(keys.EPISODE, number.contiguous())
        with _quiet():
            self._buffer.extend(rows.set(STREAM, torch.zeros_like(number)).reshape(-1))
        self.episodes += n

    def restore(self, episodes: TensorDictBase, total: int) -> None:
        """Fill an empty replay as it was after `total` episodes, bit for bit, from at least the last
        min(`total`, `capacity`) of them, in order, batch size [m, L].
        """
        kept = episodes[-min(total, self.capacity) :]
        first = total - len(kept)
        if first == 0:
            self.add(kept)
            return
        # The ring was full: slot by slot from its start, then once more up to where its next episode goes.
        split = -first % self.capacity
        for start, part in ((first + split, kept[split:]), (first, kept[:split]), (first + split, kept[split:])):
            self.episodes = start
            self.add(part)

    def sample(self, generator: torch.Generator) -> TensorDict:
        """Draw sequences, batch size [B, T]: an episode (or the whole ring) at random, a start in it at random."""
        self._buffer.set_rng(generator)
        flat = self._buffer.sample().exclude("index", STREAM)
        batch: TensorDict = flat.reshape(self.batch_size, self.sequence)
        return batch.set(keys.REWARD, batch.get(keys.REWARD) * self.reward_scale)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    logger = logging.getLogger("torchrl")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)
