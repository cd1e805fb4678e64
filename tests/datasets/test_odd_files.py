"""Pictures of every kind, bombs, half a video, files that other systems leave: read right, or named."""

from __future__ import annotations

import io
import shutil
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from damage import CAMERA, ROWS, edit_column, edit_json, truncate
from PIL import Image

from playslot_rl.data.agreement import say_once
from playslot_rl.data.metadata import read_info
from playslot_rl.data.source import open_sources
from playslot_rl.datasets.info import info
from playslot_rl.datasets.merge import merge
from playslot_rl.datasets.repair import repair
from playslot_rl.datasets.verify import verify
from playslot_rl.errors import DataError

Pixels = np.ndarray[Any, Any]
COLOURS = np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)
GREY = COLOURS[..., 0]
DEEP = np.random.default_rng(1).integers(0, 65536, (32, 32), np.uint16)


def encoded(image: Image.Image, kind: str = "PNG") -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind)
    return buffer.getvalue()


def grey_to_rgb(grey: Pixels) -> Pixels:
    return np.repeat(grey[..., None], 3, axis=-1)


PALETTE = Image.fromarray(COLOURS).quantize(16)
PICTURES: dict[str, tuple[bytes, Pixels]] = {
    "colours": (encoded(Image.fromarray(COLOURS)), COLOURS),
    "colours and alpha": (encoded(Image.fromarray(np.dstack([COLOURS, GREY]))), COLOURS),
    "grey": (encoded(Image.fromarray(GREY)), grey_to_rgb(GREY)),
    "grey and alpha": (encoded(Image.fromarray(np.dstack([GREY, 255 - GREY]))), grey_to_rgb(GREY)),
    "grey of 16 bits": (encoded(Image.fromarray(DEEP)), grey_to_rgb((DEEP >> 8).astype(np.uint8))),
    "black and white": (encoded(Image.fromarray(GREY > 127)), grey_to_rgb(np.where(GREY > 127, 255, 0))),
    "a palette": (encoded(PALETTE), np.asarray(PALETTE.convert("RGB"))),
    "TIFF of 16 bits": (encoded(Image.fromarray(DEEP), "TIFF"), grey_to_rgb((DEEP >> 8).astype(np.uint8))),
    "BMP": (encoded(Image.fromarray(COLOURS), "BMP"), COLOURS),
}


def with_picture(root: Path, content: bytes) -> Path:
    """Row 6 shows another picture."""
    edit_column(root, ROWS, CAMERA, lambda cells: cells[6].update(bytes=content))
    return root


@pytest.mark.integration
@pytest.mark.parametrize("name", PICTURES)
def test_pictures_of_every_kind_are_read_as_what_they_show(name: str, broken: Path, tmp_path: Path) -> None:
    content, expected = PICTURES[name]
    with_picture(broken, content)
    assert np.array_equal(open_sources(broken, cache=tmp_path / "cache").frames[6], expected)
    assert not [line for line in verify(broken).errors if "decoded" in line]


