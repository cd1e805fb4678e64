"""Gymnasium ids of the blocks family: every variant with every task, and the one easy setting."""

from __future__ import annotations

from typing import Final

from playslot_rl.config import BlocksConfig, EnvConfig

VARIANTS: Final = {"push": "Push", "reach": "Reach", "pick": "Pick"}
TASKS: Final = {"red": "Red", "reddest": "Reddest", "odd": "Odd", "odd_groups": "OddGroups"}
EASY: Final = BlocksConfig(distractors=0, colour="mediumblue")
"""One cube, always of the same colour."""


def block_config(name: str, blocks: BlocksConfig) -> EnvConfig:
    """25 agent steps of two environment steps, without warm-up."""
    return EnvConfig(name, frame_skip=2, max_steps=25, warmup_steps=0, blocks=blocks)


def family() -> dict[str, tuple[str, EnvConfig]]:
    """Gymnasium id -> entry point and the configuration it starts from (three distractors, dense reward)."""
    found = {}
    for variant, name in VARIANTS.items():
        entry = f"playslot_rl.envs.block_push:Block{name}Env"
        for task, suffix in TASKS.items():
            config = block_config(f"block_{variant}", BlocksConfig(task=task))  # type: ignore[arg-type]
            found[f"PlaySlot/Block{name}{suffix}-v0"] = entry, config
        found[f"PlaySlot/Block{name}-v0"] = found[f"PlaySlot/Block{name}Odd-v0"]
    easy = block_config("block_push_easy", EASY)
    return {**found, "PlaySlot/BlockPushEasy-v0": ("playslot_rl.envs.block_push:BlockPushEnv", easy)}
