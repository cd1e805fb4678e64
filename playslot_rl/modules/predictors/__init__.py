"""Predictors of the next frame's slots, behind one protocol, and the choice among them."""

from __future__ import annotations

from playslot_rl.config import PredictorConfig
from playslot_rl.errors import ConfigError
from playslot_rl.modules.predictors.cocvp import COCVP
from playslot_rl.modules.predictors.ocvp_seq import OCVPSeq
from playslot_rl.modules.predictors.predictor import AutoregressivePredictor, Predictor
from playslot_rl.modules.predictors.slotformer import SlotFormer

__all__ = ["COCVP", "AutoregressivePredictor", "OCVPSeq", "Predictor", "SlotFormer", "build_predictor"]


def build_predictor(
    config: PredictorConfig, slot_dim: int, latent_dim: int, per_slot: bool = False
) -> AutoregressivePredictor | SlotFormer:
    """The world model's predictor, conditioned on prototype p and variability v, by `config.kind`.

    Args:
        latent_dim: Z, of p and of v; 0 where nothing is inferred.
        per_slot: each slot has a latent action of its own.

    Raises:
        ConfigError: OCVP-Seq, which has one action token a frame, with a latent action per slot; SlotFormer, which has
            none, with latent actions; cOCVP without.
    """
    if (config.kind == "slotformer") != (latent_dim == 0) and config.kind != "ocvp_seq":
        wanted = "none" if latent_dim else "slotformer or ocvp_seq"
        key = "model.inverse_dynamics.mode" if latent_dim else "model.predictor.kind"
        why = "takes no latent actions" if latent_dim else "takes latent actions"
        raise ConfigError(f"{key}: got a predictor {config.kind}, which {why}, expected {wanted}: set one of them")
    if config.kind == "slotformer":
        return SlotFormer(config, slot_dim)
    if config.kind == "cocvp":
        return COCVP(config, slot_dim, latent_dim)
    if per_slot:
        raise ConfigError(
            "model.predictor.kind: got ocvp_seq with model.inverse_dynamics.variant=multi, expected cocvp: OCVP-Seq "
            "takes one latent action a frame; set one of them"
        )
    return OCVPSeq(config, slot_dim, 2 * latent_dim)
