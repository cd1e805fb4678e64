"""What came out of a comparison of success: one row a job and protocol, and their summary over training seeds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from playslot_rl.evaluation.intervals import wilson
from playslot_rl.runs import Run
from playslot_rl.storage.atomic import json_or_nothing
from playslot_rl.studies.job import count_parameters
from playslot_rl.studies.launch import Status
from playslot_rl.studies.success.jobs import SuccessJob


def job_rows(job: SuccessJob, frame_skip: int, status: Status) -> list[dict[str, Any]]:
    """One row for each protocol of a job, finished or not; null where there is nothing to say.

    Of its keys, `env_steps` are `frame_skip` times the `agent_steps`, `samples` optimiser steps times batch, `ci95` is
    Wilson's, `kept_rows` the share of the demonstrations' rows that trimming left, and `curve` an online method's
    learning curve, with both kinds of steps.
    """
    done = status.status == "done"
    meta = json_or_nothing(job.run / job.stage / "checkpoint" / "meta.json") if done else {}
    steps = meta.get("env_steps")
    of_training = {
        "labelled_demos": None if job.online else meta.get("labelled_demos"),
        "agent_steps": steps,
        "env_steps": None if steps is None else steps * frame_skip,
        "samples": count_samples(job, meta),
    }
    rows = []
    for protocol in job.protocols:
        info = json_or_nothing(job.run / "evaluation" / protocol / "eval_info.json") if done else {}
        rate = info.get("success_rate")
        rows.append(
            {
                "name": job.name,
                "method": job.method,
                "title": job.title,
                "protocol": protocol,
                "demos": job.demos,
                "labels": job.labels,
                "seed": job.seed,
                "status": status.status,
                "error": status.error or None,
                **of_training,
                "success_rate": rate,
                "successes": None if rate is None else round(rate * info["episodes"]),
                "episodes": info.get("episodes"),
                "ci95": info.get("ci95"),
                "mean_steps_to_success": info.get("mean_steps_to_success"),
                "train_seconds": meta.get("seconds"),
                "evaluation_seconds": info.get("wall_seconds"),
                "parameters": count_parameters(Run(job.run), job.stage) if meta else None,
                "pretraining": meta.get("pretraining"),
                "kept_rows": meta.get("kept_rows"),
                "curve": learning_curve(job, frame_skip) if job.online else None,
            }
        )
    return rows


def learning_curve(job: SuccessJob, frame_skip: int) -> list[dict[str, Any]] | None:
    """Rows of `RUN/METHOD/curve.json`, there before the job is done too; None without one."""
    rows = json_or_nothing(job.run / job.stage / "curve.json").get("rows") or []
    return [
        {**row, "agent_steps": row["env_steps"], "env_steps": row["env_steps"] * frame_skip} for row in rows
    ] or None


def count_samples(job: SuccessJob, meta: Mapping[str, Any]) -> int | None:
    """Examples a method's policy was trained on, repeats included: optimiser steps times batch."""
    config = json_or_nothing(job.run / job.stage / "checkpoint" / "config.json").get(job.stage, {})
    batch = config.get("batch_size", config.get("policy", {}).get("batch_size"))
    return None if batch is None or job.online or not meta else int(meta.get("steps", 0)) * int(batch)


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of finished jobs, pooled over training seeds.

    Steps, seconds and `success_rate` are means over the seeds, `lowest` and `highest` rates of a seed.

    `ci95` is Wilson's interval of that mean over the episodes of one seed: all seeds play the same ones, so that
    pooling them would count an episode that is easy, or hard, for all of them several times.
    """
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        if row["success_rate"] is not None:
            groups.setdefault((row["method"], row["protocol"], row["demos"], row["labels"]), []).append(row)
    summary = []
    for (method, protocol, demos, labels), group in groups.items():
        rates = [r["success_rate"] for r in group]
        summary.append(
            {
                "method": method,
                "title": group[0]["title"],
                "protocol": protocol,
                "demos": demos,
                "labels": labels,
                **{key: _mean(r[key] for r in group) for key in ("agent_steps", "env_steps", "train_seconds")},
                "seeds": sorted(r["seed"] for r in group),
                "success_rate": sum(rates) / len(rates),
                "ci95": list(wilson(sum(r["successes"] for r in group) / len(group), group[0]["episodes"])),
                "lowest": min(rates),
                "highest": max(rates),
                "episodes": sum(r["episodes"] for r in group),
                "labelled_demos": group[0]["labelled_demos"],
            }
        )
    return summary


def _mean(values: Iterable[float | None]) -> int | None:
    known = [value for value in values if value is not None]
    return round(sum(known) / len(known)) if known else None
