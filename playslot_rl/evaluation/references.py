"""Success of the references: random actions, the scripted expert, and the slot oracle, on the same seeds."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from playslot_rl.acting.actor import Actor, ExpertActor, RandomActor
from playslot_rl.acting.episodes import Outcome, TaskPool, run_episodes
from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.evaluation.intervals import wilson
from playslot_rl.storage.atomic import write_json


def summary(episodes: Sequence[Outcome]) -> dict[str, Any]:
    """`success_rate` (0 to 1), `ci95` (Wilson) and `mean_steps_to_success` (agent steps; None without a success)."""
    steps = [e.steps for e in episodes if e.steps is not None]
    return {
        "success_rate": len(steps) / len(episodes),
        "ci95": list(wilson(len(steps), len(episodes))),
        "mean_steps_to_success": float(np.mean(steps)) if steps else None,
    }


def run_references(
    oracle: Actor | None,
    config: ExperimentConfig,
    seeds: Sequence[int],
    pool: TaskPool,
    oracle_fingerprint: str = "",
    cache: Path | None = None,
) -> dict[str, dict[str, Any]]:
    """Results of `random`, `expert` and `slot_oracle`, always closed-loop.

    Args:
        oracle: the slot oracle beside the agent; None gives null values.
        config: environment and renderer.
        seeds: evaluation seeds.
        pool: environments.
        oracle_fingerprint: names the weights of oracle and SAVi; empty means that the oracle's result is not cached.
        cache: JSON file that both protocols of a run share; None means no cache.
    """
    actors: dict[str, Actor] = {
        "random": RandomActor(config.env.max_steps, config.env.action_dim),
        "expert": ExpertActor(),
    }
    if oracle is not None:
        actors["slot_oracle"] = oracle
    stored = _read_cache(cache)
    results: dict[str, dict[str, Any]] = {}
    for name, actor in actors.items():
        weights = oracle_fingerprint if name == "slot_oracle" else name
        key = _key(name, weights, config, seeds)
        if not weights or key not in stored:
            stored[key] = summary(run_episodes(pool, actor, seeds))
        results[name] = stored[key]
    if oracle is None:
        results["slot_oracle"] = {"success_rate": None, "ci95": None, "mean_steps_to_success": None}
    if cache is not None:
        kept = {k: v for k, v in stored.items() if oracle_fingerprint or not k.startswith("slot_oracle")}
        write_json(cache, kept)
    return results


def _key(name: str, weights: str, config: ExperimentConfig, seeds: Sequence[int]) -> str:
    what = [weights, to_dict(config.env), to_dict(config.render), list(seeds)]
    return f"{name}-{hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:16]}"


def _read_cache(path: Path | None) -> dict[str, dict[str, Any]]:
    if path is None or not path.is_file():
        return {}
    try:
        stored: dict[str, dict[str, Any]] = json.loads(path.read_text())
    except json.JSONDecodeError:
        return {}  # only a cache: run the references again
    return stored


def episode_records(episodes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Plain dicts of the episodes, for JSON."""
    return [asdict(e) for e in episodes]
