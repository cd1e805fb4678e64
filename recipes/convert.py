"""`playslot convert env=sketchy data.root=DIR out=DIR`: a published data set in its own layout to LeRobot v3.0."""

from __future__ import annotations

from playslot_rl.config import ExperimentConfig
from playslot_rl.errors import ConfigError


def main(config: ExperimentConfig) -> None:
    """Convert the data set at `data.root`; `data.camera` (all of the paper's if empty), `env.image_size`,
    `collect.storage` and `episodes` (all if empty) are used, too.
    """
    from playslot_rl.data.contents import camera_list
    from playslot_rl.datasets.sketchy import PAPER_CAMERAS, convert_sketchy

    if config.env.name != "sketchy":
        raise ConfigError(f"env: got {config.env.name}, expected sketchy, the layout that can be converted")
    for name, value in (("data.root", config.data.root), ("out", config.out)):
        if not value:
            raise ConfigError(f"{name}: got nothing, expected a folder, such as {name}=data/sketchy")
    cameras = camera_list(config.data.camera) or PAPER_CAMERAS
    made = convert_sketchy(
        config.data.root,
        config.out,
        cameras=cameras,
        image_size=config.env.image_size,
        storage=config.collect.storage,
        episodes=config.episodes,
    )
    print(f"data sets: {config.out}/train ({made['train']} episodes), {config.out}/eval ({made['eval']} episodes)")
