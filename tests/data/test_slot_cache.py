"""Slots of a whole data set, computed once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from playslot_rl.data import slot_cache as module
from playslot_rl.data.cache import entries
from playslot_rl.data.slot_cache import parse_episodes, slot_cache
from playslot_rl.data.source import EpisodeFrames, open_sources
from playslot_rl.modules.savi import SAVi
from playslot_rl.testing import tiny_config


@pytest.fixture
def source(foreign_images: Path, tmp_path: Path) -> EpisodeFrames:
    return open_sources(foreign_images, cache=tmp_path)


@pytest.fixture
def savi() -> SAVi:
    torch.manual_seed(0)
    return SAVi(replace(tiny_config().model.savi, decoder_channels=(16, 16)), 32)


def test_slots_equal_parsing_each_episode_by_itself(source: EpisodeFrames, savi: SAVi, tmp_path: Path) -> None:
    slots = slot_cache(source, savi, "f" * 16, tmp_path)
    assert slots.shape == (15, 4, 32)
    assert slots.dtype == np.float32
    for episode in range(source.episodes):
        rows = source.episode_rows(episode)
        with torch.no_grad():
            expected, _ = savi(source.pixels(rows)[None].float() / 255)
        # The cache parses several episodes in one batch: equal up to the order of float additions.
        torch.testing.assert_close(torch.from_numpy(slots[rows]), expected[0], atol=1e-5, rtol=1e-4)


def test_slots_are_computed_once_for_weights_and_data(
    source: EpisodeFrames, savi: SAVi, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = slot_cache(source, savi, "a" * 16, tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(SAVi, "forward", None)
        assert np.array_equal(slot_cache(source, savi, "a" * 16, tmp_path), first)
        with pytest.raises(TypeError):
            slot_cache(source, savi, "b" * 16, tmp_path)
        with pytest.raises(TypeError):
            slot_cache(replace(source, fingerprint="c" * 16), savi, "a" * 16, tmp_path)
    assert len(list((tmp_path / "slots").glob("[0-9a-f]*"))) == 1


def test_sampled_initial_slots_repeat(source: EpisodeFrames) -> None:
    torch.manual_seed(0)
    savi = SAVi(replace(tiny_config().model.savi, initial="gaussian", decoder_channels=(16, 16)), 32)
    one, two = (np.concatenate(list(parse_episodes(source, savi))) for _ in range(2))
    assert np.array_equal(one, two)


def test_slots_of_some_episodes_stand_at_their_frames_rows(source: EpisodeFrames, savi: SAVi, tmp_path: Path) -> None:
    whole = slot_cache(source, savi, "f" * 16, tmp_path)
    some = replace(source, starts=source.starts[1:], lengths=source.lengths[1:], fingerprint="d" * 16)
    slots = slot_cache(some, savi, "f" * 16, tmp_path)
    for episode in range(some.episodes):
        rows = some.episode_rows(episode)
        np.testing.assert_allclose(slots[rows], whole[rows], atol=1e-5, rtol=1e-4)


def test_a_killed_build_is_gone_on_with(
    source: EpisodeFrames, savi: SAVi, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Batch by batch, to the same slots bit for bit; the next command parses the episodes that are missing."""
    monkeypatch.setattr(module, "EPISODES_A_BATCH", 1)
    monkeypatch.setattr(module, "MARK_EVERY", 1)
    whole = np.array(slot_cache(source, savi, "f" * 16, tmp_path / "whole"))
    real, parsed = module._parse, list[int]()

    def stops_after(most: int) -> None:
        def parse(*arguments: Any) -> Any:
            if len(parsed) == most:
                raise KeyboardInterrupt
            parsed.append(int(arguments[-1][0]))
            return real(*arguments)

        monkeypatch.setattr(module, "_parse", parse)

    stops_after(2)
    with pytest.raises(KeyboardInterrupt):
        slot_cache(source, savi, "f" * 16, tmp_path)
    (left,) = [entry for entry in entries(tmp_path) if entry.kind == "slots"]
    assert (left.part, left.in_use) == (True, False)
    stops_after(99)
    assert np.array_equal(slot_cache(source, savi, "f" * 16, tmp_path), whole)
    assert parsed == [0, 1, 2]
    (made,) = (tmp_path / "slots").glob("[0-9a-f]*")
    assert sorted(path.name for path in made.iterdir()) == sorted(
        path.name for path in _of(tmp_path / "whole").iterdir()
    )


def _of(cache: Path) -> Path:
    (made,) = (cache / "slots").glob("[0-9a-f]*")
    return made
