"""The one loop of the methods that learn by acting: rounds of episodes, and updates from their replay.

Everything that is drawn derives from (seed, round) or (seed, update). Checkpoints lie between rounds, so that no
environment has to be stored; killed at any moment and started again, the same command ends with the same weights, bit
for bit on a CPU (with a budget of minutes: as far as the time reaches).
"""

from __future__ import annotations

import contextlib
import math
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import nn

from playslot_rl.acting.episodes import LOCKSTEP, TaskPool
from playslot_rl.config.methods import METHODS
from playslot_rl.config.roles import without
from playslot_rl.evaluation.intervals import wilson
from playslot_rl.methods.online.acting import Learner, PlayedEpisodes, play, solved_of
from playslot_rl.methods.online.config import OnlineConfig
from playslot_rl.methods.online.players import Players, Round, play_round
from playslot_rl.methods.online.replay import OnlineCheckpoints, OnlineState, Replay
from playslot_rl.runtime.progress import StageProgress
from playslot_rl.seeds.draws import StepGenerators, global_seed, step_generator
from playslot_rl.seeds.episodes import episode_seed
from playslot_rl.storage.atomic import write_json
from playslot_rl.storage.checkpoints import StageCheckpoint
from playslot_rl.storage.resume import sittings_of
from playslot_rl.training.logging import Watch
from playslot_rl.training.record import StageRecord

if TYPE_CHECKING:
    from torchrl.trainers.algorithms import DreamerV3UpdateRatio


