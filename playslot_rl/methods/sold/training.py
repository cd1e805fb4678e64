"""Training of SOLD."""

from __future__ import annotations

from playslot_rl.methods.online.training import OnlineTraining
from playslot_rl.methods.sold.actor import build_networks, prior_steps
from playslot_rl.methods.sold.config import SOLDConfig
from playslot_rl.methods.sold.learner import SOLDLearner
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.record import StageRecord


def training(record: StageRecord) -> OnlineTraining:
    """A new learner on the slots of a finished SAVi."""
    config, slots = record.config, record.parents["slots"]
    own: SOLDConfig = config.baselines.sold
    before = prior_steps(own, slots)
    with global_seed(config.seed, 0, record.name):
        networks = build_networks(own, slots, config.env.action_dim, config.env.max_steps).to(record.device)
    learner = SOLDLearner(record.world.load_savi(record.device), networks, own, config.env.action_dim)
    return OnlineTraining(learner, own, dict(learner.trained), before)
