"""What came out of a comparison: one row a job and protocol, their summary over training seeds, and the files
`comparison.json`, `comparison.md`, `comparison.png` and `comparison.svg`.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from playslot_rl.acting.episodes import TaskPool
from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import is_pretrained
from playslot_rl.config.methods import METHODS
from playslot_rl.evaluation.intervals import wilson
from playslot_rl.evaluation.seeds import check_disjoint, first_seed, training_seeds
from playslot_rl.evaluation.success import hardware, run_references
from playslot_rl.storage.atomic import write_bytes, write_json, write_text
from playslot_rl.storage.checkpoints import checkpoint_folder, provenance, read_stage
from playslot_rl.studies.launch import Status, read_status
from playslot_rl.studies.page import comparison_figure, comparison_page, failures
from playslot_rl.studies.plan import Job, latent_models, model_folder, uses_slots
from playslot_rl.training.runs import world_model_checkpoints, world_model_folder
from playslot_rl.visualization.charts import LIGHT, figure_bytes


def job_rows(job: Job, frame_skip: int, fingerprint: str | None = None) -> list[dict[str, Any]]:
    """One row for each protocol of a job, finished or not.

    Keys: `name`, `method`, `title`, `protocol`, `demos`, `labels` (see `Job`), `seed`,
    `status`, `error`, `labelled_demos`, `agent_steps`
    and `env_steps` (an agent step is `frame_skip` of them), `samples` (optimiser steps times batch),
    `success_rate`, `successes`, `episodes`, `ci95` (Wilson), `mean_steps_to_success`, `train_seconds`,
    `evaluation_seconds`, `parameters`, `pretraining`, `kept_rows` (share of the demonstrations' rows that trimming
    left; both null where there is nothing to say), `curve` (rows of an online method's learning curve, with both
    kinds of steps).

    Args:
        job: which one.
        frame_skip: environment steps in an agent step.
        fingerprint: of the job as it is asked for now; one that ended as another is `waiting`. None takes any.
    """
    status = read_status(job.file)
    if fingerprint is not None and status.fingerprint != fingerprint:
        status = Status()
    meta = read_json(job.run / job.stage / "checkpoint" / "meta.json") if status.status == "done" else {}
    rows = []
    for protocol in job.protocols:
        info = read_json(job.run / "evaluation" / protocol / "eval_info.json") if status.status == "done" else {}
        episodes, rate = info.get("episodes"), info.get("success_rate")
        rows.append(
            {
                "name": job.name,
                "method": job.method,
                "title": METHODS[job.method].title,
                "protocol": protocol,
                "demos": job.demos,
                "labels": job.labels,
                "seed": job.seed,
                "status": status.status,
                "error": status.error or None,
                "labelled_demos": None if METHODS[job.method].online else meta.get("labelled_demos"),
                "agent_steps": meta.get("env_steps"),
                "env_steps": None if meta.get("env_steps") is None else meta["env_steps"] * frame_skip,
                "samples": count_samples(job, meta),
                "success_rate": rate,
                "successes": None if rate is None else round(rate * info["episodes"]),
                "episodes": episodes,
                "ci95": info.get("ci95"),
                "mean_steps_to_success": info.get("mean_steps_to_success"),
                "train_seconds": meta.get("seconds"),
                "evaluation_seconds": info.get("wall_seconds"),
                "parameters": count_parameters(job.run, job.stage) if meta else None,
                "pretraining": meta.get("pretraining"),
                "kept_rows": meta.get("kept_rows"),
                "curve": learning_curve(job, frame_skip) if METHODS[job.method].online else None,
            }
        )
    return rows


def learning_curve(job: Job, frame_skip: int) -> list[dict[str, Any]] | None:
    """Rows of `RUN/METHOD/curve.json`, there before the job is done too; None without one."""
    rows = read_json(job.run / job.stage / "curve.json").get("rows") or []
    return [
        {**row, "agent_steps": row["env_steps"], "env_steps": row["env_steps"] * frame_skip} for row in rows
    ] or None


def count_samples(job: Job, meta: Mapping[str, Any]) -> int | None:
    """Examples a method's policy was trained on, repeats included: optimiser steps times batch."""
    config = read_json(job.run / job.stage / "checkpoint" / "config.json").get(job.stage, {})
    batch = config.get("batch_size", config.get("policy", {}).get("batch_size"))
    return None if batch is None or METHODS[job.method].online or not meta else int(meta.get("steps", 0)) * int(batch)