SPARK = DEEP // 64
SPARK[3, 7] = 65535
LENS = np.zeros_like(DEEP)
DARK: dict[str, tuple[list[Pixels], bool]] = {
    "depth in millimetres": ([DEEP // 64], True),
    "all of the range": ([DEEP], False),
    "depth, once with a covered lens": ([DEEP // 64, LENS, DEEP // 64], True),
    "all of the range, once nearly black": ([DEEP, DEEP // 64, DEEP], False),
    "depth with a bright pixel": ([SPARK], True),
    "black": ([LENS], False),
}


@pytest.mark.parametrize("name", DARK)
def test_what_sixteen_bits_show_nearly_black_is_said(
    name: str, broken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    say_once.cache_clear()
    pictures, dark = DARK[name]
    for number, picture in enumerate(pictures):
        content = encoded(Image.fromarray(picture))
        edit_column(broken, ROWS, CAMERA, lambda cells, i=number, c=content: cells[6 + i].update(bytes=c))
    capsys.readouterr()
    open_sources(broken, cache=tmp_path / "cache")
    said = f"note: {broken}: got pictures of 16 bits below 4096 from {CAMERA}, "
    assert (said in (err := capsys.readouterr().err)) == dark, err


def bomb(width: int, height: int) -> bytes:
    """A PNG of a megabyte at most that says, and holds, as many black pixels as it wants."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer, parts = zlib.compressobj(9), []
    for _ in range(min(height, 3000)):
        parts.append(packer.compress(bytes(1 + width // 8)))
    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    body = b"".join(parts) + packer.flush()
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


REFUSED: dict[str, tuple[bytes, str]] = {
    "a bomb": (bomb(8000, 8000), r"got \(8000, 8000\), expected \(32, 32\) as stated"),
    "a bomb of gigapixels": (bomb(100_000, 100_000), "pixels, expected"),
    "half a PNG": (encoded(Image.fromarray(COLOURS))[:300], "cannot be decoded"),
    "floats": (encoded(Image.fromarray(GREY.astype(np.float32)), "TIFF"), "got a picture of float32"),
    "PostScript": (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 32 32\n", "not an image"),
    "text": (b"#EXTM3U\nhttp://localhost/", "not an image"),
    "nothing": (b"", "cannot be decoded"),
}


@pytest.mark.integration
@pytest.mark.parametrize("name", REFUSED)
def test_bombs_and_what_is_no_picture_are_refused_before_memory_is_spent(
    name: str, broken: Path, tmp_path: Path
) -> None:
    content, message = REFUSED[name]
    with_picture(broken, content)
    tracemalloc.start()
    with pytest.raises(DataError, match=message) as refused:
        open_sources(broken, cache=tmp_path / "cache")
    result = verify(broken)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 64 << 20
    assert "\n" not in str(refused.value)
    assert name == "floats" or any("row 6" in line for line in result.errors)


def test_half_a_video_is_refused_by_training_and_named_by_verify(broken_video: Path, tmp_path: Path) -> None:
    path = next(broken_video.glob("videos/*top/*/*.mp4"))
    truncate(path, 0.5)
    with pytest.raises(DataError, match=f"{path}: cannot decode the frame at"):
        open_sources(broken_video, CAMERA, cache=tmp_path / "cache")
    assert any(str(path) in line for line in verify(broken_video).errors)
    other = open_sources(broken_video, "observation.images.side", cache=tmp_path / "cache")
    assert len(other.frames) == 15


def test_a_video_of_another_rate_than_stated_is_named_with_both(broken_video: Path, tmp_path: Path) -> None:
    path = next(broken_video.glob("videos/*top/*/*.mp4"))
    quick = tmp_path / "quick.mp4"
    with av.open(str(path)) as old, av.open(str(quick), "w") as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        for packet in old.demux(video=0):
            if packet.pts is not None and packet.dts is not None:
                packet.pts, packet.dts, packet.duration = packet.pts // 2, packet.dts // 2, packet.duration // 2
                packet.stream = stream
                new.mux(packet)
    quick.replace(path)
    message = "got a video of 20 frames a second, expected 10 as in meta/info.json"
    with pytest.raises(DataError, match=message):
        open_sources(broken_video, CAMERA, cache=tmp_path / "cache")
    result = verify(broken_video)
    assert any(message in line for line in result.errors)
    assert result.lines()[-1].endswith("errors), 3 episodes, 15 frames in its rows")


def test_clips_without_a_set_are_shown_the_page_that_makes_one(tmp_path: Path) -> None:
    for clips in (False, True):
        if clips:
            (tmp_path / "one.mp4").touch()
        for reads in (open_sources, read_info):
            with pytest.raises(DataError, match=r"got no meta/info\.json") as caught:
                reads(tmp_path)
            assert ("docs/tutorials/your-own-videos.md" in str(caught.value)) == clips


def test_a_video_with_more_pixels_than_any_is_refused_by_its_header(
    broken_video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from playslot_rl.data import frames

    monkeypatch.setattr(frames, "LARGEST_PICTURE", 64 * 64 - 1)
    with pytest.raises(DataError, match="got frames of 64x64, expected fewer pixels"):
        open_sources(broken_video, CAMERA, cache=tmp_path / "cache")


APPLE = b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X        " + bytes(4000)
CLUTTER: dict[str, bytes] = {
    "data/chunk-000/._file-000.parquet": APPLE,
    "meta/episodes/chunk-000/._file-000.parquet": APPLE,
    "meta/._tasks.parquet": APPLE,
    "meta/._info.json": APPLE,
    "data/._chunk-000": APPLE,
    "data/chunk-000/.DS_Store": b"\x00\x00\x00\x01Bud1",
    "data/chunk-000/Thumbs.db": b"\xd0\xcf\x11\xe0",
    "videos/observation.images.top/chunk-000/._file-000.mp4": APPLE,
}


def same_rows(root: Path, as_in: Path) -> None:
    assert (verify(root).ok, verify(root).fingerprint) == (True, verify(as_in).fingerprint)


@pytest.mark.integration
@pytest.mark.parametrize("place", CLUTTER)
def test_files_of_other_systems_are_named_and_passed_over(
    place: str, images: Path, video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = video if place.startswith("videos") else images
    root = Path(shutil.copytree(source, tmp_path / "set"))
    (root / place).write_bytes(CLUTTER[place])
    assert [line for line in verify(root).warnings if f"{root / place}: got a file of another" in line]
    same_rows(root, source)
    assert info(root).frames == 15
    assert len(open_sources(root, CAMERA, cache=tmp_path / "cache").frames) == 15
    noted = capsys.readouterr().err
    assert (str(root / place) in noted) == place.endswith(".parquet")
    merge([root, source], tmp_path / "merged")
    assert not list((tmp_path / "merged").rglob("._*"))


def test_lerobot_fails_on_what_its_glob_takes_for_rows(images: Path, tmp_path: Path) -> None:
    """Why such a file is named though it is passed over."""
    from damage import load

    root = Path(shutil.copytree(images, tmp_path / "set"))
    (root / "data/chunk-000/._file-000.parquet").write_bytes(APPLE)
    with pytest.raises(Exception, match="generating the dataset"):
        load(root)


@pytest.mark.parametrize("place", ["meta/info.json", "meta/stats.json"])
def test_a_byte_order_mark_is_read_past(place: str, broken: Path, images: Path, tmp_path: Path) -> None:
    (broken / place).write_bytes(b"\xef\xbb\xbf" + (broken / place).read_bytes())
    same_rows(broken, images)
    assert ["byte-order mark" in line for line in verify(broken).warnings] == [True]
    assert len(open_sources(broken, cache=tmp_path / "cache").frames) == 15
    merge([broken, images], tmp_path / "merged")
    assert (tmp_path / "merged" / place).read_bytes().startswith(b"{")


Change = Callable[[Path], None]
ORDER: dict[str, tuple[Change, str]] = {
    "an episode's rows apart": (
        lambda root: edit_column(root, ROWS, "episode_index", lambda rows: rows.__setitem__(14, 0)),
        "episode 2: got 6 rows|episode 0: got rows in 2 places",
    ),
    "frames in another order": (
        lambda root: edit_column(root, ROWS, "frame_index", lambda rows: rows.__setitem__(slice(0, 2), [1, 0])),
        "episode 0: got frame_index",
    ),
}


@pytest.mark.parametrize("name", ORDER)
def test_rows_whose_order_nobody_knows_are_not_trained_on(name: str, broken: Path, tmp_path: Path) -> None:
    change, message = ORDER[name]
    change(broken)
    with pytest.raises(DataError, match=message):
        open_sources(broken, cache=tmp_path / "cache")


def test_a_repair_says_what_is_gone_of_a_set_that_says_it_had_a_trillion_episodes(broken: Path) -> None:
    edit_json(broken, "meta/info.json", lambda content: content.update(total_episodes=10**12))
    result = repair(broken)
    assert result.lost == ("episodes 3, 4, 5, 6, 7, 8, 9, 10 and 999999999989 more: no rows are left of them",)
