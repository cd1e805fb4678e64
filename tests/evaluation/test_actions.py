"""The error of actions, against numbers that are worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.acting.actor import ReactiveActor
from playslot_rl.data.action_limits import ActionLimits
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.errors import DataError
from playslot_rl.evaluation.actions import _require_alike, measure_actions
from playslot_rl.modules.action_range import ActionRange

LENGTHS = (4, 3)


class _Read(nn.Module):
    """In [-1, 1], what the frame's first two bytes say of [0, 100] and [200, 400]; the actor undoes the scaling."""

    def __init__(self) -> None:
        super().__init__()
        self.action_range = ActionRange(2)
        self.action_range.take(torch.tensor([0.0, 200.0]), torch.tensor([100.0, 400.0]))

    def forward(self, pixels: Tensor) -> Tensor:
        return pixels[:, :2, 0, 0].float() / 50 - 1


def recorded(said: list[list[int]], done: list[list[float]]) -> EpisodeFrames:
    """Two episodes whose frames say, in percent of each range, what the actor will do."""
    frames = np.zeros((sum(LENGTHS), 8, 8, 3), np.uint8)
    frames[:, 0, 0, :2] = said
    lengths = np.array(LENGTHS)
    starts, actions = np.cumsum(lengths) - lengths, np.float32(done)
    return EpisodeFrames(frames, starts, lengths, actions, None, "print", 10.0, "", "camera")


@pytest.fixture
def actor() -> ReactiveActor:
    return ReactiveActor(TensorDictModule(_Read(), in_keys=[keys.PIXELS], out_keys=[keys.ACTION]))


TAUGHT = {"action_mean": [50.0, 300.0], "action_deviation": [10.0, 0.0]}


def test_errors_are_in_the_units_of_the_set_and_of_transitions_alone(actor: ReactiveActor) -> None:
    said = [[50, 50], [60, 50], [40, 50], [99, 99], [50, 50], [50, 55], [99, 99]]
    done = [[50.0, 300], [50, 300], [50, 310], [0, 0], [70, 300], [50, 300], [0, 0]]  # an episode's last is padding
    result = measure_actions(actor, recorded(said, done), TAUGHT, [0, 1])
    assert (result["episodes"], result["rows"]) == (2, 5)
    first, second = result["per_dimension"]
    assert (first["name"], first["constant_mae"]) == ("action_0", 4.0)
    assert first["mae"] == pytest.approx(8.0)
    assert first["rmse"] == pytest.approx(np.sqrt((100 + 100 + 400) / 5))
    assert (second["mae"], second["constant_mae"]) == (pytest.approx(4.0), pytest.approx(2.0))
    assert result["mae"] == pytest.approx(6.0)
    assert result["rmse"] == pytest.approx((first["rmse"] + second["rmse"]) / 2)
    assert result["r2"] == pytest.approx(1 - 600 / 400), "the second joint never moved in training: it does not count"
    # The step before: constant, 0, 0 | constant, 20, and of the other joint 0, 0, 10 | 0, 0.
    assert result["references"]["previous"]["mae"] == pytest.approx(((20 + 20) / 5 + 10 / 5) / 2)
    assert result["per_episode"]["mae"] == pytest.approx([((20 / 3) + (10 / 3)) / 2, (20 / 2 + 10 / 2) / 2])


def test_the_constant_is_zero_and_no_error_is_one(actor: ReactiveActor) -> None:
    said = [[10, 0], [20, 0], [30, 0], [0, 0], [40, 0], [90, 0], [0, 0]]
    done = [[float(a), 200.0] for a, _ in said]
    result = measure_actions(actor, recorded(said, done), TAUGHT, [0, 1])
    assert result["mae"] == pytest.approx(0, abs=1e-5)
    assert result["r2"] == pytest.approx(1)
    constant = result["references"]["constant"]
    assert (constant["r2"], constant["ci95"]["r2"]) == (0.0, [0.0, 0.0])
    low, high = constant["ci95"]["mae"]
    assert low < constant["mae"] < high


TURNED = {"names": ["pan", "lift", "grip"], "low": [-90.0, -110.0, 1.0], "high": [50.0, 30.0, 1.0]}


@pytest.mark.parametrize(
    ("first", "other", "line"),
    [
        (
            [0, 40, 5],
            [40, 60, 5],
            "got lift 40..60, where the policy was taught lift -110..30: are the units the same?",
        ),
        ([0, -70, 5], [40, -50, 5], ""),
        ([0, -1, 5], [0.7, 0.5, 5], "got pan 0..0.7, lift -1..0.5, where the policy was taught pan -90..50, lift"),
    ],
)
def test_another_unit_is_said(
    first: list[float], other: list[float], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    source = recorded([[0, 0]] * 7, [[np.nan] * 3, first, *[other] * 5])
    _require_alike(source, {"actions": TURNED})
    assert line in (told := capsys.readouterr().err)
    assert line or not told
    _require_alike(source, {})
    assert not capsys.readouterr().err


def test_a_reading_that_is_none_is_not_taken_for_another_unit(capsys: pytest.CaptureFixture[str]) -> None:
    """The largest is an outlier, which the set's limits leave out."""
    low, high, far = np.float32([[0, -70, 5], [40, -50, 5], [9e4, 9e4, 5]])
    source = recorded([[0, 0]] * 7, [[0, -70, 5], [9e4, 9e4, 5], *[[40, -50, 5]] * 5])
    _require_alike(
        replace(source, limits=ActionLimits(("pan", "lift", "grip"), low, high, low, far)), {"actions": TURNED}
    )
    assert not capsys.readouterr().err


def test_actions_in_another_order_are_refused_and_another_rate_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    ends = np.float32([1, 1, 1])
    source = recorded([[0, 0]] * 7, [[0, -70, 5], *[[40, -50, 5]] * 6])
    source = replace(source, limits=ActionLimits(("lift", "pan", "grip"), -ends, ends, -ends, ends))
    with pytest.raises(DataError, match="got actions in the order lift, pan, grip, expected pan, lift, grip, as"):
        _require_alike(source, {"actions": TURNED})
    _require_alike(source, {"fps": 30})
    assert "got 10 frames a second, where the policy was taught by 30" in capsys.readouterr().err


def test_actions_that_are_not_known_do_not_count(actor: ReactiveActor) -> None:
    said = [[50, 50]] * 7
    done = [[50.0, 300], [np.nan, 300], [60, 300], [0, 0], [np.nan] * 2, [np.nan] * 2, [0, 0]]
    source = recorded(said, done)
    result = measure_actions(actor, source, TAUGHT, [0, 1])
    assert result["rows"] == 2
    assert result["per_dimension"][0]["mae"] == pytest.approx(5.0)
    assert result["references"]["previous"]["mae"] == pytest.approx(2.5), "after an unknown action, the constant"
