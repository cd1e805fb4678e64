"""`playslot evaluate run=DIR protocol=slots`: slots against the simulator's own segmentation.

Writes `DIR/evaluation/slots/eval_info.json` and renews the report.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from playslot_rl.config import ExperimentConfig
from playslot_rl.runs import Run
from playslot_rl.runtime.devices import open_device


def main(config: ExperimentConfig, run: Run) -> None:
    """Score the slots of `run` on the scripted expert's episodes and print the result."""
    from playslot_rl.evaluation.objects import SLOTS_RESULT, evaluate_slots

    device = open_device(config.device, config.threads)
    print(describe(evaluate_slots(run, run.folder, config, device), run.folder / SLOTS_RESULT), flush=True)


def main_if_needed(config: ExperimentConfig, run: Run) -> None:
    """As `main` with the default number of episodes, unless these slots were scored with this seed before."""
    from playslot_rl.evaluation.objects import SLOTS_RESULT

    facts = {"seed": config.seed, "fingerprints": {"slots": run.stage("slots").fingerprint}}
    stored = run.result(SLOTS_RESULT, facts)
    if stored is not None:
        print(f"slots: scored before, FG-ARI {stored['foreground_ari']:.2f}, skipped", flush=True)
        return
    main(replace(config, episodes=None), run)


def describe(result: dict[str, Any], path: Path) -> str:
    """The result in two lines."""
    return (
        f"{'slots':>22}: FG-ARI {result['foreground_ari']:.2f}, ARI {result['ari']:.2f}, "
        f"{result['slots_per_object']:.1f} slots an object, reconstruction {result['psnr']:.1f} dB\n"
        f"{result['episodes']} episodes of the expert, {result['wall_seconds']:.0f} s; written to {path}"
    )
