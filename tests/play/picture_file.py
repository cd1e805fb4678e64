"""A PNG file by its chunks, whose header may claim any size."""

from __future__ import annotations

import struct
import zlib


def png(width: int, height: int, rows: bytes = b"") -> bytes:
    """A file of that width and height in RGB, whatever its rows are: each a zero, then three bytes a pixel."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = (b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)
