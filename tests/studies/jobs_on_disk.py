"""Jobs as they lie on disk once they ended, without running any."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from playslot_rl.evaluation.intervals import wilson
from playslot_rl.storage.atomic import write_json
from playslot_rl.storage.tensors import save_tensors
from playslot_rl.studies.launch import Status, write_status
from playslot_rl.studies.success.jobs import SuccessJob
from playslot_rl.studies.success.summary import differences, summarise


def finish(job: SuccessJob, successes: dict[str, int], episodes: int = 10, **meta: Any) -> SuccessJob:
    """Write what a finished job leaves, with so many successes under each protocol."""
    write_status(job.file, Status("done", "f", "", 12.0))
    checkpoint = job.run / job.stage / "checkpoint"
    values = {"parents": {}, "seconds": 30.0, "labelled_demos": job.demos, "demos": job.demos}
    write_json(checkpoint / "meta.json", {**values, **meta})
    save_tensors(checkpoint / "weights.safetensors", {"a": torch.zeros(3, 4), "n": torch.zeros(5, dtype=torch.long)})
    for protocol, won in successes.items():
        info = {
            "success_rate": won / episodes, "episodes": episodes, "ci95": list(wilson(won, episodes)),
            "mean_steps_to_success": None, "wall_seconds": 4.0,
            "per_episode": [{"success": number < won} for number in range(episodes)],
        }  # fmt: skip
        write_json(job.run / "evaluation" / protocol / "eval_info.json", info)
    return job


def comparison(out: Path, rows: list[dict[str, Any]], reference: str = "playslot") -> dict[str, Any]:
    """A result as `comparison.json` holds it."""
    expert = {"success_rate": 1.0, "ci95": [0.7, 1.0]}
    return {
        "env": "button_press", "preset": "compact",
        "labels": sorted({row["labels"] for row in rows if row["labels"]}), "seeds": [0, 1],
        "episodes": 10, "evaluation_seed": 100,
        "block": {"number": 100, "kind": "development"}, "videos": [], "worlds": 1, "across_tasks": None,
        "reference": reference, "differences": differences(rows, reference),
        "max_steps": 20, "frame_skip": 5, "learn_from_demos": True, "latent_models": {},
        "threads": 0, "jobs": 7,
        "rows": rows, "summary": summarise(rows), "seconds": 99.0, "command": "playslot compare",
        "commit": "c", "hardware": {"machine": "x86_64", "cores": 2, "gpu": None},
        "references": {"expert": expert, "random": {"success_rate": 0.0, "ci95": [0.0, 0.3]}},
        "world_models": [
            {"source": "pretrained", "fingerprints": {"slots": "ab"}, "seconds": 5.0, "episodes": 700}
        ],
    }  # fmt: skip
