"""What a task must have for a method that learns by acting: a simulator and a dense reward."""

from __future__ import annotations

from playslot_rl.config import ExperimentConfig
from playslot_rl.envs import gym_id
from playslot_rl.errors import ConfigError
from playslot_rl.methods.online.config import OnlineConfig
from playslot_rl.runtime.processes import here
from playslot_rl.seeds.episodes import EPISODES


def require_online(config: ExperimentConfig, online: OnlineConfig, method: str) -> None:
    """Refuse what cannot be learned by acting, before anything is started: a ConfigError for several processes, an
    environment without simulator or dense reward, or more episodes than a seed has.
    """
    if here().world > 1:
        raise ConfigError(
            f"method={method}: got {here().world} processes, expected one: it learns by acting; start it without "
            "torchrun or accelerate launch"
        )
    gym_id(config.env.name)
    if config.env.name.startswith("block_") and config.env.blocks.reward != "dense":
        raise ConfigError(
            f"env.blocks.reward: got {config.env.blocks.reward} with method={method}, expected dense: "
            "methods that learn by acting need a dense reward; set env.blocks.reward=dense"
        )
    episodes = online.steps // config.env.max_steps + online.envs
    if episodes > EPISODES:
        raise ConfigError(
            f"steps: got {episodes} episodes, expected at most {EPISODES}; lower it, or raise env.max_steps"
        )