def count_parameters(run: Path, stage: str) -> int:
    """Floating-point numbers in a run's checkpoint and in those of its parents (weights, and a few buffers)."""
    from safetensors import safe_open

    parents = read_json(checkpoint_folder(run, stage) / "meta.json").get("parents", {})
    folders = [checkpoint_folder(run, stage)]
    for name in parents:
        own = checkpoint_folder(run, name)
        folders.append(own if own.is_dir() else checkpoint_folder(world_model_folder(run), name))
    count = 0
    for folder in folders:
        with safe_open(folder / "weights.safetensors", framework="pt") as file:
            slices = [file.get_slice(key) for key in file.keys()]  # noqa: SIM118  no mapping
            count += sum(math.prod(part.get_shape()) for part in slices if part.get_dtype().startswith(("F", "BF")))
    return count


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file, or nothing where it is missing or damaged: a row then has nulls."""
    try:
        values: dict[str, Any] = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return values


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of finished jobs, pooled over training seeds.

    Keys: `method`, `title`, `protocol`, `demos`, `labels`,
    `agent_steps`, `env_steps` and `train_seconds` (means), `seeds`, `success_rate` (mean
    over the seeds), `ci95`, `lowest` and `highest` (of a seed), `episodes`, `labelled_demos`.

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
                "title": METHODS[method].title,
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


class Comparison:
    """Gathers rows and writes them, at any time.

    Args:
        config: of the comparison, complete (`episodes`, `data`, `run`).
        out: its folder.
        jobs: all of them, with what their files say.
        began: `time.monotonic()` at the start of the command.
    """

    def __init__(
        self, config: ExperimentConfig, out: Path, jobs: Mapping[Job, Mapping[str, Any]], began: float
    ) -> None:
        self.config, self.out, self.jobs, self._began = config, out, jobs, began
        self._spent = float(read_json(out / "comparison.json").get("seconds", 0.0))
        self._references: dict[str, dict[str, Any]] = {}

    def references(self) -> None:
        """Run the random policy and the scripted expert on the evaluation episodes, or read what they did.

        Raises:
            ConfigError: an evaluation seed that a training data set holds.
        """
        config = self.config
        start = first_seed(config, config.compare.evaluation_seed)
        seeds = list(range(start, start + (config.episodes or 0)))
        check_disjoint(seeds, training_seeds(config))
        with TaskPool(config.env, config.render) as pool:
            found = run_references(None, config, seeds, pool, cache=self.out / "references.json")
        self._references = {name: found[name] for name in ("random", "expert")}

    def ended(self, job: Job) -> None:
        """Say how a job ended, and write what there is so far."""
        status = read_status(job.file)
        rates = [
            f"{100 * row['success_rate']:.0f} % in {row['protocol']}"
            for row in self._rows(job)
            if row["success_rate"] is not None
        ]
        print(f"{job.name}: {status.error or ', '.join(rates)} ({status.seconds:.0f} s)", flush=True)
        self.write(plot=False)

    def write(self, plot: bool = True) -> list[Mapping[str, Any]]:
        """Write the result; returns one row for each job that is not done.

        Raises:
            OutputError: full disk.
        """
        result = self.result()
        write_json(self.out / "comparison.json", result)
        write_text(self.out / "comparison.md", comparison_page(result))
        if plot:
            for kind in ("png", "svg"):
                figure = comparison_figure(result, LIGHT)
                write_bytes(self.out / f"comparison.{kind}", figure_bytes(figure, LIGHT, kind))
        return failures(result["rows"])

    def table(self) -> str:
        """The tables of `comparison.md`, without its footnotes."""
        page = comparison_page(self.result())
        return "\n".join(line for line in page.partition("## Footnotes")[0].splitlines() if line.startswith("|"))

    def result(self) -> dict[str, Any]:
        """What `comparison.json` holds."""
        config = self.config
        rows = [row for job in self.jobs for row in self._rows(job)]
        made = provenance()
        return {
            "env": config.env.name,
            "preset": config.preset,
            "methods": list(config.compare.methods),
            "demos": list(config.compare.demos),
            "labels": list(config.compare.labels),
            "seeds": list(config.compare.seeds),
            "episodes": config.episodes,
            "evaluation_seed": config.compare.evaluation_seed,
            "max_steps": config.env.max_steps,
            "jobs": len(self.jobs),
            "summary": summarise(rows),
            "references": self._references,
            "rows": rows,
            "world_model": self._world_model(),
            "latent_models": self._latent_models(),
            "learn_from_demos": config.collect.learn_from_demos,
            "frame_skip": config.env.frame_skip,
            "threads": config.threads,
            "seconds": round(self._spent + time.monotonic() - self._began, 1),
            "command": made["command"],
            "commit": made["commit"],
            "version": made["version"],
            "hardware": hardware(),
        }

    def _rows(self, job: Job) -> list[dict[str, Any]]:
        """A job's rows; what was done with other settings, data or parents than those asked for is still to be done."""
        return job_rows(job, self.config.env.frame_skip, str(self.jobs[job]["fingerprint"]))

    def _world_model(self) -> dict[str, Any] | None:
        if not uses_slots(self.config):
            return None
        stages = world_model_checkpoints(self.config.run)
        return {
            "source": self.config.run if is_pretrained(self.config.run) else Path(self.config.run).name,
            "fingerprints": {name: stage.fingerprint for name, stage in stages.items()},
            "seconds": sum(float(stage.meta.get("seconds", 0.0)) for stage in stages.values()),
            "episodes": stages["slots"].meta.get("episodes"),
        }

    def _latent_models(self) -> dict[str, dict[str, Any]]:
        """What all jobs of LAPO's share, and all of CADDY's, by stage."""
        found = {}
        for name in latent_models(self.config):
            stage = read_stage(checkpoint_folder(model_folder(self.out, name), name), name)
            found[name] = {key: stage.meta.get(key) for key in ("fingerprint", "seconds", "episodes")}
        return found
