"""`playslot inspect run=RUN data.root=SET`: a report card of a world model, measured on held-out episodes.

Writes `RUN/inspect/inspect.json`, `inspect.md`, `inspect.html` and `figures/`; of a pretrained one into `OUT/inspect/`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.weights import data_roots
from playslot_rl.errors import DataError
from playslot_rl.runs import Run
from playslot_rl.runs.opening import run_of_pretrained, run_to_read, run_to_write
from playslot_rl.runtime.devices import open_device
from playslot_rl.storage.atomic import write_json


def main(config: ExperimentConfig) -> None:
    """Measure the world model of `config.run` on a data set; print a line for each measure, and one for the verdict.

    A pretrained model (`run=pretrained/ENV`) is made a run in `out` first, as `evaluate` does.
    """
    from playslot_rl.data.videos import open_videos
    from playslot_rl.evaluation.card import DEFAULT_EPISODES, FOLDER, RESULT, card_json, make_card
    from playslot_rl.evaluation.card_lines import concluded
    from playslot_rl.visualization.card_page import card_document
    from playslot_rl.visualization.document import write_document

    run, began = opened(config), time.perf_counter()
    model = run.load_world_model(open_device(config.device, config.threads))
    sized = replace(config, env=replace(config.env, image_size=model.env.image_size))
    source = open_videos(sized, config.data.root, "inspect")
    stages = run.world_stages | ({"policy": run.own("policy")} if run.has("policy") else {})
    metas = {name: stage.meta for name, stage in stages.items()}
    card = make_card(model, source, metas, config.data, config.episodes or DEFAULT_EPISODES, config.seed)
    out = (run_of_pretrained(config, run) if run.pretrained else run).folder
    result = card_json(card, source, facts(config, run), began)
    page = write_document(card_document(result, card, model), out / FOLDER, "inspect")
    write_json(out / RESULT, result)
    print(f"{describe(result)}\nreport card: {page}\n{concluded(result)}", flush=True)


def opened(config: ExperimentConfig) -> Run:
    """The run to inspect."""
    run = run_to_read(config, "inspect", "a run with a world model, such as run=runs/mine or run=pretrained")
    if run.pretrained:
        run_to_write(config)  # refused now, not after minutes
    return run


def facts(config: ExperimentConfig, run: Run) -> dict[str, Any]:
    """What a stored card must share to be this one."""
    from playslot_rl.evaluation.card import DEFAULT_EPISODES

    names = [Path(root.path).name for root in data_roots(config.data.root)]
    return {
        "run": config.run if run.pretrained else run.folder.resolve().name,
        "data": ", ".join(names),
        "episodes": config.episodes or DEFAULT_EPISODES,
        "seed": config.seed,
        "fingerprints": {name: stage.fingerprint for name, stage in run.world_stages.items()},
    }


def main_if_needed(config: ExperimentConfig) -> None:
    """As `main`, unless this world model was inspected on these videos before; where they cannot measure it (nothing
    moves) that is said, and the rest of a pipeline goes on. The last line is the verdict in every case.
    """
    from playslot_rl.evaluation.card import RESULT
    from playslot_rl.evaluation.card_lines import Conclusion, concluded

    run = Run.open(config.run)
    stored = run.result(RESULT, facts(config, run))
    if stored is not None and ("code_actions" in stored["details"] or "code_counts" not in stored["details"]):
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
