"""The learning curve: development episodes now and then, beside the random policy on the same ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from playslot_rl.baselines.online.acting import PlayedEpisodes
from playslot_rl.evaluation.intervals import wilson
from playslot_rl.storage.atomic import write_bytes, write_json


def curve_point(played: PlayedEpisodes) -> dict[str, Any]:
    """`return_mean` and its standard error, `success_rate` (0 to 1) and its Wilson interval `ci95`."""
    returns = np.array(played.returns)
    error = float(returns.std(ddof=1) / np.sqrt(len(returns))) if len(returns) > 1 else 0.0
    successes = sum(played.successes)
    return {
        "return_mean": float(returns.mean()),
        "return_error": error,
        "success_rate": successes / len(returns),
        "ci95": list(wilson(successes, len(returns))),
    }


def write_curve(
    folder: Path,
    method: str,
    env: str,
    seeds: Sequence[int],
    rows: Sequence[Mapping[str, Any]],
    random: Mapping[str, Any],
) -> None:
    """Write `curve.json`.

    Args:
        folder: `RUN/METHOD`.
        method: title.
        env: task.
        seeds: the development seeds.
        rows: points with `env_steps` (agent steps), `updates` and `seconds`.
        random: the random policy's point.

    Raises:
        OutputError: full disk.
    """
    values = {
        "method": method,
        "env": env,
        "episodes": len(seeds),
        "first_seed": seeds[0],
        "random": dict(random),
        "rows": [dict(row) for row in rows],
    }
    write_json(folder / "curve.json", values)


def draw_curve(folder: Path, name: str, rows: Sequence[Mapping[str, Any]], random: Mapping[str, Any]) -> None:
    """Draw `curve_light.png` and `curve_dark.png` of a method, by its name.

    Raises:
        OutputError: full disk.
    """
    from playslot_rl.visualization.charts import DARK, LIGHT, learning_chart

    for theme in (LIGHT, DARK):
        write_bytes(folder / f"curve_{theme.name}.png", learning_chart({name: rows}, random, theme))
