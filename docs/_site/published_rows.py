"""Puts trainings whose authors' returns are known into results/dreamer_dmc.json, also while they train:

playslot train-baseline method=dreamer env=dmc_cartpole_balance seed=0 out=runs/dmc/0   # and other seeds
python docs/_site/published_rows.py COMMIT MACHINE TIME runs/dmc/0 runs/dmc/1 ... && make tables

It also writes `published.html` into the folder above the first run.
"""

from __future__ import annotations

import datetime
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from bench_rows import written

from playslot_rl.config.compose import stored_config
from playslot_rl.studies.published import DREAMER, SOURCE, Curve, against, read_curve, write_page

FILE: Final = Path(__file__).resolve().parents[2] / "results" / "dreamer_dmc.json"
QUESTION: Final = "Does DreamerV3 here learn as fast as its authors' on DeepMind Control from pixels?"


def table(env: str, curves: Sequence[Curve], made: dict[str, Any]) -> dict[str, Any]:
    """Of one task, as results/README.md says."""
    rows: list[list[Any]] = []
    for band, mean, verdict in against(curves, DREAMER[env]):
        values = [value for curve in curves if (value := band.of(curve)) is not None]
        here: Any = None
        if mean is not None:
            here = {"value": round(mean), "seeds": [round(min(values)), round(max(values))]}
        rows.append([band.frames, {"value": band.mean, "seeds": [band.low, band.high]}, here, verdict])
    return {
        "title": f"DreamerV3 on {env}: mean return of the training episodes within 5,000 frames. Published: {SOURCE}",
        "columns": [
            {"title": "frames"},
            {"title": "published, ten seeds"},
            {"title": f"here, {len(curves)} seed{'s' * (len(curves) != 1)}"},
            {"title": "verdict"},
        ],
        "rows": rows,
        "views": {"short": {"rows": [[frames] for frames in (10_000, 30_000, 50_000, 70_000, 150_000)]}},
        "made": [made],
    }


def main() -> None:
    commit, machine, time, *runs = sys.argv[1:]
    configs = [stored_config(Path(run)) for run in runs]
    (env,) = {config.env.name for config in configs}
    curves = {
        f"seed {config.seed}": read_curve(Path(run) / "dreamer", config.env)
        for config, run in zip(configs, runs, strict=True)
    }
    command = f"playslot train-baseline method=dreamer env={env} preset={configs[0].preset} seed=SEED out=RUN"
    made = {"rows": None, "command": [command], "commit": commit, "machine": machine, "time": time}
    made["date"] = datetime.date.today().isoformat()
    document = json.loads(FILE.read_text()) if FILE.exists() else {"question": QUESTION, "tables": {}}
    document["tables"][env] = table(env, list(curves.values()), made)
    FILE.write_text(written(document))
    print(f"written: results/{FILE.name}, {write_page(curves, env, Path(runs[0]).parent)}; now: make tables")


if __name__ == "__main__":
    main()
