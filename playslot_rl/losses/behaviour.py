"""Stage 3: cloning latent actions, and decoding them to real ones (paper, "Learning behaviours").

    L_pi = mean (f_pi(S_t) - z_t)^2,   L_a = mean (D_a(z_t) - a_t)^2

or, with `loss_function="l1"`, the means of the absolute differences. A policy with a `whitening` W is compared in its
coordinates, W (f_pi(S_t) - z_t); a decoder that reads slots gets S_t beside z_t.

Shapes: N slots, D slot width, Z latent-action width, A action width; "..." is any batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import LossModule

from playslot_rl import keys
from playslot_rl.modules.policy import told_keys
from playslot_rl.runtime.shares import averaged


class _CloningLoss(LossModule):
    """Mean squared (or absolute) error of a network's output to an action; the two losses below name the keys. A
    ValueError for a loss function that is neither `l2` (paper) nor `l1`.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that `set_keys` can rename: what the network reads, the target, what a decoder with `reads_slots` reads
        beside it, the task or the goal's slots that a policy is told, and an optional mask, bool (...), that leaves
        targets out where it is False.
        """

        observation: NestedKey = keys.SLOTS
        action: NestedKey = keys.LATENT_ACTION
        mask: NestedKey = "mask"
        state: NestedKey = keys.SLOTS
        task: NestedKey = keys.TASK
        goal: NestedKey = keys.GOAL_SLOTS

    tensor_keys: _AcceptedKeys
    default_keys: ClassVar[type[Any]] = _AcceptedKeys
    out_name = "loss_cloning"

    def __init__(self, network: nn.Module, loss_function: str = "l2") -> None:
        super().__init__()
        if loss_function not in ("l1", "l2"):
            raise ValueError(f"loss_function: got {loss_function!r}, expected l1 or l2")
        self.network = network
        self.loss_function = loss_function

    @property
    def observed(self) -> list[NestedKey]:
        """What the network reads, in its order: a policy may be told a task or a goal."""
        named = {keys.TASK: self.tensor_keys.task, keys.GOAL_SLOTS: self.tensor_keys.goal}
        return [self.tensor_keys.observation, *(named[key] for key in told_keys(self.network))]

    @property
    def in_keys(self) -> list[NestedKey]:
        return [*self.observed, self.tensor_keys.action]

    @property
    def out_keys(self) -> list[NestedKey]:
        return [self.out_name]

    def forward(self, tensordict: TensorDictBase, generator: torch.Generator | None = None) -> TensorDictBase:  # noqa: ARG002
        """Compare; the generator is not used, nothing is drawn: the three stages' losses are called alike.

        Raises:
            ValueError: output and target differ in shape, which broadcasting would hide.
        """
        return TensorDict({self.out_name: self._error(tensordict, self.observed)}, [])

    def _error(self, tensordict: TensorDictBase, observed: Sequence[NestedKey]) -> Tensor:
        predicted: Tensor = self.network(*(tensordict.get(key) for key in observed))
        target = tensordict.get(self.tensor_keys.action)
        if predicted.shape != target.shape:
            got, expected = tuple(target.shape), tuple(predicted.shape)
            raise ValueError(f"{self.tensor_keys.action}: got shape {got}, expected {expected} (the network's output)")
        mask: Tensor | None = tensordict.get(self.tensor_keys.mask, None)
        if mask is None:
            return self._distance(predicted - target).mean()
        mask = mask.reshape(target.shape[:-1])
        # The target is replaced, not the error multiplied: it may be NaN, and 0 * NaN is NaN in the gradient.
        error = self._distance(predicted - torch.where(mask[..., None], target, predicted.detach())).mean(-1)
        return error.sum() / averaged(mask.sum().float()).clamp(min=1)

    def _distance(self, difference: Tensor) -> Tensor:
        whitening = getattr(self.network, "whitening", None)
        if whitening is not None and self.tensor_keys.action == keys.LATENT_ACTION:
            difference = whitening.turn(difference)
        return difference.abs() if self.loss_function == "l1" else difference.square()


class BehaviourLoss(_CloningLoss):
    """Behaviour cloning of latent actions; of real ones for the slot oracle.

    Reads SLOTS (..., N, D) and LATENT_ACTION (..., Z), targets inferred by InvDyn from unlabelled videos; SLOTS may be
    parsed or predicted ones. Writes `loss_policy`. For the oracle, `set_keys(action=keys.ACTION)`.

    Note: equal to TorchRL's `BCLoss` with the same `loss_function` (a test holds it to that), not used because
    its functional conversion hides the network from `.train()`, `.eval()` and the checkpoints.

    Examples:
        >>> from playslot_rl.testing import tiny_agent
        >>> loss = BehaviourLoss(tiny_agent().policy)
        >>> demos = TensorDict({"slots": torch.randn(2, 5, 4, 32), "latent_action": torch.randn(2, 5, 8)}, [2, 5])
        >>> loss(demos)["loss_policy"].backward()
    """

    out_name = "loss_policy"


class ActionDecoderLoss(_CloningLoss):
    """Regression of real actions on latent ones, on the labelled demonstrations.

    Reads LATENT_ACTION (..., Z), SLOTS (..., N, D) where the decoder does, and ACTION (..., A) in [-1, 1]; writes
    `loss_action`.

    Examples:
        >>> from playslot_rl.testing import tiny_agent
        >>> loss = ActionDecoderLoss(tiny_agent().action_decoder)
        >>> labelled = TensorDict({"latent_action": torch.randn(6, 8), "action": torch.rand(6, 4)}, [6])
        >>> loss(labelled)["loss_action"].backward()
    """

    @dataclass
    class _AcceptedKeys(_CloningLoss._AcceptedKeys):
        """Keys that `set_keys` can rename: the latent action is observed, the real one is the target."""

        observation: NestedKey = keys.LATENT_ACTION
        action: NestedKey = keys.ACTION

    default_keys = _AcceptedKeys
    out_name = "loss_action"

    @property
    def observed(self) -> list[NestedKey]:
        """The latent action, and the slots where the decoder reads them."""
        reads_slots = getattr(self.network, "reads_slots", False)
        return [self.tensor_keys.observation, *([self.tensor_keys.state] if reads_slots else [])]

    def _error(self, tensordict: TensorDictBase, observed: Sequence[NestedKey]) -> Tensor:
        """Of a decoder that reads slots, both ways: with them and from the latent action alone."""
        error = super()._error(tensordict, observed)
        return error if len(observed) == 1 else error + super()._error(tensordict, observed[:1])
