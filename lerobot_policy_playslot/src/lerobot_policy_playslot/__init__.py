"""PlaySlot policies in LeRobot: `--policy.path=FOLDER`, and our tasks: `--env.type=playslot --env.task=button_press`.

LeRobot imports this package when one of its programs starts; that registers the policy and the environment. All that
computes is in `playslot_rl`.
"""

from lerobot_policy_playslot.configuration_playslot import PlaySlotConfig
from lerobot_policy_playslot.environment_playslot import PlaySlotEnv

__all__ = ["PlaySlotConfig", "PlaySlotEnv"]
