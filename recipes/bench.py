"""`playslot bench [device=cuda] [--json FILE]`: speed of this machine, and what a training step costs (see
docs/results/speed.md)."""

from __future__ import annotations

from pathlib import Path

from playslot_rl.config import ExperimentConfig


def main(config: ExperimentConfig, json_path: Path | None = None) -> None:
    """Time the fast paths at the paper's sizes, or what a GPU makes of two presets' steps; count the preset's steps,
    print both, and write the figures to `json_path`. `preset=smoke` takes tiny sizes that only show that everything
    runs.
    """
    from playslot_rl.runtime.devices import open_device
    from playslot_rl.speed import gpu
    from playslot_rl.speed.cases import Sizes, quick_sizes
    from playslot_rl.speed.report import cost_tables, measure, table
    from playslot_rl.storage.atomic import write_json

    def say(text: str) -> None:
        print(f"{text} ...", flush=True)

    quick = config.preset == "smoke"
    on_gpu = config.device.startswith("cuda")
    if on_gpu:
        figures = gpu.measure(open_device(config.device, config.threads), config.threads, quick, say)
    else:
        figures = measure(quick_sizes() if quick else Sizes(), config.threads, quick, say)
    print(f"\n{gpu.table(figures) if on_gpu else table(figures)}")
    if quick:
        print("tiny sizes (preset=smoke): these figures say nothing about speed")
    if json_path is not None:
        write_json(json_path, figures)
        print(f"written: {json_path}")
    print(f"\nA training step of preset={config.preset}:\n\n{cost_tables(config, lambda _: None)}")
