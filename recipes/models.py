"""`playslot models`: the models that ship, with their numbers."""

from __future__ import annotations

from playslot_rl.config import ExperimentConfig
from playslot_rl.sharing.models import shipped_models


def main(config: ExperimentConfig, as_json: bool = False) -> None:
    """Print them, or the one that `run` names."""
    found = shipped_models(config.run.removeprefix("pretrained").removeprefix("/"))
    print(found.to_json() if as_json else "\n".join(found.lines()))
