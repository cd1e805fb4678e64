"""A study: methods side by side, by one measure. Runs the jobs that are not done and writes `OUT/NAME.json`, its page
`NAME.md`, its plot `NAME.png` and `.svg`, and what pictures the measure has.

A job is a file, `OUT/jobs/NAME.json`, that says everything; `python -m playslot_rl.recipes.compare_job FILE` runs it,
on any machine that sees the folder, and running it again carries on or does nothing.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import is_pretrained
from playslot_rl.config.methods import METHODS
from playslot_rl.config.roles import naming
from playslot_rl.config.weights import data_roots, is_remote
from playslot_rl.errors import PlaySlotError
from playslot_rl.evaluation.success import hardware
from playslot_rl.runs import Run
from playslot_rl.storage.atomic import json_or_nothing, write_bytes, write_json, write_text
from playslot_rl.storage.checkpoints import provenance
from playslot_rl.studies import launch
from playslot_rl.visualization.charts import LIGHT, Theme, figure_bytes
from playslot_rl.visualization.document import Document, to_markdown

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Job(ABC):
    """What a job of any study has.

    Attributes:
        method: what is trained.
        seed: of the training.
        out: folder of the study.
        wave: jobs of a lower wave end before a launcher starts those of a higher one.
    """

    method: str
    seed: int
    out: Path

    @property
    @abstractmethod
    def name(self) -> str:
        """Of its folder, and a word to Hydra, which `=` would end."""

    @property
    @abstractmethod
    def title(self) -> str:
        """As tables and plots name it."""

    @property
    @abstractmethod
    def stage(self) -> str:
        """Stage of the run whose checkpoint is the method's."""

    @property
    def wave(self) -> int:
        return 0

    @property
    def file(self) -> Path:
        """What it is told."""
        return self.out / "jobs" / f"{self.name}.json"

    @property
    def run(self) -> Path:
        """The run folder it writes."""
        return self.out / "runs" / self.name


