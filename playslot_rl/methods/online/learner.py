"""What a method gives to the loop of acting and learning (`playslot_rl.methods.online.loop`).

Shapes: n episodes in lock-step, B sequences of T frames, A action dim, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from playslot_rl.seeds.draws import StepGenerators


class Learner(Protocol):
    """An agent that learns from replayed episodes while it acts.

    It keeps no state between calls but in `modules` and `optimizers`: both are checkpointed as they stand.

    Attributes:
        stored: keys of what `act` returns that the replay keeps of each frame, such as `(keys.PIXELS,)` or
            `(keys.SLOTS,)`. Fixed shapes; any dtype.
    """

    stored: tuple[str, ...]

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Everything with weights or buffers, by name; target networks and normalisers too."""

    @property
    def optimizers(self) -> Mapping[str, torch.optim.Optimizer]:
        """By name."""

    def initial(self, n: int) -> TensorDict:
        """The memory of n new episodes, batch size [n]; its keys are those that `act` hands on to the next frame.

        It holds `keys.ACTION` (n, A), the last action taken, zero here.
        """

    def act(self, memory: TensorDictBase, generator: torch.Generator, explore: bool) -> TensorDictBase:
        """See a frame and choose an action; called without gradients, modules in eval mode.

        Args:
            memory: the keys of `initial`, and `keys.PIXELS` uint8 (n, 3, H, W), the present frame.
            generator: of whatever is drawn, on the learner's device.
            explore: sample an action (training) instead of taking the best one (evaluation: a function of memory and
                frame alone).

        Returns:
            The memory's keys anew, and those of `stored`. `keys.ACTION` (n, A) is the action chosen: float32, finite;
            the environment clips it to [-1, 1]. The loop may replace it (random start) before it hands the memory on.
        """

    def update(self, batch: TensorDict, generators: StepGenerators) -> Mapping[str, Tensor]:
        """One optimiser step on a batch of sequences, modules in train mode.

        The loop seeds torch's global generators for the call (`playslot_rl.seeds.draws.global_seed`), for what
        takes no generator.

        Args:
            batch: batch size [B, T], on the learner's device. The keys of `stored`, and with each frame: `keys.ACTION`
                (B, T, A), the action that *led to* it; `keys.REWARD` (B, T, 1), received on the way; `keys.IS_FIRST`
                and `keys.IS_LAST` (B, T, 1). On the first frame of an episode action and reward are zero. There is no
                other end of an episode than its time limit, so that returns go on beyond `IS_LAST`.
            generators: of whatever is drawn.

        Returns:
            Scalars to log, detached; one that is not finite stops the training.
        """
