"""Runs examples/quickstart.ipynb and stores what its cells show:

make notebook
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
from pathlib import Path
from typing import Any, Final

from PIL import Image

NOTEBOOK: Final = Path(__file__).resolve().parents[2] / "examples" / "quickstart.ipynb"


def run(notebook: dict[str, Any]) -> list[tuple[str, Any]]:
    """What each code cell prints, and the value of its last line; one namespace for all, as in Jupyter."""
    names: dict[str, Any] = {}
    shown = []
    for cell in notebook["cells"]:
        if cell["cell_type"] != "code":
            continue
        tree = ast.parse("".join(cell["source"]))
        last = tree.body[-1] if tree.body else None
        if isinstance(last, ast.Expr):
            tree.body.pop()
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(tree, str(NOTEBOOK), "exec"), names)
            value = None
            if isinstance(last, ast.Expr):
                value = eval(compile(ast.Expression(last.value), str(NOTEBOOK), "eval"), names)
        shown.append((printed.getvalue(), value))
    return shown


def outputs(printed: str, value: Any, number: int) -> list[dict[str, Any]]:
    """The same as a notebook's file has it: text, and pictures as PNG."""
    found: list[dict[str, Any]] = []
    if printed:
        found.append({"name": "stdout", "output_type": "stream", "text": printed.splitlines(keepends=True)})
    if value is not None:
        data: dict[str, Any] = {"text/plain": [repr(value)]}
        if isinstance(value, Image.Image):
            stream = io.BytesIO()
            value.save(stream, "PNG", optimize=True)
            data = {"image/png": base64.b64encode(stream.getvalue()).decode(), "text/plain": ["a picture"]}
        found.append({"data": data, "execution_count": number, "metadata": {}, "output_type": "execute_result"})
    return found


def main() -> None:
    """Run it, and write it with what it shows."""
    notebook = json.loads(NOTEBOOK.read_text())
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, (cell, (printed, value)) in enumerate(zip(code, run(notebook), strict=True), start=1):
        cell["execution_count"] = number
        cell["outputs"] = outputs(printed, value, number)
    NOTEBOOK.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
