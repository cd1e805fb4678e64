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
from torch.nn import functional as F

from playslot_rl.acting.actor import Actor, latent_actor
from playslot_rl.frames import normalise
from playslot_rl.methods.clam.method import MODEL, NAME, CLAMConfig
from playslot_rl.methods.decoded_policy import DecodedPolicy
from playslot_rl.methods.lapo.model import ConvEncoder, EncoderMLP, LAPOPolicy, ResidualBlock
from playslot_rl.runs import Run


class Inverse(nn.Module):
    """Three frames (B, 3, 3, H, W), uint8 or float [0, 1], to latent actions (B, Z)."""

    def __init__(self, config: CLAMConfig, image_size: int) -> None:
        super().__init__()
        self.network = EncoderMLP(9, config.channels, image_size, config.hidden, config.latent_dim)

    def forward(self, frames: Tensor) -> Tensor:
        z: Tensor = self.network(normalise(frames).flatten(1, 2))
        return z.float()


class Forward(nn.Module):
    """Two frames (B, 2, 3, H, W), float [0, 1], and latents (B, Z) to the next one, by a U-Net; the latent enters
    beside the frames and at the lowest resolution.
    """

    def __init__(self, config: CLAMConfig) -> None:
        super().__init__()
        channels = config.channels
        self.encoder = ConvEncoder(6 + config.latent_dim, channels)
        self.to_map = nn.Linear(config.latent_dim, channels[-1])
        self.bottom = ResidualBlock(channels[-1])
        outs, ins = (*channels[-2::-1], 3), (channels[-1], *(2 * c for c in channels[-2::-1]))
        self.ups = nn.ModuleList(nn.Conv2d(a, 4 * b, 3, padding=1) for a, b in zip(ins, outs, strict=True))
        for parameter in self.ups[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(self, frames: Tensor, z: Tensor) -> Tensor:
        everywhere = z[:, :, None, None].expand(-1, -1, *frames.shape[-2:])
        *skips, x = self.encoder(torch.cat((frames.flatten(1, 2), everywhere), dim=1))
        x = self.bottom(x + self.to_map(z)[:, :, None, None])
        for i, up in enumerate(self.ups):
            x = F.pixel_shuffle(up(F.relu(x)), 2)
            if i < len(skips):
                x = torch.cat((x, skips[-1 - i]), dim=1)
        predicted: Tensor = frames[:, 1] + x
        return predicted


class CLAMPolicy(LAPOPolicy):
    """CLAM's latent policy, of LAPO's form."""

    def __init__(self, config: CLAMConfig, image_size: int) -> None:
        nn.Module.__init__(self)
        self.network = EncoderMLP(3, config.channels, image_size, config.hidden, config.latent_dim)


def load_actor(run: Run, device: torch.device | str = "cpu") -> Actor:
    """The actor of a finished run; a CheckpointError where it is missing, damaged, or of another model."""
    done = run.stage(NAME, MODEL.name)
    own, size = done.group(CLAMConfig, NAME), done.sizes[1].image_size
    parts = DecodedPolicy.load(done, lambda: CLAMPolicy(own, size), own.latent_dim, own.hidden, device)
    return latent_actor(parts.policy, parts.action_decoder)
