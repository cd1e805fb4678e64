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
                if len(header) < 12:
                    raise _truncated(path, number, f"{len(header)} of 12 bytes of its header")
                length, crc = struct.unpack("<QI", header)
                if masked_crc(header[:8]) != crc or length > LONGEST:
                    what = (
                        "the file is damaged: download it again"
                        if number
                        else "expected a TFRecord file: check the path"
                    )
                    raise DataError(f"{path}: record {number} has a wrong checksum of its length, {what}")
                body = file.read(length + 4)
                if len(body) < length + 4:
                    raise _truncated(path, number, f"{len(body)} of {length + 4} bytes")
                if masked_crc(body[:length]) != struct.unpack("<I", body[length:])[0]:
                    raise DataError(
                        f"{path}: record {number} has a wrong checksum of its data, the file is damaged: "
                        "download it again"
                    )
                yield body[:length]
                number += 1
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror}), expected a TFRecord file: check the path"
        ) from error


def _truncated(path: Path, number: int, got: str) -> DataError:
    return DataError(f"{path}: record {number} is truncated, got {got}: download or extract it again")


@cache
def example_class() -> Any:
    """The protobuf message `tf.train.Example`, declared here since it comes with TensorFlow only."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="playslot_rl/example.proto", package="playslot", syntax="proto3")

    def add(message: Any, name: str, number: int, kind: int, of: str | None = None, *, repeated: bool = False) -> Any:
        label = kinds.LABEL_REPEATED if repeated else kinds.LABEL_OPTIONAL
        return message.field.add(name=name, number=number, type=kind, label=label, type_name=of and f".playslot.{of}")

    feature = file.message_type.add(name="Feature")
    feature.oneof_decl.add(name="kind")
    for number, name in enumerate(("Bytes", "Float", "Int64"), 1):
        values = file.message_type.add(name=f"{name}List")
        add(values, "value", 1, getattr(kinds, f"TYPE_{name.upper()}"), repeated=True)
        add(feature, f"{name.lower()}_list", number, kinds.TYPE_MESSAGE, values.name).oneof_index = 0
    features = file.message_type.add(name="Features")
    entry = features.nested_type.add(name="FeatureEntry")
    entry.options.map_entry = True
    add(entry, "key", 1, kinds.TYPE_STRING)
    add(entry, "value", 2, kinds.TYPE_MESSAGE, "Feature")
    add(features, "feature", 1, kinds.TYPE_MESSAGE, "Features.FeatureEntry", repeated=True)
    add(file.message_type.add(name="Example"), "features", 1, kinds.TYPE_MESSAGE, "Features")
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
        elif kind is not None:
            dtype: type[Any] = np.float32 if kind == "float_list" else np.int64
            found[name] = np.array(getattr(feature, kind).value, dtype)
    return found
