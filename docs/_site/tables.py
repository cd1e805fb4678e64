"""Writes the tables of README.md and docs/ from the numbers in results/*.json:

    make tables

A page says `<!-- results:NAME -->`, then the table, then `<!-- /results -->`. `results:NAME/VIEW` is a part of a table
and `results:NAME/made` says how its rows were made. results/README.md explains the files; a test compares the pages.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any, Final

from playslot_rl.sharing.models import shipped_table

ROOT: Final = Path(__file__).resolve().parents[2]
MARKED: Final = re.compile(r"<!-- results:([\w/]+) -->\n.*?<!-- /results -->", re.DOTALL)
MADE: Final = "made"
SHIPPED: Final = ROOT / "playslot_rl" / "pretrained"

Table = dict[str, Any]
"""`columns`, `rows` and `made`; sometimes `views`."""


def load_tables(folder: Path) -> dict[str, Table]:
    """All tables of all files, by name. Numbers keep the digits that the file gives them."""
    tables: dict[str, Table] = {}
    for path in sorted([*folder.glob("*.json"), *(SHIPPED.glob("*.json") if folder == ROOT / "results" else ())]):
        read = json.loads(path.read_text(), parse_float=Decimal, parse_int=Decimal)
        for name, table in read["tables"].items():
            if name == "shipped_models":
                table = _decimal(shipped_table())
            if name in tables:
                raise ValueError(f"{path.name}: got a second table {name!r}")
            for row in table["rows"]:
                if len(row) != len(table["columns"]):
                    raise ValueError(f"{name}: got {len(row)} cells in {row}, expected {len(table['columns'])}")
            tables[name] = table
    return tables


def shown(name: str, tables: dict[str, Table]) -> str:
    """What stands between the markers of NAME, NAME/VIEW or NAME/made."""
    table, _, view = name.partition("/")
    if view == MADE:
        return made(tables[table])
    return markdown(tables[table] if not view else part(tables[table], tables[table]["views"][view]))


def part(table: Table, view: dict[str, Any]) -> Table:
    """Rows that begin as the view says, columns by their titles; with `brief` no intervals."""
    titles = [column["title"] for column in table["columns"]]
    kept = [titles.index(title) for title in view.get("columns", titles)]
    begins = view.get("rows", [[]])
    rows = [row for row in table["rows"] if any(row[: len(begin)] == begin for begin in begins)]
    if view.get("brief"):
        rows = [[_brief(cell) for cell in row] for row in rows]
    return {
        "columns": [table["columns"][index] for index in kept],
        "rows": [[row[index] for index in kept] for row in rows],
    }


def markdown(table: Table) -> str:
    """The table as a page has it."""
    columns = table["columns"]
    lines = [[column["title"] for column in columns], ["---"] * len(columns)]
    lines += [[cell(value, column) for value, column in zip(row, columns, strict=True)] for row in table["rows"]]
    if table.get("transposed"):
        head, mark, *rows = lines
        first, *others = zip(head, *rows, strict=True)
        shown = (line for line, column in zip(others, columns[1:], strict=True) if not column.get("hidden"))
        lines = [list(first), mark[:1] * len(first), *map(list, shown)]
    return "\n".join(_line(line) for line in lines)


def cell(value: Any, column: dict[str, Any]) -> str:
    """A number with its unit, numbers with commas, text as it is, nothing where nothing was measured.

    An object has a `value`, perhaps `interval`, `seeds` (lowest and highest) and a `note`; `best` is bold.
    """
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    if not isinstance(value, dict):
        return _number(value, column)
    text = _number(value["value"], column)
    if value.get("best"):
        text = f"**{text}**"
    ranges = [" to ".join(_number(end, {}) for end in value[key]) for key in ("interval", "seeds") if key in value]
    if ranges:
        text += f" ({'; seeds '.join(ranges)})"
    return f"{text} {value['note']}" if "note" in value else text


def made(table: Table) -> str:
    """How the rows were made: the usual machine and day once, then each lot, above the command that it shares."""
    machine, date = (_usual([lot[key] for lot in table["made"]]) for key in ("machine", "date"))
    texts = [f"Written down on {date}" + (f"; on {machine} where nothing else is said." if machine else ".")]
    lots: dict[str, list[str]] = {}
    for lot in table["made"]:
        facts = [
            f"commit {lot['commit']}" if lot["commit"] else "commit not noted",
            lot["machine"] if lot["machine"] != machine else None,
            lot["time"],
            lot["date"] if lot["date"] != date else None,
        ]
        line = f"- {lot['rows'] or 'All rows'}: {', '.join(fact for fact in facts if fact)}."
        lots.setdefault("\n".join(lot["command"] or []), []).append(line)
    for command, lines in lots.items():
        texts.append("\n".join(lines))
        if command:
            texts.append(f"```bash\n{command}\n```")
    return "\n\n".join(texts)


def written(page: str, tables: dict[str, Table]) -> str:
    """The page with every marked table as the numbers make it."""

    def replace(found: re.Match[str]) -> str:
        return f"<!-- results:{found[1]} -->\n\n{shown(found[1], tables)}\n\n<!-- /results -->"

    return MARKED.sub(replace, page)


def pages() -> Iterator[Path]:
    """README.md and all of docs/."""
    yield ROOT / "README.md"
    yield from sorted((ROOT / "docs").rglob("*.md"))


def main() -> None:
    """Write the pages whose tables differ from the numbers."""
    tables = load_tables(ROOT / "results")
    for page in pages():
        before = page.read_text()
        after = written(before, tables)
        if after != before:
            page.write_text(after)
            print(page.relative_to(ROOT))


def _decimal(table: Table) -> Table:
    read: Table = json.loads(json.dumps(table), parse_float=Decimal, parse_int=Decimal)
    return read


def _usual(values: list[str | None]) -> str | None:
    return max(values, key=values.count)


def _brief(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    return {key: held for key, held in value.items() if key in ("value", "best")}


def _number(value: Any, column: dict[str, Any]) -> str:
    numbers = value if isinstance(value, list) else [value]
    text = column.get("join", ", ").join(f"{number:,}" for number in numbers)
    return f"{text} {column['unit']}" if "unit" in column else text


def _line(cells: list[str]) -> str:
    return "|" + "|".join(f" {text} " if text != "---" and text else (text or " ") for text in cells) + "|"


if __name__ == "__main__":
    main()
