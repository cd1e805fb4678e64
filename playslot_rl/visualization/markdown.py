"""A report as Markdown, its pictures as files beside it."""

from __future__ import annotations

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


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _block(block: Block, figures: str) -> str:
    if isinstance(block, Text):
        return block.text
    if isinstance(block, Missing):
        return f"> {block.what} To make it: `{block.command}`"
    if isinstance(block, Picture):
        return f"![{block.alt}]({figures}/{block.name}.png)\n\n*{block.caption}*"
    assert isinstance(block, Table)
    lines = ["| " + " | ".join(_cell(h) for h in block.headers) + " |", "|" + " --- |" * len(block.headers)]
    lines += ["| " + " | ".join(_cell(c) for c in row) + " |" for row in block.rows]
    return "\n".join(lines) + (f"\n\n*{block.caption}*" if block.caption else "")
