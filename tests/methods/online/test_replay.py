"""The replay: what sequences hold, across and within episodes, and the ring after a restart."""

from __future__ import annotations

import weakref
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from playslot_rl import keys
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.methods.dreamer.method import DreamerConfig
from playslot_rl.methods.online.config import OnlineConfig
from playslot_rl.methods.online.replay import Replay, ReplayJournal
from playslot_rl.storage.tensors import load_tensors

FRAMES = 4


def episodes(first: int, count: int) -> TensorDict:
    """Frames that know where they are: 10 x episode + frame."""
    place = 10 * torch.arange(first, first + count).unsqueeze(-1) + torch.arange(FRAMES)
    frame = torch.arange(FRAMES).expand(count, FRAMES)
    values = {
        "place": place,
        keys.ACTION: place.unsqueeze(-1).float(),
        keys.REWARD: place.unsqueeze(-1) / 10,
        keys.IS_FIRST: (frame == 0).unsqueeze(-1),
        keys.IS_LAST: (frame == FRAMES - 1).unsqueeze(-1),
    }
    return TensorDict(values, [count, FRAMES])


def replay(sequence: int, capacity: int = 100) -> Replay:
    return Replay(OnlineConfig(batch_size=64, sequence=sequence, capacity=capacity), FRAMES)


def draw(source: Replay, seed: int = 0) -> TensorDict:
    return source.sample(torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("sequence", [2, 3, FRAMES])
def test_a_sequence_no_longer_than_an_episode_lies_within_one(sequence: int) -> None:
    source = replay(sequence)
    source.add(episodes(0, 5))
    places = draw(source)["place"]
    assert places.shape == (64, sequence)
    assert (places.diff(dim=1) == 1).all()
    assert (places // 10 == places[:, :1] // 10).all()
    assert len((places[:, 0] // 10).unique()) == 5
    starts = (places[:, 0] % 10).unique().tolist()
    assert starts == list(range(FRAMES - sequence + 1))


def test_dreamers_sequences_run_across_episodes_so_that_every_frame_is_drawn_alike() -> None:
    source = Replay(DreamerConfig(batch_size=400, sequence=2, capacity=100), FRAMES)
    source.add(episodes(0, 10))
    batch = draw(source)
    assert (batch["place"][:, 0] % 10).unique().tolist() == [0, 1, 2, 3]
    assert torch.equal(batch[keys.IS_FIRST].squeeze(-1), batch["place"] % 10 == 0)
    assert batch[keys.IS_FIRST].float().mean().item() == pytest.approx(1 / FRAMES, abs=0.05)  # within one: a sixth
    whole = Replay(DreamerConfig(batch_size=8, sequence=0, capacity=100), FRAMES)
    whole.add(episodes(0, 10))
    assert draw(whole)[keys.IS_FIRST][:, 0].all()


def test_rewards_are_scaled_when_they_are_drawn_and_stored_as_they_came() -> None:
    config = OnlineConfig(batch_size=64, sequence=FRAMES, capacity=100, reward_scale=5.0)
    source, added = Replay(config, FRAMES), episodes(0, 5)
    before = added[keys.REWARD].clone()
    source.add(added)
    for seed in (0, 1):
        batch = draw(source, seed)
        assert torch.equal(batch[keys.REWARD], 0.5 * batch[keys.ACTION])
    assert torch.equal(added[keys.REWARD], before)


def test_zero_means_whole_episodes() -> None:
    source = replay(0)
    source.add(episodes(0, 3))
    batch = draw(source)
    assert batch.batch_size == (64, FRAMES)
    assert batch[keys.IS_FIRST][:, 0].all()
    assert batch[keys.IS_LAST][:, -1].all()


def test_a_longer_sequence_runs_on_into_the_next_episode_with_its_first_frame_marked() -> None:
    source = replay(7)
    source.add(episodes(0, 5))
    batch = draw(source)
    places, first = batch["place"], batch[keys.IS_FIRST].squeeze(-1)
    steps = places.diff(dim=1)
    assert ((steps == 1) | (steps == 10 - FRAMES + 1)).all()
    assert torch.equal(first, places % 10 == 0)
    assert first.any(1).all()


def test_a_sequence_never_runs_from_the_newest_episode_into_the_oldest() -> None:
    source = replay(7, capacity=5 * FRAMES)
    source.add(episodes(0, 3))
    source.add(episodes(3, 4))  # the ring has turned: the newest lie before the oldest
    places = draw(source)["place"]
    assert (places.diff(dim=1) > 0).all()
    assert places.min() >= 20


def test_flags_are_those_of_the_episodes_not_of_the_slices() -> None:
    source = replay(2)
    source.add(episodes(0, 4))
    batch = draw(source)
    assert torch.equal(batch[keys.IS_FIRST].squeeze(-1), batch["place"] % 10 == 0)
    assert not batch[keys.IS_FIRST][:, 0].all()


def test_the_same_generator_draws_the_same_sequences() -> None:
    source = replay(3)
    source.add(episodes(0, 9))
    assert torch.equal(draw(source)["place"], draw(source)["place"])
    assert not torch.equal(draw(source)["place"], draw(source, 1)["place"])


@pytest.mark.parametrize("total", [3, 5, 7, 10, 13])
@pytest.mark.parametrize("sequence", [3, 6])
def test_a_restored_replay_draws_what_the_first_one_would(total: int, sequence: int) -> None:
    grown, restored = (replay(sequence, capacity=5 * FRAMES) for _ in range(2))
    for number in range(total):
        grown.add(episodes(number, 1))
    restored.restore([(0, episodes(0, 2)), (2, episodes(2, total - 2))], total)
    for extra in range(4):
        assert restored.episodes == grown.episodes
        one, other = draw(grown, extra), draw(restored, extra)
        assert torch.equal(one["place"], other["place"])
        assert torch.equal(one[keys.EPISODE], other[keys.EPISODE])
        for ring in (grown, restored):
            ring.add(episodes(total + extra, 1))


def test_a_capacity_below_one_sequence_is_refused() -> None:
    with pytest.raises(ConfigError, match="capacity: got 4 frames, expected at least"):
        replay(6, capacity=4)


def test_a_journal_is_read_one_file_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal, grown, restored = ReplayJournal(tmp_path), replay(3), replay(3)
    held: list[weakref.ref[torch.Tensor]] = []
    alive: list[int] = []

    def watched(path: Path) -> dict[str, torch.Tensor]:
        alive.append(sum(ref() is not None for ref in held))
        tensors = load_tensors(path)
        held.append(weakref.ref(tensors["place"]))
        return tensors

    monkeypatch.setattr("playslot_rl.methods.online.replay.load_tensors", watched)
    for first in range(0, 10, 2):
        journal.append(first, episodes(first, 2))
        grown.add(episodes(first, 2))
    restored.restore(journal.read(10, restored.capacity), 10)
    assert len(alive) == 5
    assert max(alive) <= 1  # the one before is let go when the next is there
    assert torch.equal(draw(grown)["place"], draw(restored)["place"])


@pytest.mark.parametrize("files, found", [((0, 4), 2), ((2, 4), 0)])
def test_a_journal_with_a_gap_is_refused(tmp_path: Path, files: tuple[int, int], found: int) -> None:
    journal = ReplayJournal(tmp_path)
    for first in files:
        journal.append(first, episodes(first, 2))
    with pytest.raises(CheckpointError, match=f"got episodes up to {found}, expected 6"):
        replay(3).restore(journal.read(6, 25), 6)
