"""Trainings of LAPO: inverse and forward model on videos; then a latent policy, and an action decoder."""

from __future__ import annotations

from playslot_rl.methods.cloning import cloning
from playslot_rl.methods.lapo.behaviour import LAPOBehaviour
from playslot_rl.methods.lapo.config import LAPOConfig
from playslot_rl.methods.lapo.model import ForwardModel, InverseModel
from playslot_rl.methods.lapo.stage import LAPOModelStage
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.fit import Part
from playslot_rl.training.record import StageRecord, Training


def model(record: StageRecord) -> Training:
    """New models on pairs of frames of the videos."""
    config, device = record.config, record.device
    own: LAPOConfig = config.baselines.lapo
    with global_seed(config.seed, 0, record.name):
        inverse, forward = InverseModel(own, config.env.image_size).to(device), ForwardModel(own).to(device)
    stage = LAPOModelStage(inverse, forward, record.clips(2, shown=256), own.model)
    return Training(
        [Part("baselines.lapo.model", stage, own.model)],
        device,
        lambda metrics: (
            f"{record.name}: {100 * metrics.get('unexplained', float('nan')):.0f} % of the change left on held-out "
            f"pairs, {record.folder}"
        ),
        extra={"episodes": record.data.episodes},
    )


def policy(record: StageRecord) -> Training:
    """New policy and decoder on the demonstrations."""
    own: LAPOConfig = record.config.baselines.lapo
    behaviour = LAPOBehaviour(record.config, record.parents["lapo_model"], record.demos, record.device)
    return cloning(record, behaviour, own.policy, own.decoder_steps, own.decoder_lr)
