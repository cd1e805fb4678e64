"""Every TensorDict key and every data set feature name, once.

Shapes use the project's symbols: B batch, T frames, N slots, D slot width, Z latent-action width, A action width,
H and W image height and width, C context length of the predictor.
"""

from __future__ import annotations

from typing import Final

# --- TensorDict keys ----------------------------------------------------------------------------------------------

PIXELS: Final = "pixels"
"""Frame(s): uint8 [0, 255] of shape (..., 3, H, W)."""
STATE: Final = "state_vector"
"""Proprioception: float32 (..., S). Not called "state", which TorchRL renames to "observation"."""
ACTION: Final = "action"
"""Real action: float32 (..., A) in [-1, 1]."""
SLOTS: Final = "slots"
"""Object slots: float32 (..., N, D)."""
SLOT_STATE: Final = "slot_state"
"""SAVi's recurrent state, the slots its corrector starts from at the next frame: float32 (..., N, D)."""
SLOT_AGE: Final = "slot_age"
"""Frames SAVi has parsed in this episode: int64 (..., 1); 0 means that the state is not initialised."""
LATENT_ACTION: Final = "latent_action"
"""Latent action z: float32 (..., Z), or (..., N, Z) with one per slot."""
PROTOTYPE: Final = "action_prototype"
"""Action prototype p = VQ(z): float32, shape of z."""
VARIABILITY: Final = "action_variability"
"""Action variability v = z - p: float32, shape of z."""
CODE: Final = "action_code"
"""Index of the prototype: int64, shape of z without its last dimension."""
SLOT_HISTORY: Final = "slot_history"
"""Right-aligned slots of the imagined past: float32 (..., C, N, D)."""
ACTION_HISTORY: Final = "latent_action_history"
"""Right-aligned latent actions of the imagined past: float32 (..., C, [N,] Z)."""
HISTORY_LENGTH: Final = "history_length"
"""Valid frames in SLOT_HISTORY: int64 (..., 1)."""
STEP_COUNT: Final = "step_count"
"""Steps since the reset: int64 (..., 1); the name TorchRL's StepCounter uses."""
PREDICTED_SLOTS: Final = "predicted_slots"
"""Slots predicted by cOCVP: float32 (B, T, N, D)."""
PREDICTED_PIXELS: Final = "predicted_pixels"
"""Frames rendered from slots: float32, about [0, 1], (..., 3, H, W)."""
MASKS: Final = "masks"
"""Slot masks that sum to one over N: float32 (..., N, 1, H, W)."""
OBJECT_MOVES: Final = "object_moves"
"""What each object did, where it is known: int64 (..., O), index into `playslot_rl.envs.grid_shapes.MOVES`."""
OBJECT_MASKS: Final = "object_masks"
"""True masks, where they are known: uint8 (..., H, W), 0 the ground, o + 1 object o."""
SUCCESS: Final = "success"
"""Whether the task has been solved: bool (..., 1)."""
REWARD: Final = "reward"
"""Reward received on the way to a frame: float32 (..., 1), the mean over the environment steps of an agent step."""
IS_FIRST: Final = "is_first"
"""True on the first frame of an episode, whose action and reward are zero: bool (..., 1)."""
IS_LAST: Final = "is_last"
"""True on the last frame of an episode: bool (..., 1)."""
EPISODE: Final = "episode"
"""Number of the episode a replayed frame belongs to: int64 (...)."""

# --- LeRobot features ---------------------------------------------------------------------------------------------

FEATURE_IMAGE: Final = "observation.images.front"
"""Frame of our own data sets (any camera feature can be read)."""
FEATURE_STATE: Final = "observation.state"
FEATURE_ACTION: Final = "action"
FEATURE_REWARD: Final = "next.reward"
FEATURE_SUCCESS: Final = "next.success"
FEATURE_DONE: Final = "next.done"
FEATURE_SEED: Final = "seed"
FEATURE_LAST: Final = "is_last_observation"
"""True on an episode's last row: its observation is real, its action is padding."""
