"""Episodes from TorchRL's collectors, each with a seed of its own.

Shapes: T agent steps, A action dim, S proprioception, H W image height and width.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from tensordict import TensorDictBase
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import EnvBase

from playslot_rl import keys
from playslot_rl.collectors.policies import EPISODE_SEED, EPISODE_STEP, EXPERT_ACTION, make_policy
from playslot_rl.collectors.spec import CollectionSpec, redraw
from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.envs import make_env, task_env
from playslot_rl.envs.rendering import check_rendering
from playslot_rl.envs.torchrl import TensorView, View, wrap
from playslot_rl.errors import ConfigError, PlaySlotError

EPISODE_INDEX = "episode_index"
REDRAWN = "redrawn"
MAX_REDRAWS = 20
PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Episode:
    """One recorded episode.

    Attributes:
        index: its place in the collection.
        seed: the seed it ran with.
        redrawn: seeds passed over because the episode started solved.
        frames: uint8 [0, 255] (T + 1, H, W, 3).
        states: float32 (T + 1, S).
        actions: float32 (T, A) in [-1, 1].
        rewards: float32 (T,).
        success: bool (T,): whether the agent step solved the task.
    """

    index: int
    seed: int
    redrawn: int
    frames: npt.NDArray[np.uint8]
    states: npt.NDArray[np.float32]
    actions: npt.NDArray[np.float32]
    rewards: npt.NDArray[np.float32]
    success: npt.NDArray[np.bool_]


class SeededView(TensorView):
    """A task that runs a fixed list of episodes, one per reset.

    A reset before the running episode's end starts it again: TorchRL resets more often than there are episodes. After
    the last episode the last one is repeated.

    Args:
        env: the task.
        jobs: (index, seed) of each episode.
    """

    def __init__(self, env: gym.Env[Any, Any], jobs: Sequence[tuple[int, int]]) -> None:
        super().__init__(env)
        self._jobs, self._next = list(jobs), 0
        self._index = self._episode_seed = self._redrawn = self._step = 0
        counter = gym.spaces.Box(0, 2**62, (1,), np.int64)
        self.declare(
            {
                EXPERT_ACTION: env.action_space,
                **dict.fromkeys((EPISODE_INDEX, EPISODE_SEED, EPISODE_STEP, REDRAWN), counter),
            }
        )

    def view(self, observation: dict[str, npt.NDArray[Any]], info: dict[str, Any]) -> View:
        """One observation, the expert's action for it, and which episode it belongs to."""
        return {
            **super().view(observation, info),
            EXPERT_ACTION: task_env(self.env).expert_action(),
            EPISODE_INDEX: np.array([self._index], np.int64),
            EPISODE_SEED: np.array([self._episode_seed], np.int64),
            EPISODE_STEP: np.array([self._step], np.int64),
            REDRAWN: np.array([self._redrawn], np.int64),
        }

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[View, dict[str, Any]]:
        """Start the next episode of the list that does not start solved; `seed` and `options` are ignored.

        Raises:
            ConfigError: every draw starts solved.
        """
        del seed, options
        self._index, first = self._jobs[min(self._next, len(self._jobs) - 1)]
        self._step = 0
        for attempt in range(MAX_REDRAWS):
            self._episode_seed, self._redrawn = redraw(first, attempt), attempt
            observation, info = self.env.reset(seed=self._episode_seed)
            if not info["success"]:
                return self.view(observation, info), info
        raise ConfigError(
            f"env: got {MAX_REDRAWS} episodes in a row that start solved (seed {first}), expected unsolved starts; "
            "lower env.warmup_steps"
        )

    def step(self, action: npt.NDArray[np.float32]) -> tuple[View, Any, bool, bool, dict[str, Any]]:
        """Gymnasium's step."""
        self._step += 1
        observation, reward, terminated, truncated, info = self.env.step(action)
        result = self.view(observation, info), reward, terminated, truncated, info
        if terminated or truncated:
            self._next += 1
        return result


def make_seeded_env(env: EnvConfig, render: RenderConfig, jobs: Sequence[tuple[int, int]]) -> EnvBase:
    """A worker's environment."""
    return wrap(SeededView(make_env(env, render), jobs))


def start_worker() -> None:
    """Run first in a worker process: leave Ctrl-C to the parent, die with it, use one core."""
    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() == 1:  # the parent died before the line above
            os._exit(1)


def _make_collector(spec: CollectionSpec, jobs: Sequence[tuple[int, int]], workers: int) -> Any:
    """A collector whose batches are one whole episode of each worker: (T,) for one worker, else (workers, T)."""
    makers = [partial(make_seeded_env, spec.env, spec.render, jobs[w::workers]) for w in range(workers)]
    policy = make_policy(spec.policy, spec.noise)
    common: dict[str, Any] = {
        "frames_per_batch": spec.steps * workers,
        "total_frames": -1,
        "split_trajs": False,
        "trust_policy": True,
        "traj_format": None,
        "auto_register_policy_transforms": False,
    }
    if workers == 1:
        return Collector(makers[0], policy, **common)
    return MultiSyncCollector(makers, policy, cat_results="stack", init_fn=start_worker, **common)


def _episode(batch: TensorDictBase) -> Episode:
    """The episode in a batch of shape (T,)."""
    last = batch[-1]["next"]
    steps = batch[EPISODE_STEP].flatten().tolist()
    if steps != list(range(len(steps))) or not bool(last["done"]):
        raise RuntimeError(f"a collector's batch is not one whole episode: its steps are {steps}")
    frames = np.concatenate([batch[keys.PIXELS].numpy(), last[keys.PIXELS].numpy()[None]])
    return Episode(
        index=int(batch[0][EPISODE_INDEX]),
        seed=int(batch[0][EPISODE_SEED]),
        redrawn=int(batch[0][REDRAWN]),
        frames=np.ascontiguousarray(frames.transpose(0, 2, 3, 1)),
        states=np.concatenate([batch[keys.STATE].numpy(), last[keys.STATE].numpy()[None]]),
        actions=batch[keys.ACTION].numpy().copy(),
        rewards=batch["next", "reward"].numpy()[:, 0].copy(),
        success=batch["next", keys.SUCCESS].numpy()[:, 0].copy(),
    )


def record(spec: CollectionSpec, indices: Sequence[int], workers: int) -> Iterator[Episode]:
    """Record the episodes `indices` of a collection.

    Args:
        spec: the collection.
        indices: which of its episodes.
        workers: processes; 1 runs in this one. The episodes do not depend on it, only their order does.

    Yields:
        Each episode once, as soon as it is there.

    Raises:
        RenderError: there is no working GL backend.
        ConfigError: every draw of an episode starts solved.
        PlaySlotError: a worker process died.
    """
    wanted = set(indices)
    workers = max(1, min(workers, len(wanted)))
    if not wanted:
        return
    if workers > 1:
        check_rendering()  # a missing GL backend is one line here, many in the workers
    collector = _make_collector(spec, [(i, spec.episode_seed(i)) for i in sorted(wanted)], workers)
    try:
        batches = iter(collector)
        while wanted:
            try:
                batch = next(batches)
            except RuntimeError as error:
                if workers == 1:
                    raise
                raise PlaySlotError(
                    f"a collector process died ({error}); run the same command again to go on"
                ) from error
            for row in [batch] if workers == 1 else batch.unbind(0):
                episode = _episode(row)
                if episode.index in wanted:
                    wanted.discard(episode.index)
                    yield episode
    finally:
        with contextlib.suppress(Exception):  # must not hide what ended the collection
            collector.shutdown()
