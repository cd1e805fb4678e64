"""The result of a comparison on disk: `comparison.json`, `comparison.md`, `comparison.png` and `comparison.svg`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from playslot_rl.acting.episodes import TaskPool
from playslot_rl.comparison.plan import Job, uses_slots
from playslot_rl.comparison.results import failures, job_rows, read_json, summarise
from playslot_rl.comparison.status import read_status
from playslot_rl.comparison.table import comparison_page
from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import shipped
from playslot_rl.evaluation.references import run_references
from playslot_rl.evaluation.seeds import check_disjoint, first_seed, training_seeds
from playslot_rl.evaluation.success import hardware
from playslot_rl.storage.atomic import write_bytes, write_json, write_text
from playslot_rl.storage.checkpoints import checkpoint_folder, provenance, read_stage
from playslot_rl.training.runs import world_model_checkpoints
from playslot_rl.visualization.charts import figure_bytes
from playslot_rl.visualization.comparison import comparison_figure
from playslot_rl.visualization.palette import LIGHT


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
        config, episodes = self.config, self.config.episodes or 0
        start = first_seed(config, config.compare.evaluation_seed)
        seeds = list(range(start, start + episodes))
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
            "seeds": list(config.compare.seeds),
            "episodes": config.episodes,
            "evaluation_seed": config.compare.evaluation_seed,
            "max_steps": config.env.max_steps,
            "jobs": len(self.jobs),
            "summary": summarise(rows),
            "references": self._references,
            "rows": rows,
            "world_model": self._world_model(),
            "lapo_model": self._lapo_model(),
            "learn_from_demos": config.collect.learn_from_demos,
            "frame_skip": config.env.frame_skip,
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
            "source": self.config.run if shipped(self.config.run) else Path(self.config.run).name,
            "fingerprints": {name: stage.fingerprint for name, stage in stages.items()},
            "seconds": sum(float(stage.meta.get("seconds", 0.0)) for stage in stages.values()),
            "episodes": stages["slots"].meta.get("episodes"),
        }

    def _lapo_model(self) -> dict[str, Any] | None:
        """What all of LAPO's jobs share."""
        if "lapo" not in self.config.compare.methods:
            return None
        stage = read_stage(checkpoint_folder(self.out / "lapo_world", "lapo_model"), "lapo_model")
        names = ("fingerprint", "seconds", "episodes")
        return {name: stage.meta.get(name) for name in names}
