"""Who plays the rounds of episodes that a method learns from: this process, or workers beside it.

Without workers round r is played with the weights that all updates before it have left. With `workers=W` it is played
while the updates after round r - 1 are computed, with the weights from before them:

    here       play 0 | learn 0 | play 1 | learn 1 | play 2 | ...
    workers    play 0 |          play 1  |          play 2  | ...
    learner             learn 0          | learn 1          | ...

Each worker plays `envs / W` episodes of a round side by side. What a round draws is a function of (seed, round,
worker), and what it is played with is a function of the updates alone: a run is repeated bit for bit however long a
worker takes, and also if one dies and its part is played again by another.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from safetensors.torch import load
from tensordict import TensorDict

from playslot_rl.acting.episodes import TaskPool
from playslot_rl.collectors.workers import Workers
from playslot_rl.config import CollectorConfig
from playslot_rl.methods.online.acting import Learner, PlayedEpisodes, play
from playslot_rl.methods.online.replay import whole_episodes
from playslot_rl.seeds.draws import global_seed, step_generator
from playslot_rl.storage.tensors import load_modules, module_tensors, tensor_bytes


@dataclass(frozen=True)
class Round:
    """Episodes, by their seeds, that are played with the same weights; the round's number counts from 0, and `random`
    takes uniform actions.
    """

    seed: int
    number: int
    seeds: tuple[int, ...]
    random: bool

    def split(self, count: int) -> list[Round]:
        share = len(self.seeds) // count
        return [replace(self, seeds=self.seeds[i * share : (i + 1) * share]) for i in range(count)]


def play_round(pool: TaskPool, learner: Learner, device: torch.device, wanted: Round, part: int = 0) -> PlayedEpisodes:
    """Play a round, or a worker's part of it, exploring; the learner's modules are left in evaluation mode."""
    stream = "act" if part == 0 else f"act/{part}"
    for module in learner.modules.values():
        module.eval()
    generator = step_generator(wanted.seed, wanted.number, stream, device)
    with global_seed(wanted.seed, wanted.number, stream):
        return play(pool, wanted.seeds, learner, device, generator, explore=True, random=wanted.random)


class Player:
    """A worker's body: an own learner, which acts with the weights it is sent, and own environments."""

    def __init__(self, setup: bytes) -> None:
        # What our own parent packed, on whatever device it learns: here it acts on the CPU.
        self.learner, make_pool = torch.load(io.BytesIO(setup), map_location="cpu", weights_only=False)
        self.pool: TaskPool = make_pool()

    def __call__(self, weights: bytes, wanted: Round, part: int) -> tuple[bytes, PlayedEpisodes]:
        """Frames as safetensors, and the episodes without them."""
        load_modules(self.learner.modules, load(weights), "the learner's weights")
        played = play_round(self.pool, self.learner, torch.device("cpu"), wanted, part)
        values = {str(key): value for key, value in played.frames.items()}
        return tensor_bytes(values), PlayedEpisodes(TensorDict({}, []), played.returns, played.successes)


class Players:
    """Workers that play one round ahead of the learner, of which each has a copy: `count` of them, a divisor of a
    round's episodes, with environments that `make_pool` gives, which is pickled. Raises as `Workers`.
    """

    def __init__(
        self, learner: Learner, make_pool: Callable[[], TaskPool], count: int, settings: CollectorConfig
    ) -> None:
        packed = io.BytesIO()
        torch.save((learner, make_pool), packed)
        self.learner, self.workers = learner, Workers(partial(Player, packed.getvalue()), count, settings)

    def begin(self, wanted: Round) -> None:
        weights = tensor_bytes(module_tensors(self.learner.modules))
        for i, part in enumerate(wanted.split(len(self.workers))):
            self.workers.submit(i, weights, part, i)

    @property
    def playing(self) -> bool:
        return self.workers.busy

    def finish(self) -> PlayedEpisodes:
        """The round that was begun, when all of it is played; raises as `Workers.answers`."""
        played: dict[int, tuple[bytes, PlayedEpisodes]] = {}
        while self.playing:
            played |= {call[-1]: answer for call, answer in self.workers.answers()}
        parts = [played[i] for i in sorted(played)]
        frames = [whole_episodes(load(content)) for content, _ in parts]
        returns = tuple(value for _, part in parts for value in part.returns)
        return PlayedEpisodes(torch.cat(frames), returns, tuple(s for _, part in parts for s in part.successes))

    def close(self) -> None:
        self.workers.close()
