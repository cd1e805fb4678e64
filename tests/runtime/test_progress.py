"""Lines of progress where there is no terminal."""

from __future__ import annotations

import pytest

from playslot_rl.runtime import progress
from playslot_rl.runtime.progress import StageProgress, format_seconds


class Clock:
    """Seconds that pass when told."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        monkeypatch.setattr(progress.time, "monotonic", lambda: self.now)


def test_steps_are_told_by_their_number_with_the_loss(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = Clock(monkeypatch)
    with StageProgress("slots", 2, 7, True, plain_every=2) as bar:
        for done in range(3, 8):
            clock.now += 0.5
            bar.update(done, {"loss": 0.25} if done == 4 else {})
    assert capsys.readouterr().err.splitlines() == [
        "slots: step 4/7, loss 0.25000, 2.00 steps/s, 2 s left",
        "slots: step 6/7, 2.00 steps/s, 0 s left",
        "slots: step 7/7, 2.00 steps/s, 0 s left",
    ]


def test_episodes_are_told_every_ten_seconds_and_at_the_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = Clock(monkeypatch)
    with StageProgress("collect expert", 10, 16, True, unit="episodes") as bar:
        for done in range(11, 17):
            clock.now += 4.0
            bar.update(done)
    assert capsys.readouterr().err.splitlines() == [
        "collect expert: 13/16, 0.2 episodes/s, 12 s left",
        "collect expert: 16/16, 0.2 episodes/s, 0 s left",
    ]


def test_nothing_is_told_where_it_is_switched_off(capsys: pytest.CaptureFixture[str]) -> None:
    with StageProgress("slots", 0, 1, False) as bar:
        bar.update(1)
    assert capsys.readouterr().err == ""


def test_durations_are_short() -> None:
    assert [format_seconds(s) for s in (41.6, 425, 10920)] == ["42 s", "7 min 05 s", "3 h 02 min"]
