"""The three stages' losses, as TorchRL LossModules: TensorDict in, scalars `loss_*` (to be summed) and metrics out."""

from playslot_rl.losses.behaviour import ActionDecoderLoss, BehaviourLoss
from playslot_rl.losses.common import total_loss
from playslot_rl.losses.dynamics import DynamicsLoss
from playslot_rl.losses.slots import SlotsLoss

__all__ = ["ActionDecoderLoss", "BehaviourLoss", "DynamicsLoss", "SlotsLoss", "total_loss"]