def fingerprint_of(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def computed(config: ExperimentConfig) -> dict[str, Any]:
    """What a job's config says of what it computes; jobs from before clips could be drawn are the same jobs."""
    result = naming(config)
    if not config.data.drawn:
        del result["data"]["drawn"]
    return result


def absolute(path: str) -> str:
    """A path from the root; nothing, shipped models (`pretrained/ENV`) and addresses on the Hub as they are."""
    return path if not path or is_pretrained(path) or is_remote(path) else str(Path(path).expanduser().resolve())


def absolute_roots(text: str) -> str:
    """`data.root` with every folder from the root; weights stay."""
    return ",".join(root._replace(path=absolute(root.path)).text for root in data_roots(text))


def job_config(config: ExperimentConfig, job: Job, method: str, world: str, **data: Any) -> ExperimentConfig:
    """What any job trains with: paths are absolute, so that it runs from any folder; `world` is the run that methods on
    slots build on, `data` are changes of that group.
    """
    own = config.data
    return replace(
        config,
        method=method,
        seed=job.seed,
        data=replace(own, root=absolute_roots(own.root), cache=absolute(own.cache), **data),
        out=absolute(str(job.run)),
        run=absolute(world) if METHODS[method].slots else "",
        logging=replace(config.logging, progress=False),
    )


def count_parameters(run: Run, stage: str) -> int:
    """Floating-point numbers in a run's checkpoint and in those of its parents (weights, and a few buffers)."""
    from safetensors import safe_open

    folders = [run.place(stage)]
    for name in json_or_nothing(run.place(stage) / "meta.json").get("parents", {}):
        folders.append(run.place(name) if run.place(name).is_dir() else run.world_run.place(name))
    count = 0
    for folder in folders:
        with safe_open(folder / "weights.safetensors", framework="pt") as file:
            slices = [file.get_slice(key) for key in file.keys()]  # noqa: SIM118  no mapping
            count += sum(math.prod(part.get_shape()) for part in slices if part.get_dtype().startswith(("F", "BF")))
    return count


def made_by(meta: Mapping[str, Any], status: launch.Status) -> dict[str, list[str]]:
    """`commits` and `processors` that trained a job, as its checkpoint's `meta` says, and that measured it."""
    kinds = {str(meta.get("processor", "")), status.processor} - {""}
    return {"commits": sorted({str(meta.get("commit", "")), status.commit} - {""}), "processors": sorted(kinds)}


Record = Mapping[str, Any]
"""What a job's file says; `fingerprint` names it."""
Result = Mapping[str, Any]
"""What `OUT/NAME.json` holds."""
Evaluate = Callable[[ExperimentConfig], object]
"""`playslot evaluate` without a report, which lies above in the layers."""
FOOTNOTES = "Footnotes"


class Measure[J: Job](Protocol):
    """What methods are measured by, and all that a study asks of it.

    Attributes:
        command: that was typed.
        name: of the files that are written.
        unit: what messages call a job.
        config: of the study; `out` is its folder, and `prepare` completes it.
        launcher: Hydra's name of what runs the jobs (empty: one after the other), and overrides for Hydra.
    """

    command: str
    name: str
    unit: str
    config: ExperimentConfig
    launcher: tuple[str, Sequence[str]]

    def check(self) -> None:
        """Refuse what cannot be measured, before anything is written or computed, by a ConfigError, DataError or
        CheckpointError.
        """

    def prepare(self) -> Mapping[J, Record]:
        """Make what the jobs share, finished parts excepted; all jobs, in the order in which they run."""

    @staticmethod
    def run(record: Record, evaluate: Evaluate) -> None:
        """Do what a job's file says, in a process of its own; what is done is skipped."""

    @staticmethod
    def agrees(record: Record) -> bool:
        """Whether what lies in the folder of a job that ended is still its result; else it is due again."""

    def rows(self, job: J, status: launch.Status) -> list[dict[str, Any]]:
        """What came out of a job, finished or not; each row has its `name`, `status` and `error`."""

    def said(self, rows: Sequence[Mapping[str, Any]]) -> str:
        """A finished job's rows in a few words."""

    def result(self, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """The measure's part of the result."""

    @property
    def page(self) -> Callable[[Result], Document]:
        """What is read; its last sections, from `FOOTNOTES` on, are not printed."""

    @property
    def figure(self) -> Callable[[Result, Theme], Figure]:
        """The plot."""

    def sheets(self) -> Mapping[str, bytes]:
        """Further pictures, PNG, by name."""


class Study[J: Job]:
    """Jobs under way, with what their files say, and what there is of their results; `began` is of `time.monotonic`."""

    def __init__(self, measure: Measure[J], jobs: Mapping[J, Record], began: float) -> None:
        self._measure, self._jobs, self._began = measure, jobs, began
        self._own = set[J]()  # done, and seen to have their own result: looking takes longer than reading a status
        self._out = Path(measure.config.out)
        self._spent = float(json_or_nothing(self._out / f"{measure.name}.json").get("seconds", 0.0))

    def run(self) -> None:
        """Write every job's file, and run those that are not done as they stand there. After Ctrl-C, or where the
        launcher itself failed (PlaySlotError), what there is has been written.
        """
        command, due = self._measure.command, self._due()
        launcher, hydra = self._measure.launcher
        print(f"{command}: {len(due)} of {len(self._jobs)} jobs to run", flush=True)
        try:
            if launcher:
                for wave in sorted({job.wave for job in due}):
                    launch.run_sweep([job.file for job in due if job.wave == wave], launcher, hydra)
            else:
                for job in due:
                    launch.run_process(job.file)
                    self._ended(job)
        except KeyboardInterrupt:
            self.write()
            raise KeyboardInterrupt(f"{command} interrupted; the same command carries on in {self._out}") from None
        except PlaySlotError:
            self.write()
            raise

    def _due(self) -> list[J]:
        due = []
        for job, record in self._jobs.items():
            write_json(job.file, record)
            if self._status(job).status == "done":
                print(f"{job.name}: done before, skipped", flush=True)
            else:
                due.append(job)
        return due

    def _status(self, job: J) -> launch.Status:
        record = self._jobs[job]
        status = launch.read_status(job.file, record["fingerprint"])
        if status.status == "done" and job not in self._own:
            if not self._measure.agrees(record):
                return launch.Status()
            self._own.add(job)
        return status

    def _ended(self, job: J) -> None:
        status = self._status(job)
        said = status.error or self._measure.said(self._measure.rows(job, status)) or status.status
        print(f"{job.name}: {said} ({status.seconds:.0f} s)", flush=True)
        self.write(pictures=False)

    def write(self, pictures: bool = True) -> tuple[Document, list[str]]:
        """Write the result; returns its page, and the names of jobs that are not done."""
        measure, rows = self._measure, [row for job in self._jobs for row in self._measure.rows(job, self._status(job))]
        result = self._result(rows)
        page = measure.page(result)
        write_result(self._out / measure.name, result, page, measure.figure if pictures else None)
        for name, sheet in measure.sheets().items() if pictures else ():
            write_bytes(self._out / f"{name}.png", sheet)
        return page, list(dict.fromkeys(str(row["name"]) for row in rows if row["status"] != "done"))

    def _result(self, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        config = self._measure.config
        return {
            "env": config.env.full_name,
            "preset": config.preset,
            **self._measure.result(rows),
            "seconds": round(self._spent + time.monotonic() - self._began, 1),
            **origin(),
        }


def origin() -> dict[str, Any]:
    """`command`, `commit`, `version` and `hardware` of this process."""
    made = provenance()
    return {**{key: made[key] for key in ("command", "commit", "version")}, "hardware": hardware()}


def write_result(place: Path, result: Result, page: Document, figure: Callable[[Result, Theme], Figure] | None) -> None:
    """Write `PLACE.json` and `.md`, and with a figure `.png` and `.svg`."""
    write_json(place.with_suffix(".json"), result)
    write_text(place.with_suffix(".md"), to_markdown(page))
    if figure is not None:
        for kind in ("png", "svg"):
            write_bytes(place.with_suffix(f".{kind}"), figure_bytes(figure(result, LIGHT), LIGHT, kind))


def run_study[J: Job](measure: Measure[J]) -> None:
    """Run what is missing, reuse what is done, write and print the result.

    Raises:
        ConfigError, DataError, CheckpointError: what is asked for cannot be compared; before anything is computed.
        PlaySlotError: a job failed; the others have finished, and the page says so.
        KeyboardInterrupt: Ctrl-C; the same command carries on.
    """
    check_study(measure)
    if failed := compute_study(measure):
        raise PlaySlotError(failed)


def check_study[J: Job](measure: Measure[J]) -> None:
    """Refuse what cannot be measured, before anything is written or computed."""
    launch.require_launcher(measure.launcher[0])
    measure.check()
    launch.open_comparison(Path(measure.config.out))


def compute_study[J: Job](measure: Measure[J]) -> str:
    """What is left of `run_study` after its checks; which jobs failed, in one line, or nothing."""
    began, out, command = time.monotonic(), Path(measure.config.out), measure.command
    with launch.comparison_lock(out):
        jobs = measure.prepare()
        study = Study(measure, jobs, began)
        study.run()
        page, left = study.write()
    print(tables(page), flush=True)
    path = out / f"{measure.name}.md"
    print(f"{command}: {time.monotonic() - began:.0f} s, {path}", flush=True)
    if not left:
        return ""
    return (
        f"{command}: {len(left)} of {len(jobs)} {measure.unit} failed ({', '.join(left)}), the others finished; "
        f"{path} says why, and the same command tries them again"
    )


def tables(page: Document) -> str:
    """Those of a page, as Markdown, up to its footnotes."""
    text = to_markdown(page).partition(f"## {FOOTNOTES}")[0]
    return "\n".join(line for line in text.splitlines() if line.startswith("|"))


def open_jobs_notes(rows: Sequence[Result], unit: str) -> list[str]:
    """A footnote for each job that failed, and one for those that have not had their turn."""
    jobs = {row["name"]: row for row in rows}
    failed = [row for row in jobs.values() if row["status"] == "failed"]
    waiting = [name for name, row in jobs.items() if row["status"] not in ("done", "failed")]
    notes = [f"**{row['name']}: failed.** {row['error'] or ''}".rstrip() for row in failed]
    notes.append(f"Failures: {len(failed)} of {len(jobs)} {unit}, see above." if failed else "Failures: none.")
    if waiting:
        notes.append(f"Not finished: {len(waiting)} of {len(jobs)} {unit}; the same command carries on.")
    return notes


def origin_notes(rows: Sequence[Result]) -> list[str]:
    """Of which commit and kind of processor the finished jobs are; where they differ, which are of which."""
    notes, jobs = [], {row["name"]: row for row in rows if row["status"] == "done"}
    for key, what in (("commits", "commit"), ("processors", "kind of processor")):
        found: dict[str, list[str]] = {}
        for name, row in jobs.items():
            for one in row.get(key) or ["unknown"]:
                found.setdefault(one, []).append(name)
        if len(found) == 1:
            notes.append(f"Every job is of one {what}: {next(iter(found))}.")
        elif found:
            most = max(found, key=lambda one: len(found[one]))
            others = [f"{one}: {', '.join(names)}" for one, names in found.items() if one != most]
            parts = [f"{most}: {len(found[most])} of {len(jobs)} jobs", *others]
            notes.append(f"**Jobs are of more than one {what}.** {'; '.join(parts)}.")
    return notes


def machine_note(result: Result) -> str:
    """The footnote on command, commit and machine, without its full stop."""
    at = result["hardware"]
    where = f"{at['machine']}, {at['cores']} cores, {at['gpu'] or 'no GPU'}"
    return f"Made by `{result['command']}` at commit {result['commit'] or 'unknown'}; {where}"
