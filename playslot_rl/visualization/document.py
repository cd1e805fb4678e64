"""A report's content, without a format: sections of text, tables and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str


@dataclass(frozen=True)
class Table:
    """A table; the first column names the row.

    Attributes:
        headers: column names.
        rows: cells, already formatted.
        caption: one line under it.
    """

    headers: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""


@dataclass(frozen=True)
class Picture:
    """A PNG (or animated PNG).

    Attributes:
        name: file name without its ending, in the run's `figures` folder.
        light: PNG for a light page, or for any page.
        alt: what it shows, for those who do not see it.
        caption: one line under it.
        dark: PNG for a dark page; None means that `light` suits both.
        still: picture to show instead where the reader asks for less motion.
    """

    name: str
    light: bytes
    alt: str
    caption: str
    dark: bytes | None = None
    still: bytes | None = None


@dataclass(frozen=True)
class Missing:
    """What is not there, and the command that makes it."""

    what: str
    command: str


Block = Text | Table | Picture | Missing


@dataclass(frozen=True)
class Section:
    """A titled part."""

    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Document:
    """A whole report.

    Attributes:
        title: of the page.
        lead: what was run, in a sentence or two.
        sections: in reading order.
    """

    title: str
    lead: str
    sections: Sequence[Section] = field(default_factory=tuple)
