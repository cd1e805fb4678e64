"""From a run to a model folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig
from playslot_rl.errors import ConfigError
from playslot_rl.sharing.card import make_card
from playslot_rl.sharing.config import SharedPolicyConfig
from playslot_rl.sharing.folder import save_pretrained
from playslot_rl.sharing.source import read_results, read_source
from playslot_rl.training.runs import load_agent


def export_run(
    run: Path, folder: Path, config: ExperimentConfig, source: dict[str, Any] | None = None
) -> SharedPolicyConfig:
    """Write the policy of a run to a new folder.

    Args:
        run: with a finished policy.
        folder: must not exist.
        config: of the run; `data.camera` and `data.resize` say what the policy looks at.
        source: `read_source(run)`, if it has been read.

    Raises:
        CheckpointError: no policy, or damaged checkpoints.
        ConfigError: the policy was trained on several cameras, and `data.camera` does not choose one.
        OutputError: `folder` exists, or cannot be written.
    """
    source = source or read_source(run)
    results = read_results(run, source)
    agent = load_agent(run)
    policy = SharedPolicyConfig(
        env=agent.world_model.env,
        model=agent.world_model.config,
        camera=camera(config),
        resize=config.data.resize,
        source=source,
    )
    return save_pretrained(
        agent, folder, policy, lambda written: make_card(folder.name, written, agent, config, results)
    )


def camera(config: ExperimentConfig) -> str:
    """LeRobot's name of the camera a run looks at: `data.camera`, else the only one of its demonstrations.

    Where the demonstrations are no longer there it is that of our own data sets.

    Raises:
        ConfigError: there are several.
    """
    names = [name.strip() for name in config.data.camera.split(",") if name.strip()]
    if not names:
        root = (config.data.demos or config.data.root).partition(",")[0].strip()
        names = _cameras(Path(root)) if root else []
    if len(names) > 1:
        raise ConfigError(f"data.camera: got {', '.join(names)}, expected the one the policy is to look at: name it")
    return names[0] if names else keys.FEATURE_IMAGE


def _cameras(root: Path) -> list[str]:
    """Image and video features of a LeRobot data set; none where it cannot be read."""
    try:
        features = json.loads((root / "meta" / "info.json").read_text())["features"]
    except (OSError, ValueError, KeyError):
        return []
    return [name for name, feature in features.items() if feature.get("dtype") in ("image", "video")]
