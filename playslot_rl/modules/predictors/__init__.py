"""Predictors of the next frame's slots, behind one protocol, and the choice among them."""

from __future__ import annotations

from playslot_rl.config import PredictorConfig
from playslot_rl.errors import ConfigError
from playslot_rl.modules.predictors.cocvp import COCVP
from playslot_rl.modules.predictors.ocvp_seq import OCVPSeq
from playslot_rl.modules.predictors.predictor import AutoregressivePredictor, Predictor

__all__ = ["COCVP", "AutoregressivePredictor", "OCVPSeq", "Predictor", "build_predictor"]


def build_predictor(
    config: PredictorConfig, slot_dim: int, latent_dim: int, per_slot: bool = False
) -> AutoregressivePredictor:
    """The world model's predictor, conditioned on prototype p and variability v, by `config.kind`.

    Args:
        config: kind and sizes.
        slot_dim: D.
        latent_dim: Z, of p and of v.
        per_slot: each slot has a latent action of its own.

    Raises:
        ConfigError: OCVP-Seq, which has one action token a frame, with a latent action per slot.
    """
    if config.kind == "cocvp":
        return COCVP(config, slot_dim, latent_dim)
    if per_slot:
        raise ConfigError(
            "model.predictor.kind: got ocvp_seq with model.inverse_dynamics.variant=multi, expected cocvp: OCVP-Seq "
            "takes one latent action a frame; set one of them"
        )
    return OCVPSeq(config, slot_dim, 2 * latent_dim)
