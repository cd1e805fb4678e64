"""Playing episodes for the replay and for the learning curve.

All tasks run for `env.max_steps` agent steps and never end before, so that episodes have equal lengths.

Shapes: n episodes, L = `env.max_steps` + 1 frames, A action dim, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict, TensorDictBase

from playslot_rl import keys
from playslot_rl.acting.actor import Actor, RandomActor
from playslot_rl.acting.episodes import Moment, TaskPool, run_episodes
from playslot_rl.methods.online.learner import Learner
from playslot_rl.seeds.episodes import redraw_stride


@dataclass(frozen=True)
class PlayedEpisodes:
    """Whole episodes.

    Attributes:
        frames: batch size [n, L], on the CPU: the learner's stored keys, ACTION, REWARD, IS_FIRST, IS_LAST.
        returns: undiscounted sums of rewards, (n,).
        successes: whether a step solved the task.
    """

    frames: TensorDict
    returns: tuple[float, ...]
    successes: tuple[bool, ...]


class LearnerActor(Actor):
    """A learner as it acts now, its modules in evaluation mode; `start` replaces the actions it chose, while it still
    sees every frame.
    """

    def __init__(
        self,
        learner: Learner,
        device: torch.device,
        generator: torch.Generator,
        explore: bool,
        start: RandomActor | None = None,
    ) -> None:
        own = (str(key) for key in learner.initial(1).keys())  # noqa: SIM118 (a TensorDict iterates over its rows)
        super().__init__((*own, *(start.memory_keys if start is not None else ())))
        self._device, self.act, self.explore, self.start = device, learner.act, explore, start
        self.generator, self.initial = generator, learner.initial

    @property
    def device(self) -> torch.device:
        return self._device

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        memory = self.initial(len(seeds)).to(self._device)
        return memory if self.start is None else memory.update(self.start.reset(seeds).to(self._device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen = self.act(tensordict, self.generator, self.explore)
        if self.start is None:
            return seen
        return self.start(seen.update(tensordict.select(*self.start.memory_keys)))


def play(
    pool: TaskPool,
    seeds: Sequence[int],
    learner: Learner | None,
    device: torch.device,
    generator: torch.Generator,
    *,
    explore: bool = False,
    random: bool = False,
) -> PlayedEpisodes:
    """Play one episode for each seed, all side by side; one that starts solved is drawn anew.

    Args:
        learner: sees every frame; None looks at none (`random` only) and stores none.
        explore: it samples its actions.
        random: uniform actions in [-1, 1] instead, a function of the episode's seed.
    """
    drawn = RandomActor(pool.env.max_steps, pool.env.action_dim)
    actor: Actor = drawn
    if learner is not None:
        actor = LearnerActor(learner, device, generator, explore, drawn if random else None)
    stored = () if learner is None else learner.stored
    kept: list[TensorDictBase] = []
    rewards: list[npt.NDArray[np.float32]] = []
    action = torch.zeros(len(seeds), pool.env.action_dim)

    def look_on(moment: Moment) -> None:
        nonlocal action
        assert moment.seen is not None
        kept.append(moment.seen.select(*stored).cpu().set(keys.ACTION, action))
        rewards.append(moment.rewards)
        action = moment.seen.get(keys.ACTION).cpu()

    stride = redraw_stride(seeds[0])  # seeds of one call are of one stream
    outcomes = run_episodes(
        pool, actor, seeds, look_on, stop=False, see_last=True, draw=False, stride=stride, lockstep=len(seeds)
    )
    received = np.stack(rewards)
    frames: TensorDictBase = torch.stack(kept, 1)
    first = torch.zeros(*frames.batch_size, 1, dtype=torch.bool)
    last = first.clone()
    first[:, 0], last[:, -1] = True, True
    arrived = torch.from_numpy(received).T.unsqueeze(-1).contiguous()
    values = {**frames.to_dict(), keys.REWARD: arrived, keys.IS_FIRST: first, keys.IS_LAST: last}
    returns = tuple(received.sum(axis=0, dtype=np.float64).tolist())
    return PlayedEpisodes(TensorDict(values, frames.batch_size), returns, tuple(o.success for o in outcomes))
