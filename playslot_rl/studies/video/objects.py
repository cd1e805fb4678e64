"""Videos of GridShapes by the number of objects: one study for each number, and one table of all."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from playslot_rl.config import ExperimentConfig
from playslot_rl.errors import ConfigError, PlaySlotError
from playslot_rl.storage.atomic import write_json, write_text
from playslot_rl.studies.video.page import objects_page
from playslot_rl.visualization.document import to_markdown


def each_number(config: ExperimentConfig, compare: Callable[[ExperimentConfig], None]) -> None:
    """Run the study for each of `compare_video.objects`, and write `OUT/video.json` and `OUT/video.md`.

    With N objects a frame has N + 1 slots, and an action two numbers for each object.

    Raises:
        ConfigError: another task, or videos that have their number of objects already.
        PlaySlotError: trainings failed; all others have finished, and the tables say so.
    """
    own, out, failed = config.compare_video, Path(config.out), list[str]()
    if config.env.name != "grid_shapes" or config.data.root or own.test or config.run:
        raise ConfigError(
            "objects: got a task or videos with a number of objects of their own, expected env=grid_shapes without "
            "data.root=, compare_video.test= and run="
        )
    found = {}
    for number in own.objects:
        part = out / f"objects_{number}"
        try:
            compare(_with_objects(config, number, part))
        except PlaySlotError as error:
            if not (part / "video.json").is_file():
                raise
            failed.append(str(error))
        found[str(number)] = json.loads((part / "video.json").read_text())
        write_json(out / "video.json", {"objects": found})
        write_text(out / "video.md", to_markdown(objects_page(found)))
    print(f"compare-video: {out / 'video.md'}", flush=True)
    if failed:
        raise PlaySlotError("; ".join(failed))


def _with_objects(config: ExperimentConfig, number: int, out: Path) -> ExperimentConfig:
    grid = replace(config.env.grid, objects=number)
    savi = replace(config.model.savi, n_slots=number + 1)
    return replace(
        config,
        env=replace(config.env, grid=grid, action_dim=2 * number),
        model=replace(config.model, savi=savi),
        compare_video=replace(config.compare_video, objects=()),
        out=str(out),
    )
