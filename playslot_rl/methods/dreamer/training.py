"""Training of DreamerV3."""

from __future__ import annotations

from playslot_rl.methods.dreamer.config import DreamerConfig
from playslot_rl.methods.dreamer.learner import DreamerLearner
from playslot_rl.methods.dreamer.networks import DreamerNetworks
from playslot_rl.methods.online.training import OnlineTraining
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.record import StageRecord


def training(record: StageRecord) -> OnlineTraining:
    """A new learner."""
    config = record.config
    own: DreamerConfig = config.baselines.dreamer
    with global_seed(config.seed, 0, record.name):
        networks = DreamerNetworks(own, config.env).to(record.device)
        return OnlineTraining(DreamerLearner(networks, own), own, {"networks": networks})
