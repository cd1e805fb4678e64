"""A report: sections of text, tables and pictures, and how they are written as Markdown and as one HTML file.

The Markdown has its pictures as files beside it; the HTML file has styles and pictures inside, and asks the network for
nothing.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Final

from playslot_rl.storage.atomic import write_bytes, write_text

VERDICTS: Final = ("good", "fair", "BAD")
"""Cells that have a colour in HTML."""


@dataclass(frozen=True)
class Text:
    text: str


@dataclass(frozen=True)
class Table:
    """A table of formatted cells; the first column names the row, the caption stands under it."""

    headers: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""


@dataclass(frozen=True)
class Picture:
    """A PNG (or animated PNG) for a light page, or for any where there is no `dark` one.

    Attributes:
        name: file name without its ending, in the run's `figures` folder.
        alt: what it shows, for those who do not see it.
        still: picture to show instead where the reader asks for less motion.
        width: in CSS pixels, of a small picture that HTML shows enlarged, pixel for pixel; 0 shows its own.
    """

    name: str
    light: bytes
    alt: str
    caption: str
    dark: bytes | None = None
    still: bytes | None = None
    width: int = 0


@dataclass(frozen=True)
class Linked:
    """A picture in a file of its own, beside the page."""

    alt: str
    file: str


@dataclass(frozen=True)
class Notes:
    lines: Sequence[str]


@dataclass(frozen=True)
class Missing:
    """What is not there, and the command that makes it."""

    what: str
    command: str


Block = Text | Table | Picture | Linked | Notes | Missing


@dataclass(frozen=True)
class Section:
    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Document:
    """A whole report; `lead` says what was run, in a sentence or two, `opening` comes before the first section."""

    title: str
    lead: str
    sections: Sequence[Section] = ()
    opening: Sequence[Block] = ()


def to_markdown(document: Document) -> str:
    """Markdown text; its pictures are expected in the folder `figures` beside the file."""
    parts = [f"# {document.title}", document.lead, *map(_markdown_block, document.opening)]
    for section in document.sections:
        parts += [f"## {section.title}", *map(_markdown_block, section.blocks)]
    return "\n\n".join(parts) + "\n"


def write_document(document: Document, folder: Path, name: str) -> Path:
    """Write `FOLDER/NAME.md`, `FOLDER/NAME.html` and `FOLDER/figures/*.png`; returns the path of the HTML file."""
    for section in document.sections:
        for block in section.blocks:
            if isinstance(block, Picture):
                write_bytes(folder / "figures" / f"{block.name}.png", block.light)
    write_text(folder / f"{name}.md", to_markdown(document))
    write_text(folder / f"{name}.html", to_html(document))
    return folder / f"{name}.html"


def table(headers: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; bars are escaped, and runs of white space, line breaks too, become one space."""
    lines = [[" ".join(text.split()).replace("|", "\\|") for text in row] for row in (headers, *rows)]
    lines.insert(1, ["---"] * len(headers))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _markdown_block(block: Block) -> str:
    if isinstance(block, Text):
        return block.text
    if isinstance(block, Linked):
        return f"![{block.alt}]({block.file})"
    if isinstance(block, Notes):
        return "\n".join(f"- {line}" for line in block.lines)
    if isinstance(block, Missing):
        return f"> {block.what} To make it: `{block.command}`"
    if isinstance(block, Picture):
        return f"![{block.alt}](figures/{block.name}.png)\n\n*{block.caption}*"
    assert isinstance(block, Table)
    return table(block.headers, block.rows) + (f"\n\n*{block.caption}*" if block.caption else "")


@cache
def style() -> str:
    """The one style sheet of all pages."""
    return files(__package__).joinpath("style.css").read_text()


def to_html(document: Document) -> str:
    sections = "\n".join(
        f'<section id="s{i}">\n<h2>{escape(s.title)}</h2>\n{"\n".join(map(_html_block, s.blocks))}\n</section>'
        for i, s in enumerate(document.sections)
    )
    opening = "\n".join(map(_html_block, document.opening))
    links = "\n".join(f'<a href="#s{i}">{escape(s.title)}</a>' for i, s in enumerate(document.sections))
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(document.title)}</title>\n<style>{style()}</style>\n</head>\n<body class='report'>\n"
        f"<header><h1>{escape(document.title)}</h1>\n<p class='lead'>{_inline(document.lead)}</p>\n"
        f"<nav aria-label='Sections'>{links}</nav></header>\n<main>\n{opening}{sections}\n</main>\n</body>\n</html>\n"
    )


def _inline(text: str) -> str:
    """Escape, and turn Markdown's `code` into code."""
    parts = escape(text).split("`")
    if len(parts) % 2 == 0:
        return escape(text)
    return "".join(f"<code>{part}</code>" if i % 2 else part for i, part in enumerate(parts))


def _html_block(block: Block) -> str:
    if isinstance(block, Text):
        return f"<p>{_inline(block.text)}</p>"
    if isinstance(block, Linked):
        return f'<figure><img src="{escape(block.file)}" alt="{escape(block.alt)}"></figure>'
    if isinstance(block, Notes):
        return "<ul>" + "".join(f"<li>{_inline(line)}</li>" for line in block.lines) + "</ul>"
    if isinstance(block, Missing):
        return f'<p class="missing">{_inline(block.what)} To make it: <code>{escape(block.command)}</code></p>'
    if isinstance(block, Picture):
        sources = ""
        if block.still is not None:
            sources += f'<source media="(prefers-reduced-motion: reduce)" srcset="{_data_uri(block.still)}">'
        if block.dark is not None:
            sources += f'<source media="(prefers-color-scheme: dark)" srcset="{_data_uri(block.dark)}">'
        size = ' class="moving"' if block.still is not None else ""  # whole on a phone too: columns are compared
        size = f' class="pixels" width="{block.width}"' if block.width else size
        image = f'<img src="{_data_uri(block.light)}" alt="{escape(block.alt)}"{size}>'
        return (
            f'<figure><div class="scroll" tabindex="0"><picture>{sources}{image}</picture></div>\n'
            f"<figcaption>{_inline(block.caption)}</figcaption></figure>"
        )
    assert isinstance(block, Table)
    head = "".join(f'<th scope="col">{_inline(h)}</th>' for h in block.headers)
    body = "\n".join(
        f'<tr><th scope="row">{_inline(row[0])}</th>{"".join(map(_cell, row[1:]))}</tr>' for row in block.rows
    )
    caption = f"<caption>{_inline(block.caption)}</caption>" if block.caption else ""
    return (
        f'<div class="scroll" tabindex="0"><table>{caption}<thead><tr>{head}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div>"
    )


def _cell(text: str) -> str:
    verdict = f' class="verdict {text.lower()}"' if text in VERDICTS else ""
    return f"<td{verdict}>{_inline(text)}</td>"


def _data_uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()
