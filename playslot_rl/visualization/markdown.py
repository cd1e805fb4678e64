"""Markdown: tables, and a report with its pictures as files beside it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from playslot_rl.visualization.document import Block, Document, Missing, Picture, Table, Text


def to_markdown(document: Document, figures: str = "figures") -> str:
    """Markdown text.

    Args:
        document: the report.
        figures: folder of its pictures, relative to the file.
    """
    parts = [f"# {document.title}", document.lead]
    for section in document.sections:
        parts += [f"## {section.title}", *(_block(block, figures) for block in section.blocks)]
    return "\n\n".join(parts) + "\n"


def table(headers: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; bars are escaped, and runs of white space, line breaks too, become one space."""
    lines = [[" ".join(text.split()).replace("|", "\\|") for text in row] for row in (headers, *rows)]
    lines.insert(1, ["---"] * len(headers))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _block(block: Block, figures: str) -> str:
    if isinstance(block, Text):
        return block.text
    if isinstance(block, Missing):
        return f"> {block.what} To make it: `{block.command}`"
    if isinstance(block, Picture):
        return f"![{block.alt}]({figures}/{block.name}.png)\n\n*{block.caption}*"
    assert isinstance(block, Table)
    return table(block.headers, block.rows) + (f"\n\n*{block.caption}*" if block.caption else "")
