"""What `playslot evaluate` does where nothing can be acted on (GridShapes), slots against known objects and moves, and
by `protocol=slots`: slots against the simulator's own segmentation.

Writes `RUN/evaluation/objects/eval_info.json`, or `slots/` beside it, and renews `RUN/report.md` and `RUN/report.html`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from playslot_rl.config import ExperimentConfig
from playslot_rl.runs import Run
from playslot_rl.runs.opening import require_task
from playslot_rl.runtime.devices import open_device


def main(config: ExperimentConfig, run: Run) -> None:
    """Score the world model of `run` and print the result."""
    from playslot_rl.evaluation.objects import evaluate_run_objects
    from playslot_rl.visualization.report import write_report

    model = run.load_world_model(open_device(config.device, config.threads))
    require_task(config, model.env)
    print(
        f"{config.env.name}: nothing to act on, so slots and latent actions are scored instead of a policy", flush=True
    )
    print(describe(evaluate_run_objects(run, model, config), run.folder), flush=True)
    print(f"report: {write_report(run.folder, world_model=model)}", flush=True)


def main_if_needed(config: ExperimentConfig, run: Run) -> None:
    """As `main`, unless this world model was scored on these clips before."""
    from playslot_rl.evaluation.before import simulated_before
    from playslot_rl.evaluation.objects import DEFAULT_CLIPS, RESULT

    prints = {name: stage.fingerprint for name, stage in run.world_stages.items()}
    stored = simulated_before(run, RESULT, config, prints, config.episodes or DEFAULT_CLIPS)
    if stored is not None and (run.folder / "report.html").is_file():
        print(f"objects: scored before, ARI {stored['ari']:.2f}, skipped", flush=True)
        return
    main(config, run)


def describe(result: dict[str, Any], run: Path) -> str:
    """The result in a few lines."""
    from playslot_rl.evaluation.objects import RESULT

    ahead = result["prediction"]
    seen = f"over {ahead['predicted_frames']} frames after {ahead['seed_frames']} seen"
    lines = [
        f"{'ARI':>22}: {result['ari']:.2f}, of the objects alone {result['foreground_ari']:.2f}",
        f"{'prediction':>22}: {ahead['psnr']:.1f} dB {seen}, reconstruction {result['reconstruction']['psnr']:.1f} dB",
    ]
    for name, probe in result["probes"].items():
        lines.append(
            f"{f'move from {name}':>22}: {100 * probe['accuracy']:.0f} % of {probe['test']} moves in "
            f"{probe['test_clips']} held-out clips (most frequent move {100 * probe['majority']:.0f} %)"
        )
    return "\n".join([*lines, f"{result['episodes']} clips, {result['wall_seconds']:.0f} s; written to {run / RESULT}"])


def score_slots(config: ExperimentConfig, run: Run) -> None:
    """Score the slots of `run` on the scripted expert's episodes and print the result."""
    from playslot_rl.evaluation.objects import SLOTS_RESULT, evaluate_slots

    result = evaluate_slots(run, run.folder, config, open_device(config.device, config.threads))
    print(
        f"{'slots':>22}: FG-ARI {result['foreground_ari']:.2f}, ARI {result['ari']:.2f}, "
        f"{result['slots_per_object']:.1f} slots an object, reconstruction {result['psnr']:.1f} dB\n"
        f"{result['episodes']} episodes of the expert, {result['wall_seconds']:.0f} s; written to "
        f"{run.folder / SLOTS_RESULT}",
        flush=True,
    )


def score_slots_if_needed(config: ExperimentConfig, run: Run) -> None:
    """As `score_slots` with the default number of episodes, unless these slots were scored with this seed before."""
    from playslot_rl.evaluation.before import simulated_before
    from playslot_rl.evaluation.objects import DEFAULT_SCENES, SLOTS_RESULT

    prints = {"slots": run.stage("slots").fingerprint}
    stored = simulated_before(run, SLOTS_RESULT, config, prints, DEFAULT_SCENES)
    if stored is not None:
        print(f"slots: scored before, FG-ARI {stored['foreground_ari']:.2f}, skipped", flush=True)
        return
    score_slots(replace(config, episodes=None), run)
