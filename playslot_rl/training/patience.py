"""Early stopping: a training ends when its held-out error no longer falls, with the weights that had the lowest.

    best_t = min(best_{t-1}, e_t),    stop once best has not fallen for P validations in a row

e_t is one number of the t-th validation, P the patience (Prechelt, *Early Stopping - But When?*, 1998, criterion UP).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from torch import nn

from playslot_rl.runtime.processes import here, wait
from playslot_rl.storage.resume import TrainingState
from playslot_rl.storage.tensors import load_modules, load_tensors, module_tensors, save_tensors

BEST = "best.safetensors"


def patience_of(checks: int, watched: str) -> Patience | None:
    """The `Patience` of a config's number of validations, of which 0 has none."""
    return Patience(checks, watched) if checks else None


@dataclass(frozen=True)
class Patience:
    """When to stop: after so many checks, at least 1, without a new lowest value of the watched number."""

    checks: int
    watched: str

    def ended(self, state: TrainingState) -> bool:
        return state.stale >= self.checks

    def judge(self, state: TrainingState, modules: Mapping[str, nn.Module], folder: Path) -> TrainingState:
        """The state after a validation; the weights are written to `FOLDER/best.safetensors` if it is the best one, by
        the first of several processes. A KeyError where it has no such number, an OutputError where the disk is full.

        A training that is killed and carries on from an older checkpoint comes to the same weights, and writes them
        again.
        """
        if state.best and state.metrics[self.watched] >= state.best[self.watched]:
            return replace(state, stale=state.stale + 1)
        if here().first:
            folder.mkdir(parents=True, exist_ok=True)
            save_tensors(folder / BEST, module_tensors(modules))
        return replace(state, best=dict(state.metrics), stale=0)

    def restore(self, state: TrainingState, modules: Mapping[str, nn.Module], folder: Path) -> TrainingState:
        """Load the best weights; the state's metrics become theirs."""
        wait()
        load_modules(modules, load_tensors(folder / BEST), str(folder / BEST))
        return replace(state, metrics=state.best)
