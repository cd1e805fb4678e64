"""Recordings: an animation, and a data set that `dataset verify` calls sound."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from playslot_rl import keys
from playslot_rl.data.source import open_sources
from playslot_rl.datasets.verify import verify
from playslot_rl.errors import DataError
from playslot_rl.play import pictures, recording
from playslot_rl.play.recording import columns, record
from playslot_rl.play.session import PlaySession


def play(session: PlaySession) -> None:
    session.press(1)
    session.press(2, 1.0)
    session.freeze(0)
    session.remove(3)
    session.press(0)
    session.drive("policy")


@pytest.mark.integration
@pytest.mark.parametrize("shown", ["imagined", "true"])
def test_a_recording_is_a_sound_data_set(session: PlaySession, tmp_path: Path, shown: recording.Shown) -> None:
    play(session)
    folder = record(session, tmp_path / "play", shown)
    assert folder == tmp_path / "play" / "recording-001"
    result = verify(folder / "dataset")
    assert result.ok, result.lines()
    assert (result.episodes, result.frames) == (1, 5)
    source = open_sources(folder / "dataset", cache=tmp_path / "cache")
    moments = session.timeline.moments
    seen = [moments[0], moments[1], moments[4], moments[5], moments[6]]
    want = [moment.frame if shown == "imagined" else moment.true for moment in seen]
    assert np.array_equal(np.asarray(source.frames[:]), np.stack(want))  # type: ignore[arg-type]
    steps = [moment for moment in session.timeline.path() if moment.latent is not None]
    assert source.actions is not None
    assert np.array_equal(source.actions[:-1], np.stack([moment.action for moment in steps]))  # type: ignore[arg-type]
    values = columns(session, session.timeline.path(), shown)
    assert np.array_equal(values[keys.FEATURE_LATENT][:-1], np.stack([m.latent.numpy() for m in steps]))  # type: ignore[union-attr]
    assert values[keys.FEATURE_CODE].shape == (5, 1)
    with Image.open(folder / "session.gif") as animation:
        assert animation.n_frames >= 5  # type: ignore[attr-defined]
    about = json.loads((folder / "session.json").read_text())
    assert [moment["label"] for moment in about["moments"]][:2] == ["start", "prototype 1"]
    assert record(session, tmp_path / "play").name == "recording-002"


def test_a_long_session_has_a_short_animation(session: PlaySession, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the speed of the session: of eleven moments every third, each shown three times as long."""
    start = session.timeline.moments[0]
    path = [replace(start, frame=np.full((16, 16, 3), 20 * shade, np.uint8), true=None) for shade in range(11)]

    def shown() -> tuple[int, int]:
        with Image.open(io.BytesIO(pictures.session_animation(path, 10.0))) as animation:
            return animation.n_frames, animation.info["duration"]  # type: ignore[attr-defined]

    assert shown() == (11, 100)
    monkeypatch.setattr(pictures, "MOST_PICTURES", 4)
    assert shown() == (4, 300)


def test_nothing_is_recorded_before_a_step_or_without_a_simulator(session: PlaySession, tmp_path: Path) -> None:
    session.freeze(1)
    with pytest.raises(DataError, match="record: got no step yet"):
        record(session, tmp_path / "play")
    session.begin(type(session.start)(session.start.title, session.start.frame, session.start.slots))
    session.press(0)
    with pytest.raises(DataError, match="record: got a session without a simulator"):
        record(session, tmp_path / "play", "true")
    assert not (tmp_path / "play").exists()


@pytest.mark.integration
def test_an_interrupted_recording_leaves_nothing(
    session: PlaySession, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session.press(0)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(recording, "write_json", interrupt)
    with pytest.raises(KeyboardInterrupt):
        record(session, tmp_path / "play")
    assert [path.name for path in (tmp_path / "play").iterdir()] == [recording.LOCK]
