"""Trainings on several processes: the arguments that make a job's config, the command, and how it ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from playslot_rl.config import CompareConfig, ExperimentConfig, to_dict
from playslot_rl.config.compose import compose, spelled
from playslot_rl.config.method_keys import read_alone
from playslot_rl.config.methods import METHODS
from playslot_rl.errors import ConfigError, PlaySlotError
from playslot_rl.studies import launch
from playslot_rl.studies.launch import train_on_several, training_command
from playslot_rl.studies.success.jobs import SuccessJob, success_config, success_jobs, success_record
from playslot_rl.studies.video.jobs import VideoJob, video_config, video_record


def of(folder: Path, *typed: str, command: str = "compare") -> ExperimentConfig:
    named = ["preset=smoke", "env=block_push_easy", f"data.root={folder}/a, with = signs,{folder}/b", *typed]
    return compose([*named, "data.demos=demos", "dynamics.optim.lr=3e-4", "threads=1", "device=cpu"], command)


def test_every_job_of_a_comparison_is_spelled_as_arguments_that_make_it(tmp_path: Path) -> None:
    config = of(tmp_path, "methods=playslot,lapo", "demos=2", "seeds=1", "processes=2")
    assert config.compare.processes == 2
    plain = replace(config, compare=CompareConfig(evaluation_seed=3, processes=2))
    for job in success_jobs(config, tmp_path):
        own, command = success_config(plain, job, "pretrained/block_push_easy"), "train-baseline"
        assert read_alone(compose(spelled(own, command), command), command) == read_alone(own, command)


@pytest.mark.parametrize("method", ["svg", "playslot_m"])
def test_every_job_of_a_video_comparison_is_spelled_as_arguments_that_make_it(method: str, tmp_path: Path) -> None:
    config = of(tmp_path, "processes=3", f"compare_video.test={tmp_path}/held out", command="compare-video")
    job = VideoJob(method, 1, tmp_path / "out", "")  # type: ignore[arg-type]
    own = video_config(config, job, "pretrained/block_push_easy")
    command = "train-dynamics" if job.trained_as == "playslot" else "train-baseline"
    assert read_alone(compose(spelled(own, command), command), command) == read_alone(own, command)
    assert video_record(job, own, {}, lpips=False)["processes"] == 3


def test_a_config_that_no_arguments_make_is_refused(tmp_path: Path) -> None:
    config = of(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps(to_dict(replace(config, preset="compact"))))
    other = replace(config, run=str(tmp_path), out=str(tmp_path / "run"))
    with pytest.raises(ConfigError, match=r"run of another preset or task than smoke, block_push_easy, expected"):
        spelled(other, "train-dynamics")


def test_processes_are_no_part_of_a_jobs_identity_and_methods_that_act_have_one(tmp_path: Path) -> None:
    config = of(tmp_path)

    def record(method: str, processes: int) -> dict[str, object]:
        job = SuccessJob(method, None if METHODS[method].online else 2, 0, tmp_path)  # type: ignore[arg-type, index]
        plain = replace(config, compare=CompareConfig(processes=processes))
        return success_record(job, success_config(plain, job, "pretrained"), {})

    assert record("lapo", 1)["fingerprint"] == record("lapo", 4)["fingerprint"]
    assert [record(method, 4)["processes"] for method in ("lapo", "dreamer")] == [4, 1]
    with pytest.raises(ConfigError, match=r"compare.processes: got 0, expected"):
        compose(["preset=smoke", "processes=0"], "compare")


def test_a_training_is_started_by_torchrun_with_a_port_of_its_own(tmp_path: Path) -> None:
    job = SuccessJob("lapo", 2, 0, tmp_path)
    command = training_command("train-baseline", success_config(of(tmp_path), job, ""), 2)
    assert command[1:8] == [
        "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", "-m", "playslot_rl", "train-baseline",
    ]  # fmt: skip
    assert "method=lapo" in command


def stub(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    monkeypatch.setattr(launch, "training_command", lambda *_: [sys.executable, "-c", code])


@pytest.mark.integration
def test_the_first_line_of_error_is_the_jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said = "playslot train-baseline (rank 1): error: loss is nan at step 3, expected a finite number"
    peer = "playslot train-baseline: error: rank 0 of 2: another process ended"
    stub(monkeypatch, f"import sys; print('W torchrun', {said!r}, {peer!r}, sep='\\n', file=sys.stderr); sys.exit(1)")
    with pytest.raises(PlaySlotError, match=r"^loss is nan at step 3, expected a finite number$"):
        train_on_several("train-baseline", of(tmp_path), 2)
    stub(monkeypatch, "import os; os._exit(7)")
    with pytest.raises(PlaySlotError, match=r"^train-baseline on 2 processes: ended with exit code 7"):
        train_on_several("train-baseline", of(tmp_path), 2)


def test_a_training_that_ends_well_says_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stub(monkeypatch, f"open({str(tmp_path / 'ran')!r}, 'w')")
    train_on_several("train-baseline", of(tmp_path), 2)
    assert (tmp_path / "ran").is_file()


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux tells the children")
def test_a_job_that_is_killed_takes_its_training_with_it(tmp_path: Path) -> None:
    waits = f"import os, time; open({str(tmp_path / 'id')!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    code = (
        "import sys; from playslot_rl.studies import launch; from playslot_rl.config import ExperimentConfig; "
        f"launch.training_command = lambda *_: [sys.executable, '-c', {waits!r}]; "
        "launch.train_on_several('train-baseline', ExperimentConfig(), 2)"
    )
    job = subprocess.Popen([sys.executable, "-c", code])
    ends = time.monotonic() + 60
    while not ((tmp_path / "id").is_file() and (tmp_path / "id").read_text()) and time.monotonic() < ends:
        time.sleep(0.05)
    training = int((tmp_path / "id").read_text())
    assert alive(training)
    os.kill(job.pid, signal.SIGKILL)
    job.wait()
    ends = time.monotonic() + 10
    while alive(training) and time.monotonic() < ends:
        time.sleep(0.05)
    assert not alive(training)
