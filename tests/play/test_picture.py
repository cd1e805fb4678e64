"""Pictures that somebody brings: what they become, and what is refused before it is decoded."""

from __future__ import annotations

import io
import resource
import warnings

import numpy as np
import pytest
from picture_file import png
from PIL import Image

from playslot_rl.errors import DataError
from playslot_rl.play import starts
from playslot_rl.play.starts import MOST_BYTES, MOST_PIXELS, read_picture


@pytest.mark.parametrize(
    ("width", "height", "said"),
    [
        (2**31 - 1, 2**31 - 1, "too many"),
        (100_000, 100_000, "too many"),
        (1, MOST_PIXELS + 1, f"1x{MOST_PIXELS + 1}"),
        (10_000, 9_500, "10000x9500"),
    ],
)
def test_a_picture_of_too_many_pixels_is_refused_by_its_header(width: int, height: int, said: str) -> None:
    """Some hundred bytes that would become gigabytes; Pillow warns of such sizes, and does not stop at ours."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with warnings.catch_warnings(action="error"), pytest.raises(DataError) as caught:
        read_picture(png(width, height), "bomb.png", 64)
    assert str(caught.value) == f"bomb.png: got {said} pixels, expected at most 64 million: make it smaller"
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000, "kB"


def test_a_file_of_too_many_bytes_is_refused_unread() -> None:
    with pytest.raises(DataError, match=r"^long\.png: got 50 MB, expected at most 50: make it smaller"):
        read_picture(bytes(MOST_BYTES + 1), "long.png", 64)


@pytest.mark.parametrize("kind", ["EPS", "PPM", "ICO"])
def test_formats_that_need_programs_or_believe_their_header_are_no_pictures(kind: str) -> None:
    with pytest.raises(DataError, match="got no picture that can be read, expected a PNG or JPEG file"):
        read_picture(stored(kind), "x", 64)


@pytest.mark.parametrize("kind", starts.FORMATS)
def test_damaged_files_of_every_format_are_read_or_refused_in_one_line(kind: str) -> None:
    whole, rng = stored(kind), np.random.default_rng(0)
    assert read_picture(whole, "x", 32).shape == (32, 32, 3)
    refused: list[str] = []
    for _ in range(150):
        damaged = bytearray(whole[: rng.integers(8, len(whole) + 1)])
        for place in rng.integers(0, min(len(damaged), 200), 4):
            damaged[place] = rng.integers(256)
        try:
            read_picture(bytes(damaged), "x", 32)
        except DataError as error:
            refused.append(str(error))
    assert len(refused) > 20
    assert all(said.startswith("x: got ") and "\n" not in said for said in refused)


def test_no_pixels_are_no_picture() -> None:
    with pytest.raises(DataError, match="got no picture that can be read"):
        read_picture(png(0, 0), "x", 64)


def stored(kind: str) -> bytes:
    """A picture of noise as a file."""
    pixels, file = np.random.default_rng(1).integers(0, 256, (40, 50, 3), dtype=np.uint8), io.BytesIO()
    Image.fromarray(pixels).save(file, kind)
    return file.getvalue()
