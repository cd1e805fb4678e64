"""What the caches hold, and making room in them."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from playslot_rl.cli import main
from playslot_rl.config import DataConfig
from playslot_rl.config.sizes import bytes_of
from playslot_rl.data.cache import (
    ArrayWriter,
    Cache,
    build_once,
    clear,
    entries,
    load_cached,
    make_room,
    part_folder,
    room,
)
from playslot_rl.data.source import open_sources
from playslot_rl.errors import ConfigError, DataError
from playslot_rl.storage.atomic import temporary_name
from playslot_rl.storage.locks import NAME

SIZE = 10_000


def an_entry(cache: Path, name: str, used: float, kind: str = "frames") -> Path:
    folder = cache / kind / name
    folder.mkdir(parents=True)
    np.save(folder / "frames.npy", np.random.default_rng(0).integers(0, 256, SIZE, np.uint8))
    (folder / "meta.json").write_text(json.dumps({"name": f"sets/{name}"}))
    (folder / NAME).touch()
    os.utime(folder / NAME, (used, used))
    return folder


@pytest.fixture
def three(tmp_path: Path) -> list[Path]:
    return [an_entry(tmp_path, "b", 2000), an_entry(tmp_path, "a", 3000, "slots"), an_entry(tmp_path, "c", 1000)]


def names(cache: Path) -> list[str]:
    return [entry.name for entry in entries(cache)]


def test_entries_come_in_the_order_of_their_last_use(three: list[Path], tmp_path: Path) -> None:
    assert names(tmp_path) == ["c", "b", "a"]
    found = entries(tmp_path)[-1]
    assert (found.kind, found.data, found.used, found.in_use, found.part) == ("slots", "sets/a", 3000, False, False)
    assert SIZE < found.bytes < 3 * SIZE
    assert names(tmp_path) == ["c", "b", "a"]  # looking is no use
    load_cached(three[2], "frames.npy")
    assert names(tmp_path) == ["b", "a", "c"]


@pytest.mark.integration
def test_an_array_holds_its_entry_until_it_and_its_views_are_gone(three: list[Path], tmp_path: Path) -> None:
    view = load_cached(three[0], "frames.npy")[10:20]
    kept = view.copy()
    assert [entry.name for entry in entries(tmp_path) if entry.in_use] == ["b"]
    assert [entry.name for entry in clear(cache=tmp_path).kept] == ["b"]
    assert names(tmp_path) == ["b"]
    assert np.array_equal(view, kept)
    del view
    gc.collect()
    assert clear(cache=tmp_path).kept == []
    assert names(tmp_path) == []


@pytest.mark.integration
def test_another_process_holds_its_entry_until_it_ends(three: list[Path], tmp_path: Path) -> None:
    script = (
        "import sys; from pathlib import Path; from playslot_rl.data.cache import load_cached\n"
        "a = load_cached(Path(sys.argv[1]), 'frames.npy'); print('open', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, str(three[0])], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"open\n"
        assert [entry.name for entry in clear(cache=tmp_path).kept] == ["b"]
        process.kill()
    assert [entry.name for entry in clear(cache=tmp_path).removed] == ["b"]


def test_room_is_made_by_the_least_recently_used_but_not_by_what_is_in_use(three: list[Path], tmp_path: Path) -> None:
    total = sum(entry.bytes for entry in entries(tmp_path))
    oldest = load_cached(three[2], "frames.npy")
    os.utime(three[2] / NAME, (1000, 1000))
    make_room(Cache(tmp_path, total + 100), 50, "new")
    assert len(names(tmp_path)) == 3
    make_room(Cache(tmp_path, total), SIZE // 2, "new")
    assert names(tmp_path) == ["c", "a"]
    make_room(Cache(tmp_path), 10**15, "new")  # no limit
    with pytest.raises(DataError, match=r"data.cache_limit=.*beside .* in use, expected less"):
        make_room(Cache(tmp_path, total), total, "new")
    assert names(tmp_path) == ["c", "a"]
    assert len(oldest) == SIZE


def test_what_is_removed_between_making_and_opening_is_made_again(tmp_path: Path) -> None:
    folder = tmp_path / "frames" / "k"
    made = load_cached(folder, "frames.npy", lambda: an_entry(tmp_path, "k", 1.0))
    assert len(made) == SIZE


def test_a_data_set_beyond_the_limit_is_refused_and_leaves_nothing(foreign_images: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"data\.stream=true"):
        open_sources(foreign_images, cache=Cache(tmp_path, 10_000))
    assert entries(tmp_path) == []
    limit = Cache(tmp_path, 15 * 32 * 32 * 3 + 20_000)
    source = open_sources(foreign_images, cache=limit)
    old = an_entry(tmp_path, "old", 1000)
    assert len(source.frames) == 15
    with pytest.raises(DataError, match="in use"):
        open_sources(foreign_images, cache=limit, image_size=64, resize=True)
    assert old.is_dir()


def test_names_that_are_not_there_are_refused(three: list[Path], tmp_path: Path) -> None:
    with pytest.raises(DataError, match="got no entry zz"):
        clear(["b", "zz"], tmp_path)
    assert len(names(tmp_path)) == 3
    assert [entry.name for entry in clear(["b"], tmp_path).removed] == ["b"]


def test_what_a_kill_has_left_is_listed_and_cleared(tmp_path: Path) -> None:
    part = part_folder(tmp_path / "frames" / "k")
    part.mkdir(parents=True)
    (part / "frames.npy").write_bytes(bytes(100))
    found = entries(tmp_path)
    assert [(entry.name, entry.part, entry.in_use) for entry in found] == [("k", True, False)]
    assert [entry.name for entry in clear(cache=tmp_path).removed] == ["k"]
    assert not part.exists()


def test_slots_that_a_kill_has_left_are_listed_counted_and_cleared(tmp_path: Path) -> None:
    left = temporary_name(tmp_path / "slots" / "k")
    left.mkdir(parents=True)
    (left / "slots.npy").write_bytes(bytes(5000))
    (entry,) = entries(tmp_path)
    assert (entry.name, entry.kind, entry.part, entry.in_use, entry.bytes) == ("k", "slots", True, False, 5000)
    make_room(Cache(tmp_path, 6000), 4000, "new")
    assert not left.exists(), "it made room"
    left.mkdir()
    assert [entry.name for entry in clear(cache=tmp_path).removed] == ["k"]


def test_what_is_being_made_counts_as_large_as_it_will_be(tmp_path: Path) -> None:
    def build(folder: Path) -> None:
        with room(Cache(tmp_path, 10_000), 6000, "one"):
            writer = ArrayWriter(folder / "slots.npy", (6000,), np.uint8)
        with pytest.raises(DataError, match=r"data\.cache_limit=.* beside .* in use"):
            make_room(Cache(tmp_path, 10_000), 6000, "two")
        writer.write(np.zeros(6000, np.uint8))
        writer.close()

    build_once(tmp_path / "slots" / "one", build)
    make_room(Cache(tmp_path, 10_000), 3000, "two")
    assert names(tmp_path) == ["one"]


def test_the_command_lists_and_clears(three: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cache", "list", "--cache", str(tmp_path)]) == 0
    assert "3 entries, " in capsys.readouterr().out
    assert main(["cache", "list", "--json", "--cache", str(tmp_path)]) == 0
    assert [row["name"] for row in json.loads(capsys.readouterr().out)["entries"]] == ["c", "b", "a"]
    assert main(["cache", "clear", "c", "--cache", str(tmp_path)]) == 0
    assert "1 entries removed" in capsys.readouterr().out
    assert main(["cache", "clear", "x", "--cache", str(tmp_path)]) == 1


def test_limits_are_amounts() -> None:
    assert Cache.of(replace(DataConfig(), cache_limit="20GB")).limit == 20 * 10**9
    assert Cache.of(DataConfig()).limit is None
    for wrong in ("20 parsecs", "-1GB", "GB", "nan"):
        with pytest.raises(ValueError, match=r"expected an amount|could not convert"):
            bytes_of(wrong)
        with pytest.raises((ConfigError, ValueError), match="cache_limit"):
            DataConfig(cache_limit=wrong)


@pytest.mark.integration
@pytest.mark.skipif(not Path("/proc/self/smaps").is_file(), reason="the kernel does not say")
def test_pages_that_were_read_are_given_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from playslot_rl.data import cache

    folder = tmp_path / "frames" / "k"
    folder.mkdir(parents=True)
    np.save(folder / "frames.npy", np.ones((1000, 10_000), np.uint8))
    array = load_cached(folder, "frames.npy")

    def resident() -> int:
        _, _, rest = Path("/proc/self/smaps").read_text().partition(str(folder / "frames.npy"))
        return int(rest.partition("Rss:")[2].split()[0]) * 1024

    monkeypatch.setattr(cache, "_read", [0])
    monkeypatch.setattr(cache, "RELEASE_EVERY", 9_000_000)
    seen = []
    for begin in range(0, 1000, 100):
        assert array[begin : begin + 100].sum() == 1_000_000
        cache.note_read(1_000_000)
        seen.append(resident())
    assert seen[7] > 7_000_000
    assert seen[8] < 1_000_000
    assert np.array_equal(array[0], np.ones(10_000, np.uint8))
