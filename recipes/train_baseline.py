"""`playslot train-baseline method=M out=DIR`: a method to compare with (docs/explanation/methods.md)."""

from __future__ import annotations

from pathlib import Path

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.methods import METHODS, cloning_methods, require_told
from playslot_rl.envs import RECORDED, gym_id
from playslot_rl.errors import ConfigError


def main(config: ExperimentConfig) -> None:
    """Train `config.method` into `out`; killed, the same command carries on; finished, it says so."""
    if not config.out:
        raise ConfigError("out: got nothing, expected the folder of the baseline's run, such as out=runs/oracle")
    if config.run and Path(config.run).resolve() == Path(config.out).resolve():
        raise ConfigError(
            f"out: got {config.out}, the folder of run=, expected another: a baseline has a run folder of its own"
        )
    method = METHODS[config.method]
    if method.slots and not config.run:
        raise ConfigError(
            f"run: got nothing with method={config.method}, expected the world model whose slots it builds on: "
            "a run folder, or run=pretrained"
        )
    if config.env.name in RECORDED and method.online:
        able = ", ".join(cloning_methods())
        raise ConfigError(
            f"method: got {method.name}, which learns by acting, with env={config.env.name}, which has no simulator, "
            f"expected one that learns from demonstrations: {able}"
        )
    if method.acts and config.env.name not in RECORDED:
        gym_id(config.env.name)
    require_told(config, method.name)
    from playslot_rl.methods.training import train
    from playslot_rl.visualization.charts import draw_curve

    folder = train(config).path.parent
    draw_curve(folder, method.name)
    _hold_against_published(config, folder)


def _hold_against_published(config: ExperimentConfig, folder: Path) -> None:
    """Where its authors' curve on the task is known, a page with both."""
    from playslot_rl.studies import published

    if config.env.name in published.CURVES.get(config.method, {}):
        curve = published.read_curve(folder, config.env)
        page = published.write_page({f"seed {config.seed}": curve}, config.env.name, folder)
        print(f"{published.summary([curve], config.env.name)}; {page}", flush=True)
