"""LAPO on slots: the same inverse and forward model on a frozen SAVi's slots, with PlaySlot's policy and decoder."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import Need, windows
from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.config.stages import DECODING
from playslot_rl.methods.lapo.method import QUANTISED, LatentConfig


@dataclass(frozen=True)
class LAPOSlotsConfig(LatentConfig):
    """LAPO on slots: transformers have the sizes of `model.policy`, `behaviour` trains policy and decoder."""

    group = "baselines.lapo_slots."

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        slots = config.model.savi.n_slots * config.model.savi.slot_dim
        yield windows(f"{name}.model", self.model, self.frames * slots)


NAME: Final = "lapo_slots"
_BUILT: Final = ("model.policy", *(f"baselines.lapo_slots.{key}" for key in QUANTISED))
_PARTS: Final = "playslot_rl.methods.lapo.slots_training"
MODEL: Final = StageSpec(
    "lapo_slots_model", keys=_BUILT, settings=("baselines.lapo_slots.model",), parents=("slots",),
    parts=f"{_PARTS}:model", title="LAPO's inverse and forward model on slots",
)  # fmt: skip
_SEEN: Final = ("trim", "trim_margin", "slot_noise", "shift", "shifted_copies", "loss")
_TRAINED: Final = ("steps", "batch_size", "optim", "precision", "decoder_steps", "decoder_lr")
POLICY: Final = StageSpec(
    NAME,
    keys=(
        *_BUILT, "model.action_decoder", "baselines.lapo_slots.targets", *(f"behaviour.{key}" for key in _SEEN),
    ),
    settings=(*DECODING, *(f"behaviour.{key}" for key in _TRAINED)),
    parents=("slots", MODEL.name),
    data="demos",
    parts=f"{_PARTS}:policy",
    also=("behaviour.policy_from",),
    sizes="playslot_rl.methods.cloning:slot_sizes",
)  # fmt: skip
LAPO_SLOTS: Final = Method(
    NAME, ("LAPO on slots",), Style(5, "$S$"), LAPOSlotsConfig, (MODEL, POLICY),
    Load(actor="playslot_rl.methods.lapo.slots:load_actor"), told="goal",
)  # fmt: skip
