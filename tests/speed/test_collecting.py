"""The benchmark of collecting: every part of an episode's way is timed, and the table says all of it."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

from playslot_rl.config import ExperimentConfig, from_dict

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from collect import Stopwatch, measure, table

pytestmark = pytest.mark.slow  # together they take a minute; make test-all runs them


def test_a_stopwatch_gives_inner_time_to_the_inner_block() -> None:
    watch = Stopwatch()
    with watch.running("outer"):
        time.sleep(0.01)
        with watch.running("inner"):
            time.sleep(0.03)
    assert 0.03 <= watch.seconds["inner"] < 0.3
    assert 0.01 <= watch.seconds["outer"] < watch.seconds["inner"]


def test_every_part_is_measured_and_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    small = {"env": {"image_size": 32, "warmup_steps": 1}, "render": {"supersample": 1}}
    figures = measure(from_dict(ExperimentConfig, small), "random", 2, [1], episodes=2, target=1000)
    assert list(figures["episode_ms"]) == [
        "rendering",
        "simulation",
        "policy and collector",
        "encoding (PNG)",
        "journal writing",
        "export: reading",
        "export: statistics",
        "export: writing",
        "export: other",
        "export: checking",
    ]
    assert all(ms > 0 for ms in figures["episode_ms"].values())
    far, each = figures["extrapolation"], figures["bytes_per_episode"]
    assert far["record_h"] == pytest.approx(1000 / figures["episodes_per_s"]["1"] / 3600)
    assert far["data_set_gb"] == pytest.approx(1000 * each["data set"] / 1e9)
    text = table(figures)
    assert all(f"| {name} |" in text for name in figures["episode_ms"])
    assert "1000 episodes with 1 workers" in text
    assert not list(tmp_path.glob("playslot*"))
