"""Episodes from TorchRL's collector, each with a seed of its own: policies, seeded environments, the collector.

The policies' random numbers are functions of an episode's seed and step, so that it is the same in any process.

Shapes: T agent steps, A action dim, S proprioception, H W image height and width.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, Final

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector

from playslot_rl import keys
from playslot_rl.collectors.journal import CollectionSpec, RecordedEpisode
from playslot_rl.envs import make_env, task_env
from playslot_rl.envs.torchrl import TensorView, View, wrap
from playslot_rl.errors import ConfigError
from playslot_rl.seeds.episodes import redraw_stride

EPISODE_INDEX: Final = "episode_index"
REDRAWN: Final = "redrawn"
EPISODE_SEED: Final = "episode_seed"  # seed of the running episode: int64 (1,)
EPISODE_STEP: Final = "episode_step"  # agent steps since its reset: int64 (1,)
POLICY_STREAM: Final = 2  # spawn key of the policy's random numbers; the environment uses 0 and 1 of the same seed
MAX_REDRAWS: Final = 20


class CollectionPolicy(nn.Module):
    """Uniform actions in [-1, 1], or the expert's, with Gaussian noise of that deviation, clipped to [-1, 1]."""

    def __init__(self, name: str, noise: float = 0.0) -> None:
        super().__init__()
        self.name, self.noise = name, noise

    def forward(self, expert: Tensor, seed: Tensor, step: Tensor) -> Tensor:
        """Action float32 (A,) from the expert's (A,), the episode's seed (1,) and its step (1,)."""
        rng = np.random.default_rng(np.random.SeedSequence(int(seed), spawn_key=(POLICY_STREAM, int(step))))
        width = expert.shape[-1]
        if self.name == "random":
            return torch.from_numpy(rng.uniform(-1.0, 1.0, width).astype(np.float32))
        if self.noise == 0.0:
            return expert.clamp(-1.0, 1.0)  # as a step executes it
        noise = rng.normal(0.0, self.noise, width).astype(np.float32)
        return (expert + torch.from_numpy(noise)).clamp(-1.0, 1.0)


def make_policy(spec: CollectionSpec) -> TensorDictModule:
    """A collection's policy: reads `keys.EXPERT_ACTION`, `EPISODE_SEED`, `EPISODE_STEP` and writes `keys.ACTION`."""
    reads = [keys.EXPERT_ACTION, EPISODE_SEED, EPISODE_STEP]
    return TensorDictModule(CollectionPolicy(spec.policy, spec.noise), in_keys=reads, out_keys=[keys.ACTION])


