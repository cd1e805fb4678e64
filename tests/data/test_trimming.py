"""Still stretches are left out by what the videos show, never by an action, and rows stay together."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from playslot_rl.data.demonstrations import (
    Demonstrations,
    label_demonstrations,
    moving_frames,
    moving_rows,
    moving_slots,
    slot_motion,
    transitions,
    with_copies,
)
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.errors import DataError
from playslot_rl.testing import tiny_agent


def video(moves: list[list[int]]) -> EpisodeFrames:
    """Episodes whose frames change where `moves` says 1, with actions that are not numbers."""
    frames, lengths = [], []
    for episode in moves:
        level = np.cumsum([0, *episode]) * 20
        frames.append(np.broadcast_to(level[:, None, None, None], (len(level), 64, 64, 3)).astype(np.uint8))
        lengths.append(len(level))
    whole = np.concatenate(frames)
    starts = np.cumsum([0, *lengths[:-1]])
    return EpisodeFrames(
        frames=whole, starts=starts, lengths=np.array(lengths), actions=np.full((len(whole), 4), np.nan, np.float32),
        seeds=None, fingerprint="f", fps=10.0, task="", camera="",
    )  # fmt: skip


def slots_of(source: EpisodeFrames) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Slots that move as the frames do: (F, 4, 32)."""
    level = np.asarray(source.frames)[:, :1, :1, 0].astype(np.float32) / 20
    rise = np.arange(1, 33, dtype=np.float32) / 32
    return np.repeat(level * rise, 4, axis=1).reshape(len(level), 4, 32)


def test_motion_is_the_rms_change_of_the_slots() -> None:
    slots = torch.zeros(3, 2, 4)
    slots[1] = 0.5
    slots[2] = 0.5
    slots[2, 0] = 1.5
    assert slot_motion(slots).tolist() == pytest.approx([0.5, 0.5**0.5])


def test_a_margin_follows_each_stretch_and_stays_in_its_episode() -> None:
    motion = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0])
    step = torch.tensor([0, 1, 2, 3, 4, 0, 1, 2])  # the second episode never moves
    assert moving_rows(motion, step, 0.5, 0).tolist() == [True, False, False, False, True, False, False, False]
    assert moving_rows(motion, step, 0.5, 2).tolist() == [True, True, True, False, True, False, False, False]
    assert moving_rows(motion, step, 0.5, 100).tolist() == [True] * 5 + [False] * 3


def test_a_threshold_that_leaves_nothing_is_refused() -> None:
    with pytest.raises(
        DataError, match=r"behaviour\.trim: got 3, which leaves none of 2 transitions, expected less than .* 2"
    ):
        moving_rows(torch.tensor([2.0, 1.0]), torch.arange(2), 3.0, 2)
    source = video([[1, 0]])
    with pytest.raises(DataError, match=r"behaviour\.trim_pixels: got 0\.9"):
        moving_frames(source, 0.9, 0)


def test_slots_and_frames_that_move_together_are_trimmed_alike() -> None:
    source = video([[1, 1, 0, 0, 0], [0, 0, 1, 0]])
    by_frames = moving_frames(source, 0.01, 1)
    by_slots = moving_slots(transitions(source), slots_of(source), 0.01, 1)
    assert by_frames.rows.tolist() == by_slots.rows.tolist() == [0, 1, 2, 8, 9]
    assert by_frames.episode.tolist() == [0, 0, 0, 1, 1]
    assert by_frames.step.tolist() == [0, 1, 2, 2, 3]
    assert by_frames.lengths.tolist() == [5, 4]
    assert len(moving_frames(source, 0.0, 1).rows) == 9, "0 keeps every row"


def labels(source: EpisodeFrames, trim: float = 0.0) -> Demonstrations:
    """Demonstrations whose actions are not numbers, labelled by an untrained world model."""
    return label_demonstrations(tiny_agent().world_model, source, slots_of(source), trim=trim, margin=1)


def test_trimming_never_reads_an_action_and_keeps_rows_together() -> None:
    source = video([[1, 1, 0, 0, 0], [0, 0, 1, 0]])
    demos, kept = labels(source), labels(source, 0.01)
    assert demos.actions is not None
    assert bool(demos.actions.isnan().all())
    assert kept.episode.tolist() == [0, 0, 0, 1, 1]
    rows = torch.tensor([0, 1, 2, 7, 8])
    for name in ("slots", "imagined", "latents", "step"):
        assert torch.equal(getattr(kept, name), getattr(demos, name)[rows]), name
    assert kept.actions is not None
    assert len(kept.actions) == 5
    assert kept.lengths.tolist() == demos.lengths.tolist() == [5, 4]
    assert len(demos.slots) == 9
    assert kept.labelled(1).tolist() == [0, 1, 2]


def test_shifted_copies_are_trimmed_each_by_its_own_motion() -> None:
    demos, less = labels(video([[1, 1, 0, 0, 0], [0, 0, 1, 0]]), 0.01), labels(video([[0, 1, 0, 0, 0]]), 0.01)
    both = with_copies([demos, less])
    assert torch.equal(both.slots, torch.cat((demos.slots, less.slots)))
    assert both.episode.tolist() == [0, 0, 0, 1, 1, 0, 0]
    assert both.step.tolist() == [0, 1, 2, 2, 3, 1, 2]
    assert both.actions is not None
    assert len(both.actions) == 7
    assert with_copies([demos]) is demos


def test_labels_are_filled_in_whatever_the_lengths_and_the_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    source = video([[1, 1, 0], [0, 1, 0, 0, 1], [1, 0, 1], [1]])
    whole = labels(source, 0.01)
    monkeypatch.setattr("playslot_rl.data.demonstrations.EPISODES_AT_ONCE", 1)
    monkeypatch.setattr("playslot_rl.data.demonstrations.FRAMES_AT_ONCE", 2)
    alone = labels(source, 0.01)
    for name in ("slots", "imagined", "latents"):
        torch.testing.assert_close(getattr(whole, name), getattr(alone, name))
    assert whole.episode.tolist() == alone.episode.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3]
    assert bool((whole.imagined[whole.step == 0] == whole.slots[whole.step == 0]).all()), "the first is the parsed one"
