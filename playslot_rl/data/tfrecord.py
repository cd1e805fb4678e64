"""TFRecord files of `tf.train.Example` records, read without TensorFlow.

A record is framed as: length (uint64), masked CRC of the length (uint32), data, masked CRC of the data (uint32), all
little-endian. The CRC is CRC-32C (Castagnoli), rotated right by 15 bits plus a constant.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.errors import DataError

Value = list[bytes] | npt.NDArray[np.float32] | npt.NDArray[np.int64]

MASK_DELTA: Final = 0xA282EAD8
LONGEST: Final = 1 << 30
"""A record said to be longer than this (bytes) is taken for a damaged file or one that is no TFRecord."""


def masked_crc(data: bytes) -> int:
    """The checksum that frames a record.

    Raises:
        DataError: the package `crc32c` is not installed.
    """
    try:
        from crc32c import crc32c
    except ImportError as error:
        raise DataError(
            "got no package crc32c, expected it for reading TFRecord files: pip install 'playslot_rl[sketchy]'"
        ) from error
    crc: int = crc32c(data)
    return ((crc >> 15 | crc << 17) + MASK_DELTA) & 0xFFFFFFFF


def read_records(path: Path) -> Iterator[bytes]:
    """The records of a file, in order.

    Raises:
        DataError: the file is missing, truncated, damaged, or no TFRecord file.
    """
    try:
        with path.open("rb") as file:
            number = 0
            while header := file.read(12):
                length = _length(path, number, header)
                body = file.read(length + 4)
                if len(body) < length + 4:
                    raise DataError(
                        f"{path}: record {number} is truncated, got {len(body)} of {length + 4} bytes: "
                        "download or extract it again"
                    )
                _check(path, number, body[:length], body[length:])
                yield body[:length]
                number += 1
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror}), expected a TFRecord file: check the path"
        ) from error


def _length(path: Path, number: int, header: bytes) -> int:
    if len(header) < 12:
        raise DataError(
            f"{path}: record {number} is truncated, got {len(header)} of 12 bytes of its header: "
            "download or extract it again"
        )
    (length,) = struct.unpack("<Q", header[:8])
    if masked_crc(header[:8]) != struct.unpack("<I", header[8:])[0] or length > LONGEST:
        what = "expected a TFRecord file: check the path" if number == 0 else "the file is damaged: download it again"
        raise DataError(f"{path}: record {number} has a wrong checksum of its length, {what}")
    return int(length)


def _check(path: Path, number: int, data: bytes, crc: bytes) -> None:
    if masked_crc(data) != struct.unpack("<I", crc)[0]:
        raise DataError(
            f"{path}: record {number} has a wrong checksum of its data, the file is damaged: download it again"
        )


@cache
def example_class() -> Any:
    """The protobuf message `tf.train.Example`, declared here since it comes with TensorFlow only."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    field = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="playslot_rl/example.proto", package="playslot", syntax="proto3")
    for name, kind in (("BytesList", "TYPE_BYTES"), ("FloatList", "TYPE_FLOAT"), ("Int64List", "TYPE_INT64")):
        values = file.message_type.add(name=name).field.add(name="value", number=1)
        values.label, values.type = field.LABEL_REPEATED, getattr(field, kind)
    feature = file.message_type.add(name="Feature")
    feature.oneof_decl.add(name="kind")
    for number, name in enumerate(("BytesList", "FloatList", "Int64List"), 1):
        one = feature.field.add(name=name.lower().removesuffix("list") + "_list", number=number, oneof_index=0)
        one.label, one.type, one.type_name = field.LABEL_OPTIONAL, field.TYPE_MESSAGE, f".playslot.{name}"
    features = file.message_type.add(name="Features")
    entry = features.nested_type.add(name="FeatureEntry")
    entry.options.map_entry = True
    key = entry.field.add(name="key", number=1)
    key.label, key.type = field.LABEL_OPTIONAL, field.TYPE_STRING
    value = entry.field.add(name="value", number=2)
    value.label, value.type, value.type_name = field.LABEL_OPTIONAL, field.TYPE_MESSAGE, ".playslot.Feature"
    table = features.field.add(name="feature", number=1)
    table.label, table.type, table.type_name = (
        field.LABEL_REPEATED,
        field.TYPE_MESSAGE,
        ".playslot.Features.FeatureEntry",
    )
    whole = file.message_type.add(name="Example").field.add(name="features", number=1)
    whole.label, whole.type, whole.type_name = field.LABEL_OPTIONAL, field.TYPE_MESSAGE, ".playslot.Features"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("playslot.Example"))


def parse_example(record: bytes) -> dict[str, Value]:
    """Features of a `tf.train.Example`: name -> list of bytes, float32 array or int64 array.

    Raises:
        DataError: the record is not one.
    """
    from google.protobuf.message import DecodeError

    try:
        features = example_class().FromString(record).features.feature
    except DecodeError as error:
        raise DataError(
            "got a record that is no tf.train.Example, expected one: check that the file is whole"
        ) from error
    found: dict[str, Value] = {}
    for name, feature in features.items():
        kind = feature.WhichOneof("kind")
        if kind == "bytes_list":
            found[name] = list(feature.bytes_list.value)
        elif kind == "float_list":
            found[name] = np.array(feature.float_list.value, np.float32)
        elif kind == "int64_list":
            found[name] = np.array(feature.int64_list.value, np.int64)
    return found
