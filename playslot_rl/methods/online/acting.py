"""What a method gives to the loop of acting and learning, and how its episodes are played for the replay and the curve.

All tasks run for `env.max_steps` agent steps and never end before, so that episodes have equal lengths.

Shapes: n episodes in lock-step, L = `env.max_steps` + 1 frames, B sequences of T frames, A action dim, H W image height
and width.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.acting.actor import Actor, RandomActor
from playslot_rl.acting.episodes import Moment, TaskPool, run_episodes
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.seeds.episodes import redraw_stride


class Learner(Protocol):
    """An agent that learns from replayed episodes while it acts.

    It keeps no state between calls but in `modules` and `optimizers`: both are checkpointed as they stand.

    Attributes:
        stored: keys of what `act` returns that the replay keeps of each frame, such as `(keys.PIXELS,)` or
            `(keys.SLOTS,)`. Fixed shapes; any dtype.
    """

    stored: tuple[str, ...]

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Everything with weights or buffers, by name; target networks and normalisers too."""

    @property
    def optimizers(self) -> Mapping[str, torch.optim.Optimizer]:
        """By name."""

    def initial(self, n: int) -> TensorDict:
        """The memory of n new episodes, batch size [n]; its keys are those that `act` hands on to the next frame.

        It holds `keys.ACTION` (n, A), the last action taken, zero here.
        """

    def act(self, memory: TensorDictBase, generator: torch.Generator, explore: bool) -> TensorDictBase:
        """See a frame and choose an action; called without gradients, modules in eval mode.

        Args:
            memory: the keys of `initial`, and `keys.PIXELS` uint8 (n, 3, H, W), the present frame.
            generator: of whatever is drawn, on the learner's device.
            explore: sample an action (training) instead of taking the best one (evaluation: a function of memory and
                frame alone).

        Returns:
            The memory's keys anew, and those of `stored`. `keys.ACTION` (n, A) is the action chosen: float32, finite;
            the environment clips it to [-1, 1]. The loop may replace it (random start) before it hands the memory on.
        """

    def update(self, batch: TensorDict, generators: StepGenerators) -> Mapping[str, Tensor]:
        """One optimiser step on a batch of sequences, modules in train mode.

        The loop seeds torch's global generators for the call (`playslot_rl.seeds.draws.global_seed`), for what
        takes no generator.

        Args:
            batch: batch size [B, T], on the learner's device. The keys of `stored`, and with each frame: `keys.ACTION`
                (B, T, A), the action that *led to* it; `keys.REWARD` (B, T, 1), received on the way; `keys.IS_FIRST`
                and `keys.IS_LAST` (B, T, 1). On the first frame of an episode action and reward are zero. There is no
                other end of an episode than its time limit, so that returns go on beyond `IS_LAST`.
            generators: of whatever is drawn.

        Returns:
            Scalars to log, detached; one that is not finite stops the training.
        """


@dataclass(frozen=True)
class PlayedEpisodes:
    """Whole episodes: `frames` of batch size [n, L], on the CPU (the learner's stored keys, ACTION, REWARD, IS_FIRST,
    IS_LAST), undiscounted sums of rewards (n,), and whether a step solved the task (None where it measures no success).
    """

    frames: TensorDict
    returns: tuple[float, ...]
    successes: tuple[bool | None, ...]


def solved_of(successes: Sequence[bool | None]) -> int | None:
    """How many episodes were solved; None of a task that measures no success."""
    return None if None in successes else sum(map(bool, successes))


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

    The learner sees every frame, and samples its actions to `explore`; None looks at none (`random` only) and stores
    none. With `random` actions are uniform in [-1, 1], a function of the episode's seed.
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
