"""Jobs through Hydra's launchers, as far as one machine goes: processes, Ray, and Slurm with its commands imitated."""

from __future__ import annotations

import importlib.util
import json
import os
import stat
from pathlib import Path

import pytest

from playslot_rl.config.compare import LAUNCHERS
from playslot_rl.studies import launch
from playslot_rl.studies.launch import Status, log_file, write_status
from playslot_rl.studies.video.jobs import VideoJob

SBATCH = """#!/bin/bash
# Runs the array's tasks here, side by side, with the variables that Slurm sets.
cp "$1" "$SLURM_IMITATION/submitted.sh"
read -r first last <<< "$(sed -n 's/^#SBATCH --array=\\([0-9]*\\)-\\([0-9]*\\).*/\\1 \\2/p' "$1")"
for task in $(seq "$first" "$last"); do
  SLURM_JOB_ID=$((4243 + task)) SLURM_ARRAY_JOB_ID=4242 SLURM_ARRAY_TASK_ID=$task SLURM_NTASKS=1 SLURM_PROCID=0 \\
    SLURM_LOCALID=0 SLURM_NODEID=0 SLURM_JOB_NUM_NODES=1 SLURM_JOB_NODELIST=node1 \\
    bash "$1" > "$SLURM_IMITATION/task_$task.log" 2>&1 < /dev/null &
done
echo "Submitted batch job 4242"
"""
SRUN = """#!/bin/bash
while [[ "$1" != *python* ]]; do shift; done
exec "$@"
"""
SACCT = """#!/bin/bash
printf 'JobID|State|NodeList\\n4242_0|RUNNING|node1\\n4242_1|RUNNING|node1\\n'
"""


@pytest.fixture
def jobs(tmp_path: Path) -> list[Path]:
    """Two jobs that were done before: each starts, sees it, and ends."""
    made = [VideoJob("svg", seed, tmp_path / "out") for seed in (0, 1)]
    for job in made:
        job.file.parent.mkdir(parents=True, exist_ok=True)
        record = {"name": job.name, "fingerprint": "f", "kind": "video", "method": "svg", "seed": job.seed}
        job.file.write_text(json.dumps(record | {"out": str(job.out), "variant": ""}))
        write_status(job.file, Status("done", "f"))
        job.scores.parent.mkdir(parents=True)
        job.scores.write_text(json.dumps({"fingerprint": "f"}))
    return [job.file for job in made]


def sweep(files: list[Path], launcher: str, *overrides: str) -> None:
    if importlib.util.find_spec(LAUNCHERS[launcher]) is None:
        pytest.skip(f"needs {LAUNCHERS[launcher]}")
    launch.run_sweep(files, launcher, overrides)
    assert all(log_file(file).is_file() for file in files), "each was started in a process of its own"
    assert {launch.read_status(file).status for file in files} == {"done"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("launcher", "override"),
    [
        ("joblib", "hydra.launcher.n_jobs=2"),
        ("submitit_local", "hydra.launcher.timeout_min=5"),
        ("ray", "+hydra.launcher.ray.init.num_cpus=2"),
    ],
)
def test_jobs_run_on_one_machine(jobs: list[Path], launcher: str, override: str) -> None:
    sweep(jobs, launcher, override)


@pytest.mark.slow
def test_jobs_go_to_slurm_as_one_array_with_what_was_asked_for(
    jobs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = tmp_path / "commands"
    commands.mkdir()
    for name, text in {"sbatch": SBATCH, "srun": SRUN, "sacct": SACCT}.items():
        (commands / name).write_text(text)
        (commands / name).chmod(stat.S_IRWXU)
    monkeypatch.setenv("PATH", f"{commands}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("SLURM_IMITATION", str(tmp_path))
    asked = ("partition=gpu", "gpus_per_node=2", "cpus_per_task=8", "timeout_min=720", "array_parallelism=1")
    sweep(jobs, "submitit_slurm", *(f"hydra.launcher.{word}" for word in asked))
    submitted = (tmp_path / "submitted.sh").read_text()
    for line in ("partition=gpu", "gpus-per-node=2", "cpus-per-task=8", "time=720", "array=0-1%1"):
        assert f"#SBATCH --{line}\n" in submitted
