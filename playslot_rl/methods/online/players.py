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
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from typing import Any

import torch
from safetensors.torch import load
from tensordict import TensorDict

from playslot_rl.acting.episodes import TaskPool
from playslot_rl.config import CollectorConfig
from playslot_rl.errors import PlaySlotError
from playslot_rl.methods.online.acting import Learner, PlayedEpisodes, play
from playslot_rl.methods.online.replay import whole_episodes
from playslot_rl.runtime.processes import begin_worker, worker_context
from playslot_rl.runtime.ray_cluster import RayCluster, worker_cannot_start
from playslot_rl.seeds.draws import global_seed, step_generator
from playslot_rl.storage.tensors import load_modules, module_tensors, tensor_bytes

START_S = 300.0
"""What a worker is given to import everything, beyond `collector.timeout_s`."""


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
        torch.set_num_threads(1)
        # What our own parent packed, on whatever device it learns: here it acts on the CPU.
        self.learner, make_pool = torch.load(io.BytesIO(setup), map_location="cpu", weights_only=False)
        self.pool: TaskPool = make_pool()

    def play(self, weights: bytes, wanted: Round, part: int) -> tuple[bytes, PlayedEpisodes]:
        """Frames as safetensors, and the episodes without them."""
        load_modules(self.learner.modules, load(weights), "the learner's weights")
        played = play_round(self.pool, self.learner, torch.device("cpu"), wanted, part)
        values = {str(key): value for key, value in played.frames.items()}
        return tensor_bytes(values), PlayedEpisodes(TensorDict({}, []), played.returns, played.successes)


_player: Player | None = None


def _begin(setup: bytes) -> None:
    global _player
    begin_worker()
    _player = Player(setup)


def _play(weights: bytes, wanted: Round, part: int) -> tuple[bytes, PlayedEpisodes]:
    assert _player is not None
    return _player.play(weights, wanted, part)


class _LocalWorker:
    def __init__(self, setup: bytes) -> None:
        self._pool = ProcessPoolExecutor(1, worker_context(), _begin, (setup,))

    def submit(self, weights: bytes, wanted: Round, part: int) -> Future[Any]:
        return self._pool.submit(_play, weights, wanted, part)

    def close(self) -> None:
        """End it at once, also while it plays or hangs."""
        for process in list((self._pool._processes or {}).values()):  # one that hangs is ended no other way
            process.kill()
        self._pool.shutdown(cancel_futures=True)  # and wait: what is left to the garbage collector may leak semaphores


class _RayWorker:
    def __init__(self, setup: bytes) -> None:
        import ray

        self._actor: Any = ray.remote(num_cpus=1, max_restarts=0)(Player).remote(setup)

    def submit(self, weights: bytes, wanted: Round, part: int) -> Future[Any]:
        found: Future[Any] = self._actor.play.remote(weights, wanted, part).future()
        return found

    def close(self) -> None:
        import ray

        ray.kill(self._actor)


class Players:
    """Workers that play one round ahead of the learner, of which each has a copy: `count` of them, a divisor of a
    round's episodes, with environments that `make_pool` gives, which is pickled. A ConfigError where Ray is asked for
    and not installed, a PlaySlotError where the cluster cannot be reached.
    """

    def __init__(
        self, learner: Learner, make_pool: Callable[[], TaskPool], count: int, settings: CollectorConfig
    ) -> None:
        self.learner, self.settings, self.replaced = learner, settings, 0
        packed = io.BytesIO()
        torch.save((learner, make_pool), packed)
        self._setup = packed.getvalue()
        self._ray = RayCluster.find(settings.ray_address, count) if settings.backend == "ray" else None
        self._ours = self._ray is not None and self._ray.connect()
        self._workers: list[_LocalWorker | _RayWorker] = [self._made() for _ in range(count)]
        self._ready = [False] * count
        self._weights, self._parts = b"", list[Round]()
        self._futures: list[Future[Any]] = []

    def begin(self, wanted: Round) -> None:
        self._weights = tensor_bytes(module_tensors(self.learner.modules))
        self._parts = wanted.split(len(self._workers))
        self._futures = [
            worker.submit(self._weights, part, i)
            for i, (worker, part) in enumerate(zip(self._workers, self._parts, strict=True))
        ]

    @property
    def playing(self) -> bool:
        return bool(self._futures)

    def finish(self) -> PlayedEpisodes:
        """The round that was begun, when all of it is played; a PlaySlotError where more workers died or hung than
        `collector.restarts`, or one cannot work.
        """
        parts = [self._wait(i) for i in range(len(self._workers))]
        self._futures = []
        frames = [whole_episodes(load(content)) for content, _ in parts]
        returns = tuple(value for _, part in parts for value in part.returns)
        return PlayedEpisodes(torch.cat(frames), returns, tuple(s for _, part in parts for s in part.successes))

    def close(self) -> None:
        for worker in self._workers:
            worker.close()
        self._workers, self._futures = [], []
        if self._ours:
            import ray

            ray.shutdown()

    def _made(self) -> _LocalWorker | _RayWorker:
        return _LocalWorker(self._setup) if self._ray is None else _RayWorker(self._setup)

    def _wait(self, i: int) -> tuple[bytes, PlayedEpisodes]:
        while True:
            patience = self.settings.timeout_s + (0.0 if self._ready[i] else START_S)
            try:
                found: tuple[bytes, PlayedEpisodes] = self._futures[i].result(patience)
            except TimeoutError:
                self._replace(i, f"played no round for {self.settings.timeout_s:g} s")
            except BrokenProcessPool:
                self._replace(i, "died")
            except Exception as error:
                if self._ray is None:
                    raise
                if not _lost(error):
                    told = getattr(error, "cause", None)  # Ray wraps it in its own, of many lines
                    if isinstance(told, PlaySlotError):
                        raise told from error
                    raise
                if (cause := worker_cannot_start(error)) is not None:
                    raise cause from error
                self._replace(i, "on Ray was lost")
            else:
                self._ready[i] = True
                return found

    def _replace(self, i: int, reason: str) -> None:
        self._workers[i].close()
        if self.replaced >= self.settings.restarts:
            raise PlaySlotError(
                f"a worker {reason}, after {self.replaced} were replaced: got more than collector.restarts="
                f"{self.settings.restarts}, expected workers that live; the same command carries on"
            )
        self.replaced += 1
        self._workers[i], self._ready[i] = self._made(), False
        self._futures[i] = self._workers[i].submit(self._weights, self._parts[i], i)


def _lost(error: Exception) -> bool:
    import ray

    return isinstance(error, ray.exceptions.RayError) and not isinstance(error, ray.exceptions.RayTaskError)
