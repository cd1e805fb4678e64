"""Training returns held against published ones."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path

import pytest

from playslot_rl.cli import main
from playslot_rl.envs import task_config
from playslot_rl.errors import DataError
from playslot_rl.studies.published import DREAMER, Band, against, read_curve, summary, write_page

BAND = Band(20_000, 400.0, 300.0, 500.0)
TASK = "dmc_cartpole_balance"


def flat(value: float, last: int = 40_000) -> list[tuple[int, float]]:
    return [(frames, value) for frames in range(1000, last + 1, 1000)]


@pytest.mark.parametrize(
    ("value", "verdict"), [(300.0, "in the band"), (500.0, "in the band"), (299.0, "below"), (501.0, "above")]
)
def test_a_mean_return_lies_in_the_range_of_the_published_seeds_or_not(value: float, verdict: str) -> None:
    assert against([flat(value)], [BAND]) == [(BAND, value, verdict)]


def test_a_window_is_half_open_and_counts_when_it_is_over() -> None:
    """15,000 belongs to the window before, 25,000 to this one."""
    curve = [(15_000, 1000.0), (15_001, 100.0), (25_000, 300.0), (25_001, 1000.0)]
    assert BAND.of(curve) == 200.0
    assert BAND.of(curve[:3]) == 200.0
    assert BAND.of(curve[:2]) is None
    assert BAND.of([]) is None


def test_seeds_weigh_the_same_and_all_of_them_have_to_be_there() -> None:
    """However many episodes each has."""
    thin = [(20_000, 0.0), (40_000, 0.0)]
    assert against([flat(400.0), thin], [BAND]) == [(BAND, 200.0, "below")]
    assert against([flat(400.0), flat(400.0, last=20_000)], [BAND]) == [(BAND, None, "not reached")]
    assert against([], [BAND]) == [(BAND, None, "not reached")]


@pytest.mark.parametrize("task", DREAMER)
def test_published_numbers_are_ranges_of_returns_of_a_thousand_steps(task: str) -> None:
    bands = DREAMER[task]
    assert [band.frames for band in bands] == list(range(10_000, 150_001, 10_000))
    assert all(0 <= band.low <= band.mean <= band.high <= 1000 for band in bands)
    assert bands[-1].mean > 900 > bands[4].mean > bands[0].mean


def test_the_curve_is_of_training_episodes_over_the_simulators_steps(tmp_path: Path) -> None:
    rows = [
        {"step": 500, "split": "acting", "return": 250.0},
        {"step": 500, "split": "validation", "return_mean": 999.0},
        {"step": 1000, "split": "acting", "return": 260.0},
        {"step": 1000, "split": "train", "loss": 1.0},
    ]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert read_curve(tmp_path, task_config(TASK)) == [(1000, 250.0), (2000, 260.0)]
    (tmp_path / "metrics.jsonl").unlink()
    with pytest.raises(DataError, match="got no episodes"):
        read_curve(tmp_path, task_config(TASK))


def test_the_page_says_where_each_window_lies(tmp_path: Path) -> None:
    curves = {"seed 0": flat(600.0, 55_000), "seed 1": flat(610.0, 55_000)}
    page = write_page(curves, TASK, tmp_path)
    assert page.is_file()
    text = (tmp_path / "published.md").read_text()
    assert "| 50,000 | 613 | 543 to 680 | 605 | in the band |" in text
    assert "| 60,000 | 751 | 632 to 929 | - | not reached |" in text
    assert summary(list(curves.values()), TASK).startswith("return 605 around 50,000 frames, published 613")
    assert "no window is reached" in summary([flat(1.0, 3000)], TASK)


@pytest.mark.integration
@pytest.mark.skipif(find_spec("dm_control") is None, reason="needs the extra dmc")
def test_a_training_on_the_suite_ends_with_the_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["env.max_steps=12", "threads=1", "device=cpu", "logging.progress=false"]
    out = tmp_path / "run"
    assert main(["train-baseline", "method=dreamer", f"env={TASK}", "preset=smoke", *small, f"out={out}"]) == 0
    assert "no window is reached" in capsys.readouterr().out
    assert (out / "dreamer" / "published.html").is_file()
    curve = read_curve(out / "dreamer", task_config(TASK))
    assert [frames for frames, _ in curve] == [48, 96]  # a round is two episodes of twelve steps of two frames
    assert all(0 < value <= 24 for _, value in curve)
