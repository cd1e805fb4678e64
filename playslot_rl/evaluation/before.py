"""Whether a policy, or slots, were measured before just as they would be now."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from playslot_rl.config import ExperimentConfig
from playslot_rl.evaluation.actions import PROTOCOL, asked
from playslot_rl.evaluation.success import DEFAULT_EPISODES, run_facts, task_facts
from playslot_rl.runs import Run


def measured_before(config: ExperimentConfig) -> dict[str, Any] | None:
    """What `RUN/evaluation/PROTOCOL/eval_info.json` holds, if it is of the run's policy as it is, and of the config's
    episodes, seed, task and renderer; a CheckpointError where the run has no trained policy of `config.method`.
    """
    run = Run.of(config)
    prints, name = run_facts(run.folder, config.method).fingerprints, f"evaluation/{config.protocol}/eval_info.json"
    if config.protocol == PROTOCOL:
        return run.result(name, {"asked": asked(config), "fingerprints": prints})
    return simulated_before(run, name, config, prints, config.episodes or DEFAULT_EPISODES)


def simulated_before(
    run: Run, name: Path | str, config: ExperimentConfig, prints: Mapping[str, str], episodes: int
) -> dict[str, Any] | None:
    """What a file of the run holds, if it is of so many episodes, the config's seed, task and renderer, and weights."""
    facts = {"episodes": episodes, "seed": config.seed, **task_facts(config, config.seed)}
    return run.result(name, facts | {"fingerprints": dict(prints)})
