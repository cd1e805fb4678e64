"""The engine of jobs, with a measure of its own: what is run, in which order, what is written, and what is said."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import compose
from playslot_rl.errors import PlaySlotError
from playslot_rl.storage.atomic import write_json
from playslot_rl.studies import launch
from playslot_rl.studies.launch import Status, write_status
from playslot_rl.studies.study import FOOTNOTES, Evaluate, Job, Record, Result, open_jobs_notes, run_study
from playslot_rl.visualization.charts import Theme, new_figure
from playslot_rl.visualization.document import Document, Linked, Notes, Section, Table


@dataclass(frozen=True)
class Throw(Job):
    """A die that is thrown."""

    method: str
    seed: int
    out: Path

    name = property(lambda self: f"{self.method}-s{self.seed}")
    title = property(lambda self: self.method.title())
    stage = property(lambda self: self.method)
    wave = property(lambda self: self.seed)


def _page(result: Result) -> Document:
    rows = [[row["name"], str(row["eyes"])] for row in result["rows"]]
    sections = [Section("Eyes", [Table(["throw", "eyes"], rows)])]
    notes = Section(FOOTNOTES, [Notes(open_jobs_notes(result["rows"], "throws")), Table(["unprinted"], [["x"]])])
    return Document("Dice", "Thrown.", [*sections, notes], [Linked("Eyes", "dice.png")])


def _figure(result: Result, theme: Theme) -> Figure:
    return new_figure(1, 1)


@dataclass
class Dice:
    """A measure in so many lines."""

    config: ExperimentConfig
    fingerprint: str = "f"
    launcher: tuple[str, Sequence[str]] = ("", ())
    checked: list[bool] = field(default_factory=list)
    command = "throw"
    name = "dice"
    unit = "throws"
    page = staticmethod(_page)
    figure = staticmethod(_figure)

    def check(self) -> None:
        self.checked.append(Path(self.config.out).exists())

    def prepare(self) -> Mapping[Throw, Record]:
        throws = [Throw(method, seed, Path(self.config.out)) for seed in (0, 1) for method in ("red", "blue")]
        return {throw: {"name": throw.name, "fingerprint": self.fingerprint} for throw in throws}

    @staticmethod
    def run(record: Record, evaluate: Evaluate) -> None:
        raise NotImplementedError

    @staticmethod
    def agrees(record: Record) -> bool:
        return bool(record["fingerprint"])

    def rows(self, job: Throw, status: Status) -> list[dict[str, Any]]:
        eyes = job.seed + 1 if status.status == "done" else None
        return [{"name": job.name, "status": status.status, "error": status.error or None, "eyes": eyes}]

    def said(self, rows: Sequence[Mapping[str, Any]]) -> str:
        return ", ".join(f"{row['eyes']} eyes" for row in rows if row["eyes"])

    def result(self, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        return {"rows": list(rows)}

    def sheets(self) -> Mapping[str, bytes]:
        return {"table": b"wood"}


Started = list[str]


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Started:
    """Jobs that were started; all end well but `blue-s1`."""
    names: Started = []

    def run(file: Path) -> Status:
        names.append(file.stem)
        bad = file.stem == "blue-s1"
        status = Status("failed" if bad else "done", json.loads(file.read_text())["fingerprint"], "lost" * bad, 2.0)
        write_status(file, status)
        return status

    monkeypatch.setattr(launch, "run_process", run)
    monkeypatch.setattr(launch, "run_sweep", lambda files, *_: [*map(run, files), names.append("|")])
    return names


@pytest.fixture
def dice(tmp_path: Path) -> Callable[..., Dice]:
    config = replace(compose(["preset=smoke"]), out=str(tmp_path / "out"))
    return lambda **changes: Dice(config, **changes)


def test_what_is_not_done_is_run_and_a_failure_is_said_at_the_end(
    dice: Callable[..., Dice], started: Started, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = dice()
    with pytest.raises(PlaySlotError, match=r"^throw: 1 of 4 throws failed \(blue-s1\), the others finished; "):
        run_study(asked)
    assert asked.checked == [False], "checked before anything is written"
    assert started == ["red-s0", "blue-s0", "red-s1", "blue-s1"]
    said = capsys.readouterr().out
    assert "red-s1: 2 eyes (2 s)\nblue-s1: lost (2 s)\n| throw | eyes |\n" in said
    assert "unprinted" not in said
    out = tmp_path / "out"
    assert {path.suffix for path in out.glob("dice.*")} == {".json", ".md", ".png", ".svg"}
    assert (out / "table.png").read_bytes() == b"wood"
    page = (out / "dice.md").read_text()
    assert page.startswith("# Dice\n\nThrown.\n\n![Eyes](dice.png)\n\n## Eyes\n\n| throw | eyes |\n")
    assert "- **blue-s1: failed.** lost\n- Failures: 1 of 4 throws, see above.\n" in page
    result = json.loads((out / "dice.json").read_text())
    assert list(result) == ["env", "preset", "rows", "seconds", "command", "commit", "version", "hardware"]

    started.clear()
    with pytest.raises(PlaySlotError):
        run_study(dice())
    assert started == ["blue-s1"]
    assert capsys.readouterr().out.count("done before, skipped") == 3


def test_a_job_that_is_asked_for_otherwise_is_run_again_and_waits_until_then(
    dice: Callable[..., Dice], started: Started, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(PlaySlotError):
        run_study(dice())
    started.clear()

    def interrupted(file: Path) -> Status:
        raise KeyboardInterrupt(file)

    with monkeypatch.context() as patch:
        patch.setattr(launch, "run_process", interrupted)
        with pytest.raises(KeyboardInterrupt, match="throw interrupted; the same command carries on in"):
            run_study(dice(fingerprint="g"))
    rows = json.loads((tmp_path / "out" / "dice.json").read_text())["rows"]
    assert {(row["status"], row["eyes"]) for row in rows} == {("waiting", None)}
    assert "Not finished: 4 of 4 throws" in (tmp_path / "out" / "dice.md").read_text()
    with pytest.raises(PlaySlotError):
        run_study(dice(fingerprint="g"))
    assert len(started) == 4


def test_a_job_whose_result_was_written_over_is_run_again(
    dice: Callable[..., Dice], started: Started, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(PlaySlotError):
        run_study(dice())
    started.clear()
    monkeypatch.setattr(Dice, "agrees", staticmethod(lambda record: record["name"] != "red-s0"))
    with pytest.raises(PlaySlotError, match=r"2 of 4 throws failed \(red-s0, blue-s1\)"):
        run_study(dice())
    assert started == ["red-s0", "blue-s1"]


def test_a_launcher_gets_wave_after_wave(dice: Callable[..., Dice], started: Started) -> None:
    with pytest.raises(PlaySlotError):
        run_study(dice(launcher=("basic", ())))
    assert started == ["red-s0", "blue-s0", "|", "red-s1", "blue-s1", "|"]


def test_a_folder_of_something_else_is_left_alone(dice: Callable[..., Dice], started: Started, tmp_path: Path) -> None:
    write_json(tmp_path / "out" / "notes.json", {})
    with pytest.raises(PlaySlotError, match="holds something else"):
        run_study(dice())
    assert (started, [path.name for path in (tmp_path / "out").iterdir()]) == ([], ["notes.json"])
