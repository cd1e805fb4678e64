"""`playslot inspect run=RUN data.root=SET`: a report card of a world model, measured on held-out episodes.

Writes `RUN/inspect/inspect.json`, `inspect.md`, `inspect.html` and `figures/`; of a shipped model into `OUT/inspect/`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import shipped
from playslot_rl.config.weights import data_roots
from playslot_rl.errors import ConfigError, DataError
from playslot_rl.recipes.evaluate import take_shipped
from playslot_rl.recipes.run import existing_run, open_device, open_run, parent_run, stored_result

if TYPE_CHECKING:
    from playslot_rl.data.source import EpisodeFrames
    from playslot_rl.world_model import WorldModel


def main(config: ExperimentConfig) -> None:
    """Measure the world model of `config.run` on a data set; print a line for each measure, and one for the verdict.

    A shipped model (`run=pretrained/ENV`) is made a run in `out` first, as `evaluate` does.

    Args:
        config: `run`, `data`, `episodes` (looked at, at most; 200 if None), `seed`, `device`, `out`.

    Raises:
        ConfigError: no run, no `out` for a shipped model, or `out` names another folder.
        CheckpointError: the run does not exist or has no finished world model.
        DataError: the data set cannot be read, has another frame size, or nothing in it moves.
        OutputError: the result cannot be written.
    """
    from playslot_rl.evaluation.card import DEFAULT_EPISODES, FOLDER, card_json, make_card, write_card
    from playslot_rl.evaluation.card_verdict import concluded
    from playslot_rl.training.runs import load_world_model
    from playslot_rl.visualization.card import card_document
    from playslot_rl.visualization.document import write_document

    run, began = check_run(config), time.perf_counter()
    model = load_world_model(run, open_device(config))
    source = open_set(config, model)
    card = make_card(model, source, stage_metas(run), config.data, config.episodes or DEFAULT_EPISODES, config.seed)
    out = take_shipped(config) if shipped(config.run) else Path(config.run)
    result = card_json(card, source, facts(config, run), began)
    page = write_document(card_document(result, card, model), out / FOLDER, "inspect")
    write_card(out, result)
    print(f"{describe(result)}\nreport card: {page}\n{concluded(result)}", flush=True)


def check_run(config: ExperimentConfig) -> str:
    """The run as `load_world_model` takes it.

    Raises:
        ConfigError: none was named, no `out` for a shipped model, or `out` names another folder.
        CheckpointError: there is no such folder.
        OutputError: `out` holds something else.
    """
    if not config.run:
        raise ConfigError(
            "run: got nothing, expected a run with a world model, such as run=runs/mine or run=pretrained"
        )
    if shipped(config.run):
        open_run(config)  # refused now, not after minutes
        return parent_run(config, Path())
    existing_run(config, "inspect", "train one by `playslot pipeline`")
    return config.run


def open_set(config: ExperimentConfig, model: WorldModel) -> EpisodeFrames:
    """The data set(s) of `data.root`, in frames of the model's size.

    Raises:
        DataError: none is named, or it cannot be read.
    """
    from dataclasses import replace

    from playslot_rl.training.record import open_videos

    env = replace(config.env, image_size=model.env.image_size)
    return open_videos(replace(config, env=env), config.data.root, "inspect")


def stage_metas(run: str) -> dict[str, dict[str, Any]]:
    """Stage -> `meta.json` of the world model that a run uses, and of its policy if it has one."""
    from playslot_rl.storage.checkpoints import checkpoint_folder, read_stage
    from playslot_rl.training.runs import run_folder, world_model_checkpoints

    stages = dict(world_model_checkpoints(run))
    policy = checkpoint_folder(run_folder(run), "policy")
    if (policy / "meta.json").is_file():
        stages["policy"] = read_stage(policy, "policy")
    return {name: stage.meta for name, stage in stages.items()}


def facts(config: ExperimentConfig, run: str) -> dict[str, Any]:
    """What a stored card must share to be this one."""
    from playslot_rl.evaluation.card import DEFAULT_EPISODES
    from playslot_rl.training.runs import world_model_checkpoints

    names = [Path(root.path).name for root in data_roots(config.data.root)]
    return {
        "run": config.run if shipped(config.run) else Path(config.run).resolve().name,
        "data": ", ".join(names),
        "episodes": config.episodes or DEFAULT_EPISODES,
        "seed": config.seed,
        "fingerprints": {name: stage.fingerprint for name, stage in world_model_checkpoints(run).items()},
    }


def main_if_needed(config: ExperimentConfig) -> None:
    """As `main`, unless this world model was inspected on these videos before; where they cannot measure it (nothing
    moves) that is said, and the rest of a pipeline goes on. The last line is the verdict in every case.
    """
    from playslot_rl.evaluation.card import RESULT
    from playslot_rl.evaluation.card_verdict import Conclusion, concluded

    stored = stored_result(Path(config.run) / RESULT, facts(config, config.run))
    if stored is not None:
        print(f"inspect: made before, skipped\n{concluded(stored)}", flush=True)
        return
    try:
        main(config)
    except DataError as error:
        print(f"inspect: not made\n{Conclusion(False, str(error))}", flush=True)


def describe(result: Mapping[str, Any]) -> str:
    """The card in as many lines as it has."""
    lines = []
    for one in result["lines"]:
        value = "     " if one["value"] is None else f"{one['value']:5.2f}"
        note = f"not measured: {one['note']}" if one["value"] is None else f"{one['verdict']:<5} {one['note']}"
        lines.append(f"{one['key']:>18}: {value} {note}")
    tested, fitted = len(result["episodes_tested"]), result["episodes_fitted"]
    return "\n".join([*lines, f"{tested} episodes tested ({result['held_out']}), probes fitted on {fitted} others"])
