"""The training of a method that learns by acting, as a stage carries it out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from torch import nn

from playslot_rl.config.methods import METHODS
from playslot_rl.methods.online.checkpoints import OnlineState
from playslot_rl.methods.online.config import OnlineConfig
from playslot_rl.methods.online.learner import Learner
from playslot_rl.methods.online.loop import train_online
from playslot_rl.storage.checkpoints import StageCheckpoint
from playslot_rl.training.record import StageRecord


@dataclass(frozen=True)
class OnlineTraining:
    """See `playslot_rl.training.record.Prepared`.

    Attributes:
        learner: on its device.
        own: settings of acting, replay and schedule.
        modules: what a finished run keeps of the learner.
        prior: agent steps behind what it was given.
    """

    learner: Learner
    own: OnlineConfig
    modules: Mapping[str, nn.Module]
    prior: int = 0

    def carry_out(self, record: StageRecord, begin: Callable[[], None]) -> StageCheckpoint:
        """Act and learn, and save."""
        title = METHODS[record.config.method].title
        state, _ = train_online(
            self.learner, self.own, record, begin, title=title, device=record.device, prior_steps=self.prior
        )
        return _save(record, state, self.modules, self.prior)


def _save(record: StageRecord, state: OnlineState, modules: Mapping[str, nn.Module], prior: int) -> StageCheckpoint:
    extra = {
        "env_steps": state.step + prior,
        "savi_steps": prior,
        "episodes": state.episodes,
        "random_policy": state.random,
        "parameters": sum(p.numel() for module in modules.values() for p in module.parameters()),
    }
    done = record.save(modules, state.metrics, state.updates, state.seconds, extra)
    last, random, before = state.curve[-1], state.random, f" and {prior} of SAVi's data" if prior else ""
    print(
        f"{record.name}: {state.step} agent steps{before}, {state.updates} updates; development episodes: return "
        f"{last['return_mean']:.2f} (random {random['return_mean']:.2f}), success {100 * last['success_rate']:.0f} % "
        f"(random {100 * random['success_rate']:.0f} %); {record.folder}",
        flush=True,
    )
    return done
