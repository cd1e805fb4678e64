"""The newest pictures of each page, served to its browser; a slow browser skips some."""

from __future__ import annotations

import itertools
import uuid
from typing import ClassVar, Final

PATH: Final = "/play/picture/{page}/{name}/{number}"


class Gallery:
    """Pictures of one page.

    Attributes:
        open: the galleries of all pages that are open, by their key.
    """

    open: ClassVar[dict[str, Gallery]] = {}

    def __init__(self) -> None:
        self.key = uuid.uuid4().hex
        self._numbers = itertools.count()
        self._newest: dict[str, tuple[bytes, str]] = {}
        self.open[self.key] = self

    def put(self, name: str, content: bytes, kind: str = "image/png") -> str:
        """Show a picture under a name; returns an address that no picture had before."""
        self._newest[name] = (content, kind)
        return f"/play/picture/{self.key}/{name}/{next(self._numbers)}"

    def get(self, name: str) -> tuple[bytes, str] | None:
        """Content and kind of the newest picture of a name."""
        return self._newest.get(name)

    def close(self) -> None:
        """Drop them."""
        self.open.pop(self.key, None)
        self._newest.clear()
