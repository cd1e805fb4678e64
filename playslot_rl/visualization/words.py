"""Words for what files name by keys: a stage's metrics, a data set's features."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from playslot_rl import keys

SHARE: Final = "{:.0%}"
NUMBER: Final = "{:.3g}"
METRICS: Final = {
    "mse": ("mean squared image error", NUMBER),
    "mse_image": ("mean squared image error", NUMBER),
    "mse_slot": ("mean squared slot error", NUMBER),
    "psnr": ("PSNR", "{:.1f} dB"),
    "slots_in_use": ("slots in use", NUMBER),
    "largest_slot": ("the largest slot's share of the pixels", SHARE),
    "flicker": ("exchanges of slots a transition", NUMBER),
    "mask_entropy": ("entropy of the masks", "{:.2f} nats"),
    "moving_explained": ("share of the moving pixels' change that is drawn", SHARE),
    "usage": ("prototypes in use", SHARE),
    "perplexity": ("perplexity of the codes", NUMBER),
    "unexplained_parsed": ("policy, from parsed slots", SHARE),
    "unexplained_imagined": ("policy, from imagined slots", SHARE),
    "oracle_unexplained": ("slot oracle", SHARE),
    "decoder_trial_unexplained": ("trial of an action decoder that reads slots", SHARE),
    "decoder_unexplained": ("action decoder", SHARE),
    "finetune_unexplained": ("policy and decoder tuned together", SHARE),
}
"""Key of a stage's metric: its words, and how its value is written. Those of `unexplained` are variances."""
HELD_OUT: Final = "_held_out"
FEATURES: Final = {
    keys.FEATURE_STATE: "state of the robot",
    keys.FEATURE_ACTION: "action",
    keys.FEATURE_LATENT: "latent action",
    keys.FEATURE_CODE: "number of the latent action's prototype",
    keys.FEATURE_REWARD: "reward",
    keys.FEATURE_SUCCESS: "success",
    keys.FEATURE_DONE: "end of the episode",
    keys.FEATURE_SEED: "seed of the episode",
    keys.FEATURE_LAST: "last observation",
}
CAMERA: Final = "observation.images."


def metric_text(metrics: Mapping[str, Any]) -> str:
    """The numbers among a stage's metrics that no column of the report has; a dash where there are none."""
    found = []
    for key, value in metrics.items():
        name = key.removesuffix(HELD_OUT)
        if not isinstance(value, (int, float)) or "unexplained" in name:
            continue
        words, form = METRICS.get(name, (name.replace("_", " "), NUMBER))
        held = " on held-out episodes" if key != name else ""
        found.append(f"{words}{held} {form.format(value).replace('%', ' %')}")
    return "; ".join(found) or "–"


def feature_text(name: str) -> str:
    """A data set's feature in words, or its name where we do not know it."""
    if name.startswith(CAMERA):
        return f"camera {name.removeprefix(CAMERA)}"
    return FEATURES.get(name, name)
