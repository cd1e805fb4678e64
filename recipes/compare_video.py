"""`playslot compare-video methods=M,... seeds=S,... out=DIR`: predictors side by side (docs/how-to/compare.md)."""

from __future__ import annotations

from dataclasses import replace

from playslot_rl.config import ExperimentConfig


def main(config: ExperimentConfig) -> None:
    """Run what is missing, reuse what is done, write `OUT/video.json`, `.md`, `.png`, `.svg` and sheets of frames.

    With `objects=` this is done for each number of them, in `OUT/objects_N`, and `OUT` gets the table of all.
    """
    from playslot_rl.runs import Run
    from playslot_rl.studies.study import run_study
    from playslot_rl.studies.video.measure import VideoMeasure, each_number

    run = Run.of(config).name if config.run else ""  # `pretrained` is the task's own
    config = replace(config, out=config.out or f"runs/video_{config.env.full_name}_{config.preset}", run=run)
    if config.compare_video.objects:
        each_number(config)
    else:
        run_study(VideoMeasure(config))