class _Run:
    """One process's part of a run: the pieces that are moved from round to round."""

    def __init__(self, training: OnlineTraining, record: StageRecord) -> None:
        from torchrl.trainers.algorithms import DreamerV3UpdateRatio

        config, folder, name = record.config, record.folder, record.name
        self.learner, self.online, self.prior = training.learner, training.own, training.prior
        self.config, self.folder, self.device = config, folder, record.device
        learner, online = self.learner, self.online
        self.ring = folder / "ring"
        self.remove_ring()  # which a kill has left
        self.replay = Replay(online, config.env.max_steps + 1, self.ring if online.replay_on_disk else None)
        own = {name: without(online, "free"), "seed": config.seed}
        self.checkpoints = OnlineCheckpoints(folder, {**own, **record.resumes()}, record.spec.typed)
        cure = f"lower its learning rate (baselines.{name}.*)"
        self.watch = Watch(name, folder, self.checkpoints, cure)
        self.state = self.checkpoints.resume_online(learner.modules, learner.optimizers, self.replay)
        self.ratio: DreamerV3UpdateRatio = DreamerV3UpdateRatio(online.update_ratio)
        self.ratio.load_state_dict({"ratio": online.update_ratio, "previous": self.state.ratio_from})
        self.pool = TaskPool(config.env, config.render)
        self.players: Players | None = None
        self.ahead: PlayedEpisodes | None = None
        if self.state.ahead:
            self.ahead = PlayedEpisodes(self.checkpoints.ahead(), **self.state.ahead)
        self.new: list[TensorDictBase] = []
        self._began = time.monotonic() - self.state.seconds

    @contextlib.contextmanager
    def playing(self) -> Iterator[None]:
        """Inside the block workers play the episodes, if there are to be any."""
        count, config = self.online.workers, self.config
        if count:
            make_pool = partial(TaskPool, config.env, config.render)
            self.players = Players(self.learner, make_pool, count, config.collector)
        try:
            yield
        finally:
            if self.players is not None:
                self.players.close()

    def remove_ring(self) -> None:
        shutil.rmtree(self.ring, ignore_errors=True)

    @property
    def finished(self) -> bool:
        late = 0 < self.online.minutes * 60 <= self.state.seconds
        return self.state.step >= self.online.steps or late

    def advance(self, progress: StageProgress) -> None:
        before = self.state
        if not before.random:
            self.state = replace(before, random=self._measure(random=True))
        self._play()
        if self.state.step >= self.online.prefill and self.replay.ready:
            self._learn()
        self.state = replace(self.state, ratio_from=self.ratio.state_dict()["previous"], seconds=self._seconds())
        progress.update(min(self.state.step, self.online.steps), {})
        over = self.finished
        if self._due(before.step, self.online.evaluate_every) or over:
            self._evaluate()
        if self._due(before.step, self.online.checkpoint_every) or over:
            self._save()

    def _seconds(self) -> float:
        return time.monotonic() - self._began

    def _due(self, before: int, every: int) -> bool:
        return self.state.step // every > before // every

    def _mode(self, training: bool) -> None:
        for module in self.learner.modules.values():
            module.train(training)

    def _play(self) -> None:
        state, n = self.state, self.online.envs
        played = self._next()
        self.replay.add(played.frames)
        self.new.append(played.frames)
        step = state.step + n * self.config.env.max_steps
        self.state = replace(state, step=step, rounds=state.rounds + 1, episodes=state.episodes + n)
        solved = solved_of(played.successes)
        values = {"return": sum(played.returns) / n} | ({} if solved is None else {"success": solved / n})
        self._log("acting", values)
        if self.players is not None and step < self.online.steps:
            self.players.begin(self._round())  # with the weights from before the updates that come now

    def _round(self) -> Round:
        state, seed = self.state, self.config.seed
        seeds = tuple(episode_seed("training", seed, state.episodes + i) for i in range(self.online.envs))
        return Round(seed, state.rounds, seeds, random=state.step < self.online.prefill)

    def _next(self) -> PlayedEpisodes:
        if self.players is None:
            return play_round(self.pool, self.learner, self.device, self._round())
        if self.ahead is None and not self.players.playing:
            self.players.begin(self._round())
        played, self.ahead = self.ahead or self.players.finish(), None
        return played

    def _learn(self) -> None:
        self._mode(True)
        for _ in range(self.ratio(self.state.step)):
            update, seed = self.state.updates, self.config.seed
            batch = self.replay.sample(step_generator(seed, update, "replay")).to(self.device)
            with global_seed(seed, update, "update"):
                values = self.learner.update(batch, StepGenerators(seed, update, self.device))
            # One transfer for all, so that a GPU is waited for once an update.
            numbers = dict(zip(values, torch.stack([v.float() for v in values.values()]).tolist(), strict=True))
            for key, value in numbers.items():
                if not math.isfinite(value):
                    raise self.watch.not_finite(key, str(value), self._when())
            self.state = replace(self.state, updates=update + 1)
            if update == 0 or (update + 1) % self.online.log_every == 0:
                self._log("train", numbers, at=self.state.step)

    def _development_seeds(self) -> list[int]:
        return [episode_seed("development", 0, i) for i in range(self.online.evaluation_episodes)]

    def _measure(self, random: bool = False) -> dict[str, Any]:
        """Play the development episodes without exploring.

        Gives `return_mean` and its standard error, `success_rate` (0 to 1) and its Wilson interval `ci95`, both None
        of a task that measures no success.
        """
        seeds, played = self._development_seeds(), []
        self._mode(False)
        with global_seed(self.config.seed, self.state.rounds, "development"):
            for first in range(0, len(seeds), LOCKSTEP):
                generator = step_generator(self.config.seed, first, "development", self.device)
                learner = None if random else self.learner
                chunk = seeds[first : first + LOCKSTEP]
                played.append(play(self.pool, chunk, learner, self.device, generator, random=random))
        returns = np.array([value for part in played for value in part.returns])
        solved = solved_of([value for part in played for value in part.successes])
        return {
            "return_mean": float(returns.mean()),
            "return_error": float(returns.std(ddof=1) / np.sqrt(len(returns))) if len(returns) > 1 else 0.0,
            "success_rate": None if solved is None else solved / len(returns),
            "ci95": None if solved is None else list(wilson(solved, len(returns))),
        }

    def _evaluate(self) -> None:
        state = self.state
        point = self._measure()
        row = {
            "env_steps": state.step + self.prior,
            "updates": state.updates,
            "seconds": round(state.seconds, 1),
            **point,
        }
        metrics = {key: value for key, value in point.items() if isinstance(value, float)}
        self.state = replace(state, metrics=metrics, curve=[*state.curve, row], seconds=self._seconds())
        self._log("validation", metrics, at=state.step)
        self.write_curve()

    def write_curve(self) -> None:
        """Write `curve.json`, whose `env_steps` are agent steps of `env.frame_skip` environment steps each."""
        seeds = self._development_seeds()
        values = {
            "method": METHODS[self.config.method].title,
            "env": self.config.env.full_name,
            "episodes": len(seeds),
            "first_seed": seeds[0],
            "random": self.state.random,
            "rows": self.state.curve,
        }
        write_json(self.folder / "curve.json", values)

    def _save(self) -> None:
        self.watch.require_finite(self.learner.modules, self._when())
        new = torch.cat(self.new) if self.new else None
        if self.players is not None and self.players.playing:
            self.ahead = self.players.finish()  # played with weights that no checkpoint holds
        ahead = self.ahead
        told = {} if ahead is None else {"returns": ahead.returns, "successes": ahead.successes}
        self.state = replace(self.state, ahead=told)
        modules, optimizers = self.learner.modules, self.learner.optimizers
        frames = None if ahead is None else ahead.frames
        self.checkpoints.save_online(self.state, modules, optimizers, new, self.replay.capacity, frames)
        self.new = []

    def _when(self) -> str:
        return f"update {self.state.updates + 1}"

    def _log(self, split: str, values: Mapping[str, float], at: int | None = None) -> None:
        numbers = {"updates": self.state.updates, **values, "seconds": round(self._seconds(), 3)}
        self.watch.log(split, self.state.step, numbers, at=at)


