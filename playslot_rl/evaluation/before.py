"""Whether a policy was measured before just as it would be now."""

from __future__ import annotations

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
    facts: dict[str, Any] = {"fingerprints": run_facts(run.folder, config.method).fingerprints}
    if config.protocol == PROTOCOL:
        facts["asked"] = asked(config)
    else:
        facts |= {"episodes": config.episodes or DEFAULT_EPISODES, "seed": config.seed}
        facts |= task_facts(config, config.seed)
    return run.result(f"evaluation/{config.protocol}/eval_info.json", facts)
