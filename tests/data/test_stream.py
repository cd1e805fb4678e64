"""Frames that are decoded while they are read."""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from foreign import LENGTHS, foreign_frames
from tiny_savi import tiny_savi

from playslot_rl.config import DataConfig
from playslot_rl.data import agreement
from playslot_rl.data.clips import Clips
from playslot_rl.data.slot_cache import parse_episodes, slot_cache
from playslot_rl.data.source import open_sources
from playslot_rl.data.stream import FrameStream, ShuffleBuffer, streams_of
from playslot_rl.data.views import concatenate, every, shifted
from playslot_rl.data.weighted import open_configured
from playslot_rl.errors import DataError
from playslot_rl.modules.savi import SAVi
from playslot_rl.runtime import processes
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.testing import tiny_config

CAMERA = "observation.images.top"


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """Episodes of each decoding."""
    found: list[list[int]] = []
    real = FrameStream._decode

    def decode(stream: FrameStream, spans: list[object]) -> np.ndarray[object, np.dtype[np.uint8]]:
        found.append([span.index for span in spans])  # type: ignore[attr-defined]
        return real(stream, spans)  # type: ignore[arg-type]

    monkeypatch.setattr(FrameStream, "_decode", decode)
    return found


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["foreign_images", "foreign_video"])
@pytest.mark.parametrize("buffer", [1, 6, 1000])
def test_streamed_frames_are_those_of_the_cache(
    kind: str, buffer: int, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    root = request.getfixturevalue(kind)
    cached, streamed = open_sources(root, CAMERA, tmp_path), open_sources(root, CAMERA, tmp_path, buffer=buffer)
    rows = np.array([[14, 0, 3], [7, 7, 4]])
    assert np.array_equal(streamed.frames[rows], cached.frames[rows])
    assert np.array_equal(streamed.frames[5:9], cached.frames[5:9])
    assert np.array_equal(streamed.frames[-1], cached.frames[-1])
    streamed.frames.hold([0])  # type: ignore[attr-defined]
    assert np.array_equal(streamed.frames[rows], cached.frames[rows])
    assert streamed.fingerprint == cached.fingerprint
    assert streamed.actions is not None
    assert np.array_equal(streamed.actions, cached.actions)  # type: ignore[arg-type]
    assert (streamed.fps, streamed.task, streamed.camera) == (cached.fps, cached.task, cached.camera)


def test_nothing_is_written_but_the_fingerprint(foreign_images: Path, tmp_path: Path) -> None:
    open_sources(foreign_images, cache=tmp_path, buffer=100).frames[np.arange(15)]
    assert {path.relative_to(tmp_path).parts[0] for path in tmp_path.rglob("*.*")} == {"fingerprints"}


def test_episodes_outside_the_buffer_are_kept_only_while_they_are_read(
    foreign_images: Path, tmp_path: Path, decoded: list[list[int]]
) -> None:
    frames = open_sources(foreign_images, cache=tmp_path, buffer=24).frames  # six loose frames
    frames[np.array([0, 1])]
    frames[np.array([2, 4])]
    assert decoded == [[0]]
    frames[np.array([5, 14])]  # episodes 1 and 2 are ten frames, too many to be kept together
    assert decoded == [[0], [1], [2]]
    assert list(frames._loose) == [2]  # type: ignore[attr-defined]
    frames[np.array([14])]
    assert decoded == [[0], [1], [2]]
    frames[np.array([0])]
    assert decoded == [[0], [1], [2], [0]]


def test_what_has_made_way_takes_no_memory(foreign_images: Path, tmp_path: Path) -> None:
    frames = open_sources(foreign_images, cache=tmp_path, buffer=44).frames  # eleven loose frames
    frames[np.arange(15)]
    kept = frames._loose.values()  # type: ignore[attr-defined]
    assert sum(map(len, kept)) <= 11
    assert all(part.base is None for part in kept), "no view of frames that were decoded beside it"


@pytest.mark.parametrize("initial", ["learned", "gaussian"])
@pytest.mark.parametrize(("buffer", "together"), [(1, [[0], [1], [2]]), (44, [[0, 1], [2]]), (1000, [[0, 1, 2]])])
def test_slots_of_streamed_episodes_are_parsed_in_as_many_as_are_kept(
    foreign_images: Path, tmp_path: Path, initial: str, buffer: int, together: list[list[int]], decoded: list[list[int]]
) -> None:
    savi = tiny_savi(initial=initial)
    want = list(parse_episodes(open_sources(foreign_images, cache=tmp_path), savi))
    found = list(parse_episodes(open_sources(foreign_images, cache=tmp_path, buffer=buffer), savi))
    for one, other in zip(want, found, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)
    assert decoded == together


def test_the_buffer_moves_through_every_block_once_an_epoch() -> None:
    class Stream(FrameStream):
        def __init__(self) -> None:  # blocks of one episode of ten frames
            self.buffer, self.moves = 60, list[list[int]]()
            self.blocks = [[type("Span", (), {"length": 10})()] for _ in range(20)]  # type: ignore[list-item]

        def __len__(self) -> int:
            return 200

        def block_of(self, rows: np.ndarray[object, np.dtype[np.int64]]) -> np.ndarray[object, np.dtype[np.int64]]:
            return rows // 10

        def hold(self, blocks: list[int], coming: list[int] = []) -> None:  # type: ignore[override]  # noqa: B006
            self.moves.append([*blocks, *coming])

    def visited(seed: int, steps: range) -> list[list[int]]:
        stream, starts = Stream(), np.arange(0, 200, 10)
        buffer = ShuffleBuffer(stream, starts, np.full(20, 8), np.zeros(20, int), np.ones(1), seed)
        return [sorted(buffer.episodes(step, 4).tolist()) for step in steps]

    epoch = 20 * 8 // 4
    held = visited(0, range(epoch))
    assert {episode for episodes in held for episode in episodes} == set(range(20))
    inside = held[:29]  # later the next epoch's first blocks may be some that are there
    assert all(len(episodes) == 6 for episodes in inside)
    changes = [len(set(after) - set(before)) for before, after in pairwise(inside)]
    assert changes == [0, 1] * 14  # a new block each two steps
    assert visited(0, range(13, 20)) == held[13:20]  # from any step on the same
    assert visited(1, range(epoch)) != held


def test_a_resumed_run_reads_the_same_windows(foreign_images: Path, tmp_path: Path) -> None:
    def rows(steps: range) -> list[list[int]]:
        clips = Clips(open_sources(foreign_images, cache=tmp_path, buffer=4), 2, 0.0, seed=3)
        return [clips.sample(3, StepGenerators(3, step).numpy("windows"))[:, 0].tolist() for step in steps]

    whole = rows(range(12))
    assert rows(range(5, 12)) == whole[5:]
    assert {row for step in whole for row in step} > {0, 5}


def test_a_buffer_as_large_as_the_set_draws_as_the_cache_does(foreign_images: Path, tmp_path: Path) -> None:
    sets = [open_sources(foreign_images, cache=tmp_path), open_sources(foreign_images, cache=tmp_path, buffer=10_000)]
    cached, streamed = (Clips(s, 2, 0.0, seed=0) for s in sets)
    for step in range(20):
        one, other = (c.sample(50, StepGenerators(0, step).numpy("windows")) for c in (cached, streamed))
        assert np.array_equal(one, other)


def test_a_buffer_that_has_room_for_all_blocks_holds_all_of_them_at_every_step(
    foreign_images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not a stretch of the endless order, in which blocks come twice across an epoch's border."""
    stream = open_sources(foreign_images, cache=tmp_path, buffer=20)  # three blocks of five frames, and room for four
    assert len(streams_of(stream.frames)[0].blocks) == 3
    buffer = ShuffleBuffer(stream.frames, stream.starts, stream.lengths - 1, np.zeros(3, int), np.ones(1), 0)
    assert all(buffer.episodes(step, 4).tolist() == [0, 1, 2] for step in range(50))
    assert capsys.readouterr().out == ""
    small = open_sources(foreign_images, cache=tmp_path, buffer=5)
    ShuffleBuffer(small.frames, small.starts, small.lengths - 1, np.zeros(3, int), np.ones(1), 0)
    assert "note: data.shuffle_buffer=5 holds 1 of 3 blocks of episodes" in capsys.readouterr().out
    monkeypatch.setattr(processes, "_here", processes.Processes(1, 2))
    ShuffleBuffer(small.frames, small.starts, small.lengths - 1, np.zeros(3, int), np.ones(1), 0)
    agreement.say_once("note: something")
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", ""), "one of several processes says it"


def test_the_step_of_a_generator_does_not_change_what_it_draws() -> None:
    from playslot_rl.seeds.draws import derived_seed

    plain = np.random.default_rng(derived_seed(1, 7, "windows"))
    assert np.array_equal(StepGenerators(1, 7).numpy("windows").random(9), plain.random(9))


def test_strides_shifts_and_several_sets_are_streamed_too(foreign_images: Path, tmp_path: Path) -> None:
    def made(of: object) -> object:
        source = every(of, 2)  # type: ignore[arg-type]
        return concatenate([source, shifted(source, (1, 0))])

    cached = made(open_sources(foreign_images, cache=tmp_path))
    streamed = made(open_sources(foreign_images, cache=tmp_path, buffer=4))
    assert len(streams_of(streamed.frames)) == 2  # type: ignore[attr-defined]
    clips = Clips(streamed, 2, 0.0, seed=0)  # type: ignore[arg-type]
    seen = set()
    for step in range(20):
        rows = clips.sample(4, StepGenerators(0, step).numpy("windows"))
        seen |= set(rows[:, 0].tolist())
        assert np.array_equal(streamed.frames[rows], cached.frames[rows])  # type: ignore[attr-defined]
    assert min(seen) < sum(-(-n // 2) for n in LENGTHS) <= max(seen)


def test_a_config_streams_with_weights(foreign_images: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(foreign_images, tmp_path / "other"))
    with (other / "meta" / "info.json").open("a") as info:
        info.write("\n")  # one set twice would be refused
    data = DataConfig(cache=str(tmp_path), stream=True, shuffle_buffer=40)
    config = replace(tiny_config(), data=data)
    config = replace(config, env=replace(config.env, image_size=32))
    both = open_configured(config, f"{foreign_images}:3,{other}:1")
    assert len(streams_of(both.frames)) == 2
    clips = Clips(both, 2, 0.0, seed=0)
    rows = np.concatenate([clips.sample(20, StepGenerators(0, step).numpy("windows")) for step in range(60)])
    assert abs((rows[:, 0] < 15).mean() - 0.75) < 0.05
    assert not (tmp_path / "frames").exists()


def test_slots_of_a_stream_are_those_of_the_cache(foreign_images: Path, tmp_path: Path) -> None:
    torch.manual_seed(0)
    savi = SAVi(replace(tiny_config().model.savi, decoder_channels=(16, 16)), 32)
    cached = slot_cache(open_sources(foreign_images, cache=tmp_path), savi, "f" * 16, tmp_path / "a")
    streamed = slot_cache(open_sources(foreign_images, cache=tmp_path, buffer=4), savi, "f" * 16, tmp_path / "b")
    assert np.array_equal(cached, streamed)


def test_frames_of_another_size_are_resized_or_refused(foreign_images: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected 64x64"):
        open_sources(foreign_images, cache=tmp_path, buffer=9, image_size=64)
    resized = open_sources(foreign_images, cache=tmp_path, buffer=9, image_size=64, resize=True)
    expected = open_sources(foreign_images, cache=tmp_path, image_size=64, resize=True)
    assert np.array_equal(resized.frames[3:8], expected.frames[3:8])
    assert len(foreign_frames()) == resized.episodes
