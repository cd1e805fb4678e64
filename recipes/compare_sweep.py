"""The jobs of a comparison as a Hydra application, so that any Hydra launcher can run them.

`python -m playslot_rl.recipes.compare_sweep --multirun hydra/launcher=joblib +job=NAME,NAME +folder=OUT/jobs` is what
`playslot compare hydra.launcher=joblib` starts. Each job is a process of its own under the launcher's worker.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra

from playslot_rl.studies.launch import run_process


@hydra.main(version_base="1.3", config_path=None)
def main(config: Any) -> str:
    """Run one job; how it ended is in its status file, and a failed one does not stop the sweep."""
    return run_process(Path(config.folder) / f"{config.job}.json").status


if __name__ == "__main__":
    main()
