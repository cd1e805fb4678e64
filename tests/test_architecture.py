"""No import points upwards: the layers are those of docs/explanation/architecture.md, imports are read."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAPPED = ("envs", "collectors", "recipes")
LIMIT = 60
"""Lines of a function, docstring included."""
parsed = functools.cache(ast.parse)


def layers() -> dict[str, int]:
    """Rank of each package, from the list in docs/explanation/architecture.md; those of one line have the same."""
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text()
    listed = re.search(r"those before it:\n\n```text\n(.*?)```", page, re.DOTALL)
    assert listed is not None
    return {name: rank for rank, line in enumerate(listed[1].splitlines()) for name in line.split()}


def sources() -> list[tuple[Path, str]]:
    """Every file of the library, and the package (first part below `playslot_rl`) it belongs to."""
    found = [(path, folder) for folder in MAPPED for path in (ROOT / folder).rglob("*.py")]
    for path in (ROOT / "playslot_rl").rglob("*.py"):
        found.append((path, path.relative_to(ROOT / "playslot_rl").parts[0].removesuffix(".py")))
    return found


def imports(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and package of each import from the library, at the top of the file or inside a function."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module == "playslot_rl":
            names = [f"playslot_rl.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        else:
            continue
        for name in names:
            if name.startswith("playslot_rl."):
                yield node.lineno, name.split(".")[1]


def upward(text: str, package: str, ranks: dict[str, int]) -> list[str]:
    """The imports of a file's text that do not point downwards; on the lowest line they may point at each other."""
    wrong = []
    for line, target in imports(parsed(text)):
        if target in (package, "__version__"):
            continue
        if ranks[target] >= ranks[package] and not ranks[target] == ranks[package] == 0:
            wrong.append(f"line {line}: {package} imports {target}")
    return wrong


def test_the_list_names_every_package_and_nothing_else() -> None:
    there = {package for _, package in sources()} - {"__init__", "__main__", "pretrained"}
    assert there == set(layers())


def test_no_import_points_upwards() -> None:
    ranks = layers()
    wrong = {
        str(path.relative_to(ROOT)): lines
        for path, package in sources()
        if package not in ("__init__", "__main__", "pretrained") and (lines := upward(path.read_text(), package, ranks))
    }
    assert wrong == {}


@pytest.mark.parametrize(
    "text",
    [
        "from playslot_rl.recipes import pipeline",
        "import playslot_rl.recipes.pipeline",
        "from playslot_rl import api",
        "def f():\n    from playslot_rl.acting.actor import Actor",
    ],
)
def test_an_upward_import_would_be_found(text: str) -> None:
    ranks = {"config": 1, "recipes": 9, "api": 8, "acting": 5}
    assert len(upward(text, "config", ranks)) == 1
    assert upward("from playslot_rl.errors import ConfigError", "config", ranks | {"errors": 0}) == []


def test_no_function_is_longer_than_a_screen() -> None:
    long = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}, {node.end_lineno - node.lineno + 1} lines"
        for path, _ in sources()
        for node in ast.walk(parsed(path.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and node.end_lineno is not None
        and node.end_lineno - node.lineno + 1 > LIMIT
    ]
    assert long == []


def test_nothing_cites_a_page_that_readers_do_not_have() -> None:
    """`system.md` is a page of ours that a reader of the repository does not have."""
    pages = [path for path, _ in sources()] + [*(ROOT / "docs").rglob("*.md"), *(ROOT / "recipes").rglob("*.yaml")]
    assert [str(path.relative_to(ROOT)) for path in pages if "system.md" in path.read_text()] == []