class SeededView(TensorView):
    """A task that runs the episodes it is given, one per reset, and idles where there is none.

    A reset before the running episode's end starts it again. TorchRL resets more often than there are episodes (when it
    looks at the environment, and after an episode's last step): a reset without a job touches neither the simulator nor
    the renderer, and its observation is all zeros. `jobs` are places in the collection and seeds of episodes that have
    not been started, `turns` those of `EnvConfig`; `asks` says whether an expert's actions are read.
    """

    def __init__(
        self, env: gym.Env[Any, Any], jobs: Sequence[tuple[int, int]] = (), turns: int = 1, asks: bool = True
    ) -> None:
        counter = gym.spaces.Box(0, 2**62, (1,), np.int64)
        counters = dict.fromkeys((EPISODE_INDEX, EPISODE_SEED, EPISODE_STEP, REDRAWN), counter)
        super().__init__(env, {keys.EXPERT_ACTION: env.action_space, **counters})
        self.jobs, self.turns, self.asks = deque(jobs), turns, asks
        self._running: tuple[int, int] | None = None
        self._episode_seed = self._redrawn = self._step = 0

    def view(self, observation: dict[str, npt.NDArray[Any]], info: dict[str, Any]) -> View:
        """One observation, the expert's action for it (zeros where none is asked), and which episode it belongs to."""
        space = self.action_space
        shown = task_env(self.env).expert_action() if self.asks else np.zeros(space.shape or (), space.dtype)
        if np.shape(shown) != space.shape or not np.isfinite(shown).all():
            raise ConfigError(
                f"env: got {shown!r} from the task's expert_action, expected {space.shape} finite numbers: mend it"
            )
        return {
            **super().view(observation, info),
            keys.EXPERT_ACTION: shown,
            EPISODE_INDEX: np.array([self._running[0] if self._running else 0], np.int64),
            EPISODE_SEED: np.array([self._episode_seed], np.int64),
            EPISODE_STEP: np.array([self._step], np.int64),
            REDRAWN: np.array([self._redrawn], np.int64),
        }

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[View, dict[str, Any]]:
        """Start the next job at the first seed that does not start solved (a ConfigError where there is none); the
        arguments are ignored."""
        del seed, options
        if self._running is None:
            if not self.jobs:
                spaces = self.observation_space.spaces  # type: ignore[attr-defined]
                return {name: np.zeros(space.shape, space.dtype) for name, space in spaces.items()}, {"success": False}
            self._running = self.jobs.popleft()
        first, self._step = self._running[1], 0
        for attempt in range(MAX_REDRAWS):
            self._episode_seed, self._redrawn = first + attempt * redraw_stride(first, self.turns), attempt
            observation, info = self.env.reset(seed=self._episode_seed)
            if not info["success"]:
                return self.view(observation, info), info
        self._running = None
        raise ConfigError(
            f"env: got {MAX_REDRAWS} episodes in a row that start solved (seed {first}), expected unsolved starts; "
            "lower env.warmup_steps"
        )

    def step(self, action: npt.NDArray[np.float32]) -> tuple[View, Any, bool, bool, dict[str, Any]]:
        self._step += 1
        result = super().step(action)
        if result[2] or result[3]:
            self._running = None
        return result


class EpisodeCollector(Collector):
    """TorchRL's collector, whose batches (T,) are the one whole episode that it is asked for."""

    def __init__(self, spec: CollectionSpec) -> None:
        env, asks = make_env(spec.env, spec.render), spec.policy != "random"
        self._spec, self._view = spec, SeededView(env, turns=spec.env.turns, asks=asks)
        super().__init__(
            wrap(self._view),
            make_policy(spec),
            total_frames=-1,
            frames_per_batch=spec.steps,
            reset_at_each_iter=True,
            split_trajs=False,
            trust_policy=True,
            traj_format=None,
            auto_register_policy_transforms=False,
        )

    def record(self, index: int) -> RecordedEpisode:
        """Record episode `index` of the collection.

        Raises:
            RenderError: there is no working GL backend.
            ConfigError: every draw of the episode starts solved.
        """
        self._view.jobs.append((index, self._spec.episode_seed(index)))
        return _episode(self.next())


def _episode(batch: TensorDictBase) -> RecordedEpisode:
    """The episode in a batch of shape (T,)."""
    last = batch[-1]["next"]
    steps = batch[EPISODE_STEP].flatten().tolist()
    if steps != list(range(len(steps))) or not bool(last["done"]):
        raise RuntimeError(f"a collector's batch is not one whole episode: its steps are {steps}")
    frames = np.concatenate([batch[keys.PIXELS].numpy(), last[keys.PIXELS].numpy()[None]])
    return RecordedEpisode(
        index=int(batch[0][EPISODE_INDEX]),
        seed=int(batch[0][EPISODE_SEED]),
        redrawn=int(batch[0][REDRAWN]),
        frames=np.ascontiguousarray(frames.transpose(0, 2, 3, 1)),
        states=np.concatenate([batch[keys.STATE].numpy(), last[keys.STATE].numpy()[None]]),
        actions=batch[keys.ACTION].numpy().copy(),
        rewards=batch["next", "reward"].numpy()[:, 0].copy(),
        success=batch["next", keys.SUCCESS].numpy()[:, 0].copy(),
    )


def record(spec: CollectionSpec, indices: Sequence[int]) -> Iterator[RecordedEpisode]:
    """Record the episodes `indices` of a collection in this process; errors of `EpisodeCollector.record`."""
    collector = EpisodeCollector(spec)
    try:
        for index in indices:
            yield collector.record(index)
    finally:
        collector.shutdown()
