"""A report: sections of text, tables and pictures, and how they are written as Markdown and as one HTML file.

The Markdown has its pictures as files beside it; the HTML file has styles and pictures inside, and asks the network for
nothing.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from playslot_rl.storage.atomic import write_bytes, write_text


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
    sections: Sequence[Section] = ()


def to_markdown(document: Document) -> str:
    """Markdown text; its pictures are expected in the folder `figures` beside the file."""
    parts = [f"# {document.title}", document.lead]
    for section in document.sections:
        parts += [f"## {section.title}", *map(_markdown_block, section.blocks)]
    return "\n\n".join(parts) + "\n"


def write_document(document: Document, folder: Path, name: str) -> Path:
    """Write `FOLDER/NAME.md`, `FOLDER/NAME.html` and `FOLDER/figures/*.png`; returns the path of the HTML file.

    Raises:
        OutputError: a file cannot be written.
    """
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
    if isinstance(block, Missing):
        return f"> {block.what} To make it: `{block.command}`"
    if isinstance(block, Picture):
        return f"![{block.alt}](figures/{block.name}.png)\n\n*{block.caption}*"
    assert isinstance(block, Table)
    return table(block.headers, block.rows) + (f"\n\n*{block.caption}*" if block.caption else "")


STYLE = """
:root { color-scheme: light dark; --text: #22262b; --soft: #5d646d; --ground: #ffffff; --line: #d8dbe0;
  --accent: #0062a3; --note: #fff5e0; }
@media (prefers-color-scheme: dark) { :root { --text: #e4e6ea; --soft: #a3aab4; --ground: #16181c; --line: #3b4048;
  --accent: #6cbcf0; --note: #33290f; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 62rem; padding: 1.5rem 1rem 4rem; background: var(--ground); color: var(--text);
  font: 1rem/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .5rem; }
h2 { font-size: 1.2rem; margin: 2.5rem 0 .75rem; padding-top: .75rem; border-top: 1px solid var(--line); }
p, figure, .scroll { margin: 0 0 1rem; max-width: 100%; }
.lead { color: var(--soft); font-size: 1.05rem; }
nav { font-size: .92rem; line-height: 1.9; }
nav a { margin-right: 1rem; white-space: nowrap; }
a { color: var(--accent); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
caption { caption-side: bottom; text-align: left; color: var(--soft); font-size: .9rem; padding-top: .4rem; }
th, td { text-align: left; padding: .35rem 1.2rem .35rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
thead th { color: var(--soft); font-weight: 600; font-size: .9rem; }
tbody th { font-weight: 600; }
figure img { display: block; max-width: 100%; height: auto; }
figcaption { color: var(--soft); font-size: .9rem; margin-top: .4rem; }
code { font: .9em ui-monospace, Consolas, monospace; overflow-wrap: anywhere; }
.missing { background: var(--note); border-left: 4px solid #e69f00; padding: .6rem .9rem; }
@media print { nav { display: none; } h2 { break-after: avoid; } figure { break-inside: avoid; } }
"""


def to_html(document: Document) -> str:
    """The whole file."""
    sections = "\n".join(_section(i, section) for i, section in enumerate(document.sections))
    links = "\n".join(f'<a href="#s{i}">{escape(s.title)}</a>' for i, s in enumerate(document.sections))
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(document.title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f"<header><h1>{escape(document.title)}</h1>\n<p class='lead'>{_inline(document.lead)}</p>\n"
        f"<nav aria-label='Sections'>{links}</nav></header>\n<main>\n{sections}\n</main>\n</body>\n</html>\n"
    )


def _section(index: int, section: Section) -> str:
    blocks = "\n".join(_html_block(block) for block in section.blocks)
    return f'<section id="s{index}">\n<h2>{escape(section.title)}</h2>\n{blocks}\n</section>'


def _inline(text: str) -> str:
    """Escape, and turn Markdown's `code` into code."""
    parts = escape(text).split("`")
    if len(parts) % 2 == 0:
        return escape(text)
    return "".join(f"<code>{part}</code>" if i % 2 else part for i, part in enumerate(parts))


def _html_block(block: Block) -> str:
    if isinstance(block, Text):
        return f"<p>{_inline(block.text)}</p>"
    if isinstance(block, Missing):
        return f'<p class="missing">{_inline(block.what)} To make it: <code>{escape(block.command)}</code></p>'
    if isinstance(block, Picture):
        sources = ""
        if block.still is not None:
            sources += f'<source media="(prefers-reduced-motion: reduce)" srcset="{_data_uri(block.still)}">'
        if block.dark is not None:
            sources += f'<source media="(prefers-color-scheme: dark)" srcset="{_data_uri(block.dark)}">'
        image = f'<img src="{_data_uri(block.light)}" alt="{escape(block.alt)}">'
        return (
            f'<figure><div class="scroll" tabindex="0"><picture>{sources}{image}</picture></div>\n'
            f"<figcaption>{_inline(block.caption)}</figcaption></figure>"
        )
    assert isinstance(block, Table)
    head = "".join(f'<th scope="col">{_inline(h)}</th>' for h in block.headers)
    body = "\n".join(
        f'<tr><th scope="row">{_inline(row[0])}</th>' + "".join(f"<td>{_inline(c)}</td>" for c in row[1:]) + "</tr>"
        for row in block.rows
    )
    caption = f"<caption>{_inline(block.caption)}</caption>" if block.caption else ""
    return (
        f'<div class="scroll" tabindex="0"><table>{caption}<thead><tr>{head}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div>"
    )


def _data_uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()
