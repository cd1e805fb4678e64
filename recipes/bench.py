"""`playslot bench [--json FILE]`: speed of this machine, as ratios (see docs/performance.md)."""

from __future__ import annotations

from pathlib import Path

from playslot_rl.config import ExperimentConfig


def main(config: ExperimentConfig, json_path: Path | None = None) -> None:
    """Time the fast paths against the plain ones at the paper's sizes and print the ratios.

    Args:
        config: `threads` is used; `preset=smoke` takes tiny sizes that only show that everything runs.
        json_path: also write the figures there.

    Raises:
        PlaySlotError: a child died. RenderError: no GL backend. OutputError: the file cannot be written.
    """
    from playslot_rl.speed.cases import Sizes, quick_sizes
    from playslot_rl.speed.report import measure, table
    from playslot_rl.storage.atomic import write_json

    quick = config.preset == "smoke"
    figures = measure(
        quick_sizes() if quick else Sizes(), config.threads, quick, say=lambda text: print(f"{text} ...", flush=True)
    )
    print(f"\n{table(figures)}")
    if quick:
        print("tiny sizes (preset=smoke): these figures say nothing about speed")
    if json_path is not None:
        write_json(json_path, figures)
        print(f"written: {json_path}")
