"""Puts what a GPU's bench measured into results/gpu.json, as the table `gpu_bench`:

playslot bench preset=paper device=cuda --json gpu.json
python docs/_site/bench_rows.py gpu.json COMMIT && make tables
"""

from __future__ import annotations

import datetime
import json
import re
import sys
from pathlib import Path
from typing import Any, Final

from playslot_rl.speed.gpu import rows

FILE: Final = Path(__file__).resolve().parents[2] / "results" / "gpu.json"
WIDTH: Final = 118


def filled(document: dict[str, Any], figures: dict[str, Any], commit: str) -> dict[str, Any]:
    """The file's content with the figures' rows, and how they were made."""
    machine = figures["machine"]
    table = document["tables"]["gpu_bench"]
    table["rows"] = rows(figures)
    table["made"] = [
        {
            "rows": None,
            "command": ["playslot bench preset=paper device=cuda --json gpu.json"],
            "commit": commit,
            "machine": f"one {machine['gpu']}, {machine['peak_tflops']:.0f} TFLOP/s in a large product, torch "
            f"{machine['torch']}, {machine['cores']} cores ({machine['cpu']})",
            "time": None,
            "date": datetime.date.today().isoformat(),
        }
    ]
    return document


def written(document: dict[str, Any]) -> str:
    """JSON in which what fits into a line is one."""

    def line(found: re.Match[str]) -> str:
        text = re.sub(r"\n\s+", " ", found[0])
        text = re.sub(r"([\[{]) | ([\]}])", r"\1\2", text)
        return text if len(text) <= WIDTH else found[0]

    text = json.dumps(document, indent=2, ensure_ascii=False)
    for inner in (r"\{[^{}\[\]]*\}", r"\[[^\[\]]*\]"):
        text = re.sub(inner, line, text)
    return text + "\n"


def main() -> None:
    figures, commit = json.loads(Path(sys.argv[1]).read_text()), sys.argv[2]
    FILE.write_text(written(filled(json.loads(FILE.read_text()), figures, commit)))
    print(f"written: results/{FILE.name}; now: make tables")


if __name__ == "__main__":
    main()
