"""What a key press means as a latent action: a prototype, and so much of a variability.

    z = p_k + s * d_k

p_k is prototype k. d_k is the direction in which the latents that a video has of this prototype differ most from it
(first principal direction of v = z - p_k, paper, section "InvDyn Module"), one standard deviation long: at s = 1 the
motion differs from the prototype as the videos' own motions commonly do. Latent actions are differences of scene
dynamics, so z = 0 is "nothing moves".

Shapes: K prototypes, Z latent-action width, N slots, T frames, H W image height and width.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from playslot_rl.errors import CheckpointError
from playslot_rl.frames import to_float
from playslot_rl.world_model import WorldModel, module_device

if TYPE_CHECKING:
    from playslot_rl.play.session import PlaySession

FEWEST: Final = 8
"""Transitions of a prototype that its own direction needs; with fewer it takes that of all."""
CODEBOOK_SHARE: Final = 0.25
"""Length of the direction, as a share of the prototypes' spread, where there are no videos."""


class Driver(Protocol):
    """Whoever may take over: the latent policy, or a planner; the page shows its title."""

    title: str

    def choose(self, session: PlaySession) -> Tensor:
        """The next latent action ([N,] Z) for where the session stands; the session is left as it is."""


class PolicyDriver:
    """The latent policy: slots (..., N, D) to a latent action (..., Z), in evaluation mode."""

    title = "latent policy"

    def __init__(self, policy: nn.Module) -> None:
        self.policy = policy

    @torch.no_grad()
    def choose(self, session: PlaySession) -> Tensor:
        """The policy's latent action (Z,) at the present slots."""
        chosen: Tensor = self.policy(session.slots[None])[0]
        return chosen


def require_prototypes(model: WorldModel) -> Tensor:
    """The codebook (K, Z).

    Raises:
        CheckpointError: the world model's latent actions have none.
    """
    mode = model.config.inverse_dynamics.mode
    if mode not in ("hybrid", "discrete"):
        raise CheckpointError(
            f"play: got a world model of latent-action mode {mode}, expected hybrid or discrete: it has no prototypes "
            "to steer by; train dynamics with model.inverse_dynamics.mode=hybrid"
        )
    return model.inverse_dynamics.prototypes


@torch.no_grad()
def variability_directions(model: WorldModel, clips: npt.NDArray[np.uint8] | None) -> Tensor:
    """The direction (K, Z) of each prototype's variability, one standard deviation long.

    Args:
        clips: videos uint8 (n, T, H, W, 3) that show what varies; None where there are none: then every prototype has
            the principal direction of the codebook itself, CODEBOOK_SHARE of the prototypes' spread along it.

    Raises:
        CheckpointError: the world model has no prototypes.
    """
    prototypes = require_prototypes(model)
    if clips is None or clips.shape[1] < 2:
        return (CODEBOOK_SHARE * _principal(prototypes)).expand(len(prototypes), -1).clone()
    device = module_device(model)
    slots, _ = model.savi(to_float(clips, device), generator=torch.Generator(device).manual_seed(0))
    latents = model.inverse_dynamics(slots)
    code, z = latents.code.flatten(), latents.z.flatten(0, -2)
    difference = z - prototypes[code]
    overall = _principal(difference)
    return torch.stack(
        [
            _principal(difference[code == k]) if int((code == k).sum()) >= FEWEST else overall
            for k in range(len(prototypes))
        ]
    )


def _principal(rows: Tensor) -> Tensor:
    """First principal direction of rows (M, Z), times their standard deviation along it; its largest number is
    positive."""
    centred = rows - rows.mean(dim=0)
    _, strength, directions = torch.linalg.svd(centred.double(), full_matrices=False)
    first = directions[0] * strength[0] / max(1, len(rows) - 1) ** 0.5
    sign = torch.sign(first[first.abs().argmax()])
    out: Tensor = (first * torch.where(sign == 0, torch.ones_like(sign), sign)).to(rows.dtype)
    return out
