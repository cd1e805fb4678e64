"""Playing episodes in lock-step, for the replay and for the learning curve.

All tasks run for `env.max_steps` agent steps and never end before, so that episodes have equal lengths.

Shapes: n episodes, L = `env.max_steps` + 1 frames, A action dim, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict, TensorDictBase

from playslot_rl import keys
from playslot_rl.acting.episodes import TaskPool, start_episode
from playslot_rl.baselines.online.learner import Learner
from playslot_rl.baselines.online.seeds import REDRAW_STRIDE

RANDOM_STREAM: Final = 7
"""Keeps the random policy's stream apart from the environment's own of the same seed (as in `RandomController`)."""


@dataclass(frozen=True)
class Episodes:
    """Whole episodes.

    Attributes:
        frames: batch size [n, L], on the CPU: the learner's stored keys, `keys.ACTION`, `keys.REWARD`,
            `keys.IS_FIRST`, `keys.IS_LAST`.
        returns: undiscounted sums of rewards, (n,).
        successes: whether a step solved the task.
    """

    frames: TensorDict
    returns: tuple[float, ...]
    successes: tuple[bool, ...]


def play(
    pool: TaskPool,
    seeds: Sequence[int],
    learner: Learner | None,
    device: torch.device,
    generator: torch.Generator,
    *,
    explore: bool = False,
    random: bool = False,
) -> Episodes:
    """Play one episode for each seed.

    Args:
        pool: environments.
        seeds: episode seeds; an episode that starts solved is drawn anew.
        learner: sees every frame; None looks at none (`random` only) and stores none.
        device, generator: the learner's, and of what it draws.
        explore: it samples its actions.
        random: uniform actions in [-1, 1] instead, a function of the episode's seed.
    """
    tasks = pool.take(len(seeds))
    for task in tasks:
        task.draw_steps = learner is not None
    started = [start_episode(task, seed, REDRAW_STRIDE) for task, seed in zip(tasks, seeds, strict=True)]
    frames = [frame for frame, _, _ in started]
    streams = [np.random.default_rng([seed, RANDOM_STREAM]) for _, seed, _ in started]
    n, width, steps = len(seeds), pool.env.action_dim, pool.env.max_steps
    memory = (learner.initial(n) if learner is not None else _no_memory(n, width)).to(device)
    rewards, solved = np.zeros((steps + 1, n), np.float32), np.zeros(n, bool)
    kept: list[TensorDictBase] = []
    for step in range(steps + 1):
        frame = TensorDict({keys.ACTION: memory.get(keys.ACTION).cpu()}, [n])
        if learner is not None:
            memory.set(keys.PIXELS, torch.from_numpy(np.stack(frames)).to(device).movedim(-1, -3))
            with torch.no_grad():
                seen = learner.act(memory, generator, explore)
            frame.update(seen.select(*learner.stored).cpu())
            memory = seen.select(*memory.exclude(keys.PIXELS).keys())
        kept.append(frame)
        if step == steps:
            break
        if random:
            drawn = np.stack([stream.uniform(-1, 1, width).astype(np.float32) for stream in streams])
            memory.set(keys.ACTION, torch.from_numpy(drawn).to(device))
        for i, (task, action) in enumerate(zip(tasks, memory.get(keys.ACTION).cpu().numpy(), strict=True)):
            observation, reward, _, _, info = task.step(action)
            frames[i], rewards[step + 1, i] = observation["pixels"], reward
            solved[i] |= info["success"]
    returns = tuple(rewards.sum(axis=0, dtype=np.float64).tolist())
    return Episodes(_with_rewards(torch.stack(kept, 1), rewards), returns, tuple(solved.tolist()))


def _no_memory(n: int, width: int) -> TensorDict:
    return TensorDict({keys.ACTION: torch.zeros(n, width)}, [n])


def _with_rewards(frames: TensorDictBase, rewards: npt.NDArray[np.float32]) -> TensorDict:
    """Frames [n, L] with the rewards (L, n) of arriving at them, and the episodes' first and last frames marked."""
    first = torch.zeros(*frames.batch_size, 1, dtype=torch.bool)
    last = first.clone()
    first[:, 0], last[:, -1] = True, True
    received = torch.from_numpy(rewards).T.unsqueeze(-1).contiguous()
    values = {**frames.to_dict(), keys.REWARD: received, keys.IS_FIRST: first, keys.IS_LAST: last}
    return TensorDict(values, frames.batch_size)
