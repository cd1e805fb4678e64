"""The replay, whole episodes on TorchRL's buffers, sampled as sequences; and checkpoints of learning by acting:
modules, optimisers, counters, and a journal of the replay.

    RUN/METHOD/checkpoints/step_XXXXXXXX   modules.safetensors, optimizers.safetensors, state.json (newest two)
    RUN/METHOD/replay/XXXXXXXX.safetensors the episodes from number X on that came since the last checkpoint

Frames are most of it, so the journal is only appended to; its file is on the disk before the checkpoint that counts it.

Shapes: n episodes of L frames (`env.max_steps` + 1), B sequences of T frames, A action dim.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Final

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.methods.online.config import OnlineConfig
from playslot_rl.runtime.progress import quiet
from playslot_rl.storage.resume import KEPT, TrainingCheckpoints, optimizer_tensors, restore_optimizer
from playslot_rl.storage.tensors import load_modules, load_tensors, module_tensors, save_tensors

STREAM: Final = "stream"
"""Zero everywhere: to the sampler all episodes are one trajectory, and sequences run across them."""


class Replay:
    """A ring of the latest `capacity` episodes; a ConfigError where that is less than one sequence or one episode.

    Every frame comes with `keys.ACTION` and `keys.REWARD`, of the step that led to it (the reward as the task gave it;
    `sample` multiplies it by `reward_scale`), and `keys.IS_FIRST` and `keys.IS_LAST`. Sequences run on into the next
    episode, with its `IS_FIRST`, but for whole episodes, and those no longer than one where `config.within_episode`.
    Its files are in the folder `ring`, which is not there yet; None keeps it in memory.
    """

    def __init__(self, config: OnlineConfig, episode_frames: int, ring: Path | None = None) -> None:
        from torchrl.data import LazyMemmapStorage, LazyTensorStorage, SliceSampler, TensorDictReplayBuffer

        self.batch_size, self.sequence = config.batch_size, config.sequence or episode_frames
        self.reward_scale = config.reward_scale
        self.episode_frames, self.capacity = episode_frames, config.capacity // episode_frames
        if self.capacity * episode_frames < max(self.sequence, episode_frames):
            need = max(self.sequence, episode_frames) + episode_frames
            raise ConfigError(f"capacity: got {config.capacity} frames, expected at least {need}: raise it")
        rows = self.capacity * episode_frames
        within = config.sequence == 0 or (config.within_episode and self.sequence <= episode_frames)
        self._buffer = TensorDictReplayBuffer(
            # Without a folder its files would lie in /dev/shm, which is memory.
            storage=LazyTensorStorage(rows) if ring is None else LazyMemmapStorage(rows, scratch_dir=ring),
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
        with quiet("torchrl", logging.WARNING):
            self._buffer.extend(rows.set(STREAM, torch.zeros_like(number)).reshape(-1))
        self.episodes += n

    def restore(self, parts: Iterable[tuple[int, TensorDictBase]], total: int) -> None:
        """Fill an empty replay as it was after `total` episodes, bit for bit, from at least the last
        min(`total`, `capacity`) of them, in order: parts, the number of their first and batch size [m, L].
        """
        self.episodes = max(total - self.capacity, 0)  # the ring's next slot is that of its oldest episode
        self._buffer.writer.load_state_dict({"_cursor": self.episodes % self.capacity * self.episode_frames})
        for first, part in parts:
            self.add(part[max(self.episodes - first, 0) :])

    def sample(self, generator: torch.Generator) -> TensorDict:
        """Draw sequences, batch size [B, T]: an episode (or the whole ring) at random, a start in it at random."""
        self._buffer.set_rng(generator)
        flat = self._buffer.sample().exclude("index", STREAM)
        batch: TensorDict = flat.reshape(self.batch_size, self.sequence)
        return batch.set(keys.REWARD, batch.get(keys.REWARD) * self.reward_scale)


@dataclass(frozen=True)
class OnlineState:
    """Where a run stands, at the end of a round.

    Attributes:
        step: agent steps taken.
        rounds: rounds of episodes.
        episodes: episodes in the replay's history.
        updates: optimiser updates.
        ratio_from: progress of the schedule of updates; None before the first.
        seconds: wall-clock seconds over all processes.
        metrics: the last point of the learning curve.
        curve: all points.
        random: the random policy's point.
        ahead: of a round that workers have played ahead (`playslot_rl.methods.online.players`): `returns` and
            `successes`. Its frames lie in the checkpoint.
    """

    step: int = 0
    rounds: int = 0
    episodes: int = 0
    updates: int = 0
    ratio_from: float | None = None
    seconds: float = 0.0
    metrics: dict[str, float] = field(default_factory=dict)
    curve: list[dict[str, Any]] = field(default_factory=list)
    random: dict[str, Any] = field(default_factory=dict)
    ahead: dict[str, Any] = field(default_factory=dict)


def whole_episodes(tensors: Mapping[str, Tensor]) -> TensorDict:
    """Tensors (n, L, ...) of one round as a TensorDict of batch size [n, L]."""
    return TensorDict(dict(tensors), next(iter(tensors.values())).shape[:2])


class ReplayJournal:
    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def files(self) -> list[tuple[int, Path]]:
        return sorted((int(path.stem), path) for path in self.folder.glob("[0-9]*.safetensors"))

    def append(self, first: int, episodes: TensorDictBase) -> None:
        """Write episodes `first`, `first` + 1, ...; batch size [n, L]."""
        tensors = {str(key): value for key, value in episodes.items()}
        save_tensors(self.folder / f"{first:08d}.safetensors", tensors)

    def rewind(self, total: int) -> None:
        """Remove what came after the checkpoint that counts `total` episodes, and what a kill left."""
        for leftover in self.folder.glob(".*.tmp-*"):
            leftover.unlink()
        for first, path in self.files():
            if first >= total:
                path.unlink()

    def forget(self, before: int) -> None:
        """Remove files with none but episodes before number `before`."""
        starts = self.files()
        for (_, path), (following, _) in itertools.pairwise(starts):
            if following <= before:
                path.unlink()

    def read(self, total: int, capacity: int) -> Iterator[tuple[int, TensorDict]]:
        """At least the last `capacity` episodes up to `total`, a file at a time: the number of its first, and batch
        size [m, L]. A CheckpointError where a file is missing or damaged.
        """
        files = self.files()
        found = min(files[0][0], max(total - capacity, 0)) if files else 0
        for first, path in files:
            if first == found:
                part = whole_episodes(load_tensors(path))
                found += len(part)
                yield first, part
        if found != total:
            raise CheckpointError(
                f"{self.folder}: got episodes up to {found}, expected {total}: "
                f"delete {self.folder.parent} to start anew"
            )


class OnlineCheckpoints(TrainingCheckpoints):
    def __init__(self, folder: Path, identity: Mapping[str, Any], typed: Callable[[str], str] = str) -> None:
        super().__init__(folder / "checkpoints", identity, typed)
        self.journal = ReplayJournal(folder / "replay")
        self._counted: list[int] = []

    def save_online(
        self,
        state: OnlineState,
        modules: Mapping[str, nn.Module],
        optimizers: Mapping[str, torch.optim.Optimizer],
        new: TensorDictBase | None,
        capacity: int,
        ahead: TensorDictBase | None = None,
    ) -> Path:
        """Write a checkpoint, and the episodes that came since the last one: `new`, batch size [n, L], the last of them
        number `state.episodes` - 1. `capacity` is the replay's, `ahead` the episodes of `state.ahead` [m, L]. An
        OutputError where the disk is full; the earlier checkpoints stay.
        """
        if new is not None:
            self.journal.append(state.episodes - len(new), new)
        stored = {
            f"{name}/{key}": value
            for name, optimizer in optimizers.items()
            for key, value in optimizer_tensors(optimizer).items()
        }
        tensors = {"modules": module_tensors(modules), "optimizers": stored}
        if ahead is not None:
            tensors["ahead"] = {str(key): value for key, value in ahead.items()}
        final = self._write(state.step, tensors, asdict(state))
        # Both checkpoints that are kept must find their episodes.
        self._counted = [*self._counted, state.episodes][-KEPT:]
        self.journal.forget(self._counted[0] - capacity)
        return final

    def ahead(self) -> TensorDict:
        """The frames of `OnlineState.ahead`, of the newest checkpoint, batch size [m, L]."""
        last = self.last()
        assert last is not None
        return whole_episodes(load_tensors(last / "ahead.safetensors"))

    def resume_online(
        self, modules: Mapping[str, nn.Module], optimizers: Mapping[str, torch.optim.Optimizer], replay: Replay
    ) -> OnlineState:
        """Load the newest checkpoint and fill the replay; a fresh state if there is none. A CheckpointError where the
        config differs from the stored one, or something is damaged; an OutputError where a file stands in the folder's
        place.
        """
        newest = self._newest()
        if newest is None:
            self.journal.rewind(0)
            return OnlineState()
        last, stored = newest
        load_modules(modules, load_tensors(last / "modules.safetensors"), str(last))
        tensors = load_tensors(last / "optimizers.safetensors")
        for name, optimizer in optimizers.items():
            own = {key.removeprefix(f"{name}/"): value for key, value in tensors.items() if key.startswith(f"{name}/")}
            restore_optimizer(optimizer, own, str(last))
        state = OnlineState(**{item.name: stored[item.name] for item in fields(OnlineState) if item.name in stored})
        self.journal.rewind(state.episodes)
        replay.restore(self.journal.read(state.episodes, replay.capacity), state.episodes)
        self._counted = [state.episodes]
        return state
