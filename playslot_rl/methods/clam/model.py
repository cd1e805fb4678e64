"""CLAM's model (Liang et al., 2025, "CLAM: Continuous Latent Action Models for Robot Learning from Unlabeled
Demonstrations", section 4).

    z_t = IDM(o_{t-1}, o_t, o_{t+1}),   o^_{t+1} = FDM(o_{t-1}, o_t, z_t),   a_t ~ D(z_t)

z has few numbers and no codes; the decoder D learns with it, and stays what it is when a policy clones z.

Note: the forward model predicts the change of the last frame and starts from none, as our LAPO's.

Shapes: B batch, H W image height and width, Z latent-action width, A action width.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from playslot_rl.acting.actor import Actor
from playslot_rl.frames import normalise
from playslot_rl.methods.clam.method import MODEL, NAME, CLAMConfig
from playslot_rl.methods.lapo.model import ChangeUNet, EncoderMLP, pixel_actor
from playslot_rl.runs import Run


class Inverse(nn.Module):
    """Three frames (B, 3, 3, H, W), uint8 or float [0, 1], to latent actions (B, Z)."""

    def __init__(self, config: CLAMConfig, image_size: int) -> None:
        super().__init__()
        self.network = EncoderMLP(config, 3, image_size)

    def forward(self, frames: Tensor) -> Tensor:
        z: Tensor = self.network(normalise(frames).flatten(1, 2))
        return z.float()


class Forward(ChangeUNet):
    """Two frames (B, 2, 3, H, W), float [0, 1], and latents (B, Z) to the next one; the latent enters beside the frames
    and at the lowest resolution.
    """

    def __init__(self, config: CLAMConfig) -> None:
        super().__init__(6 + config.latent_dim, config.channels, config.latent_dim)

    def forward(self, frames: Tensor, z: Tensor) -> Tensor:
        everywhere = z[:, :, None, None].expand(-1, -1, *frames.shape[-2:])
        return frames[:, 1] + self.change(torch.cat((frames.flatten(1, 2), everywhere), dim=1), z)


def load_actor(run: Run, device: torch.device | str = "cpu") -> Actor:
    """The actor of a finished run; a CheckpointError where it is missing, damaged, or of another model."""
    done = run.stage(NAME, MODEL.name)
    return pixel_actor(done, done.group(CLAMConfig, NAME), device)