@dataclass(frozen=True)
class OnlineTraining:
    """See `playslot_rl.training.run_stage.Prepared`.

    Attributes:
        learner: on its device.
        own: settings of acting, replay and schedule.
        modules: what a finished run keeps of the learner.
        prior: agent steps behind what it was given, which are added to the curve's.
    """

    learner: Learner
    own: OnlineConfig
    modules: Mapping[str, nn.Module]
    prior: int = 0

    def train(self, record: StageRecord, begin: Callable[[], None]) -> tuple[OnlineState, int]:
        """Train until `steps` agent steps (or `minutes`), carrying on from the newest checkpoint.

        Writes `checkpoints`, `replay`, `logs`, `metrics.jsonl` and `curve.json` in `RUN/METHOD`, and while it trains
        `ring`, where the replay is on the disk. `begin` is called before the first step. Returns where it ended, and
        the agent steps that this process started at.

        Raises:
            TrainingError: a loss or weight is not finite; the last good checkpoint stays.
            CheckpointError: the folder was begun with another config, or its checkpoint is damaged.
            OutputError: another command trains it, or a full disk; the last good checkpoint stays.
            KeyboardInterrupt: Ctrl-C; its message says where the same command carries on.
        """
        run = _Run(self, record)
        begin()
        online, start, logging = self.own, run.state.step, record.config.logging
        run.watch.history.rewind(start)
        try:
            if not run.finished:
                progress = StageProgress(record.name, start, online.steps, logging.progress, online.evaluate_every)
                with run.watch.running(logging, start), progress, run.pool, run.playing():
                    while not run.finished:
                        run.advance(progress)
        finally:
            run.remove_ring()
        run.write_curve()
        return run.state, start

    def carry_out(self, record: StageRecord, begin: Callable[[], None]) -> StageCheckpoint:
        state, _ = self.train(record, begin)
        extra = {
            "env_steps": state.step + self.prior,
            "savi_steps": self.prior,
            "episodes": state.episodes,
            "random_policy": state.random,
            "sittings": sittings_of(record.folder / "checkpoints", record.name),
            "parameters": sum(p.numel() for module in self.modules.values() for p in module.parameters()),
        }
        done = record.save(self.modules, state.metrics, state.updates, state.seconds, extra)
        last, random, before = state.curve[-1], state.random, f" and {self.prior} of SAVi's data" if self.prior else ""
        success = ""
        if last["success_rate"] is not None:
            success = f", success {100 * last['success_rate']:.0f} % (random {100 * random['success_rate']:.0f} %)"
        print(
            f"{record.name}: {state.step} agent steps{before}, {state.updates} updates; development episodes: return "
            f"{last['return_mean']:.2f} (random {random['return_mean']:.2f}){success}; {record.folder}",
            flush=True,
        )
        return done
