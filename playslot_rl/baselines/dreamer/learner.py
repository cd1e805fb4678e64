"""DreamerV3 as a learner of the online loop."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import DreamerV3Loss, SoftUpdate
from torchrl.trainers.algorithms import DreamerV3OptimizationStepper, DreamerV3Optimizer

from playslot_rl import keys
from playslot_rl.baselines.dreamer.losses import build_loss, records
from playslot_rl.baselines.dreamer.networks import DreamerNetworks
from playslot_rl.config.baselines import DreamerConfig
from playslot_rl.losses.common import total_loss
from playslot_rl.seeding import StepGenerators


class DreamerLearner:
    """Acts from pixels and learns world model, actor and critic in one update.

    Args:
        networks: on the device it computes on.
        config: objective and optimiser.

    Attributes:
        stored: frames, reduced to the size it sees.
        loss: the objective; holds the slow critic and the scale of the returns.
    """

    stored: tuple[str, ...] = (keys.PIXELS,)

    def __init__(self, networks: DreamerNetworks, config: DreamerConfig) -> None:
        self.networks = networks
        self.loss = build_loss(networks, config).to(next(networks.parameters()).device)
        self._optimizer = DreamerV3Optimizer(self.loss.parameters(), lr=config.lr, warmup_steps=config.warmup)
        self._stepper = DreamerV3OptimizationStepper(
            self.loss,
            self._optimizer,
            SoftUpdate(self.loss.value_loss, tau=config.critic_rate),
            compile_train_step=False,
            cudagraph=False,
        )

        self._slow = _Slow(self.loss)

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """The networks, and what the objective holds beside them."""
        return {"networks": self.networks, "slow": self._slow}

    @property
    def optimizers(self) -> Mapping[str, torch.optim.Optimizer]:
        """The one optimiser of everything (LaProp with adaptive gradient clipping)."""
        return {"all": self._optimizer}

    def initial(self, n: int) -> TensorDict:
        """Zero states."""
        return self.networks.blank(n)

    def act(self, memory: TensorDictBase, generator: torch.Generator, explore: bool) -> TensorDictBase:
        """See `playslot_rl.baselines.online.learner.Learner.act`."""
        return act(self.networks, memory, generator if explore else None)

    def update(self, batch: TensorDict, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        """One step; TorchRL draws from the global generators, which the loop has seeded."""
        values = self._stepper.step(None, records(batch, self.networks))
        numbers = {str(key): value.reshape(()) for key, value in values.items() if value.numel() == 1}
        return {"loss": total_loss(numbers), **numbers}


class _Slow(nn.Module):
    """What the objective holds beside the networks and changes slowly: the slow critic and the returns' percentiles."""

    def __init__(self, loss: DreamerV3Loss) -> None:
        super().__init__()
        self.critic = loss.value_loss.target_value_model_params
        self.returns = loss.actor_loss.retnorm


def act(networks: DreamerNetworks, memory: TensorDictBase, generator: torch.Generator | None) -> TensorDict:
    """See a frame and choose an action.

    Args:
        networks: in eval mode.
        memory: `state` (n, S), `belief` (n, H), `keys.ACTION` (n, A) and `keys.PIXELS` uint8 (n, 3, H, W).
        generator: of state and action; None takes the most likely state and the mean action.

    Returns:
        The same keys anew; the frames reduced.
    """
    frames = networks.reduce(memory.get(keys.PIXELS))
    state, belief = networks.filter(
        memory.get("state"), memory.get("belief"), memory.get(keys.ACTION), frames, generator
    )
    mean, std = networks.actor(state, belief)
    action = mean
    if generator is not None:
        action = mean + std * torch.randn(mean.shape, generator=generator, device=mean.device)
    values = {"state": state, "belief": belief, keys.ACTION: action, keys.PIXELS: frames}
    return TensorDict(values, memory.batch_size)
