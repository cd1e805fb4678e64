"""TFRecord files: the checksums are the published ones, and what is damaged is refused."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from sketchy_layout import example, frame_record

from playslot_rl.datasets.sketchy import masked_crc, parse_example, read_records
from playslot_rl.errors import DataError


def test_the_checksum_is_crc32c_rotated_and_shifted() -> None:
    # 0xE3069283 is the check value of CRC-32C in its definition (RFC 3720): of the digits 1 to 9.
    crc = 0xE3069283
    assert masked_crc(b"123456789") == (((crc >> 15) | (crc << 17 & 0xFFFFFFFF)) + 0xA282EAD8) % 2**32


def test_a_record_that_tensorflow_wrote_is_read(tmp_path: Path) -> None:
    # The framing of an empty record: length 0, and the masked checksums of eight and of no zero bytes.
    path = tmp_path / "one"
    path.write_bytes(struct.pack("<QI", 0, 0x07980329) + struct.pack("<I", 0xA282EAD8))
    assert list(read_records(path)) == [b""]


def test_records_come_back_in_order(tmp_path: Path) -> None:
    path = tmp_path / "some"
    records = [b"a", b"", b"x" * 5000]
    path.write_bytes(b"".join(map(frame_record, records)))
    assert list(read_records(path)) == records


@pytest.mark.parametrize("kept", [5, 11, 12, 20, -1])
def test_a_truncated_record_is_named(tmp_path: Path, kept: int) -> None:
    path = tmp_path / "cut"
    path.write_bytes(frame_record(b"first") + frame_record(b"y" * 50)[:kept])
    records = read_records(path)
    assert next(records) == b"first"
    with pytest.raises(DataError, match=r"cut: record 1 is truncated"):
        next(records)


@pytest.mark.parametrize(("place", "what"), [(3, "its length"), (9, "its length"), (14, "its data"), (-1, "its data")])
def test_a_flipped_bit_is_found(tmp_path: Path, place: int, what: str) -> None:
    path, record = tmp_path / "bad", bytearray(frame_record(b"content"))
    record[place] ^= 4
    path.write_bytes(record)
    with pytest.raises(DataError, match=f"bad: record 0 has a wrong checksum of {what}"):
        list(read_records(path))


def test_a_text_file_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "text"
    path.write_text("this is no TFRecord file")
    with pytest.raises(DataError, match="expected a TFRecord file"):
        list(read_records(path))
    with pytest.raises(DataError, match="cannot be read"):
        list(read_records(tmp_path / "none"))


def test_an_example_gives_its_three_kinds_of_features() -> None:
    found = parse_example(example({"a": b"jpeg", "b": np.array([1.5, -2.0]), "c": np.array([3, -4])}))
    assert found["a"] == [b"jpeg"]
    np.testing.assert_array_equal(found["b"], np.array([1.5, -2.0], np.float32))
    np.testing.assert_array_equal(found["c"], np.array([3, -4]))
    with pytest.raises(DataError, match=r"no tf\.train\.Example"):
        parse_example(b"\xff\xff\xff")


def test_an_example_in_bytes_is_read_as_its_wire_format_says() -> None:
    # features { feature { key: "x" value { float_list { value: 1.0 } } } }, packed, byte by byte.
    floats = b"\x0a\x04" + struct.pack("<f", 1.0)
    entry = b"\x0a\x01x\x12" + bytes([len(floats) + 2]) + b"\x12" + bytes([len(floats)]) + floats
    record = b"\x0a" + bytes([len(entry) + 2]) + b"\x0a" + bytes([len(entry)]) + entry
    np.testing.assert_array_equal(parse_example(record)["x"], np.array([1.0], np.float32))
