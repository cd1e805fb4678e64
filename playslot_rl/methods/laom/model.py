"""LAOM's latent-action model (Nikulin et al., 2025, "Latent Action Learning Requires Supervision in the Presence of
Distractors", sections 4 to 6): no codes, no pixels, several steps ahead, and a few real actions.

    h_t = f(o_t),   z_t = IDM(h_t, h_{t+k}),   k ~ U{1, ..., K}
    e_{t+1} - e_t ~ FDM(sg[h_t], z_t),   e_t = f'(o_t),   f' <- f' + tau (f - f')
    a_t ~ W z_t + b                       on the labelled transitions

The target encoder f' gets no gradient; the encoder f gets one through z alone. Actions are read off z by a linear map,
so that they lie where a policy that clones z finds them.

Note: the forward model predicts the change of the target's features, not the features: where most of a scene stands
still, a small network learns nothing but to copy. Encoders see one frame, not three, as the policies of all rows do.

Shapes: B batch, C input channels, H W image height and width, E features, Z latent-action width, A action width.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from playslot_rl.acting.actor import Actor
from playslot_rl.frames import normalise
from playslot_rl.methods.laom.method import MODEL, NAME, LAOMConfig
from playslot_rl.methods.lapo.model import ConvEncoder, pixel_actor
from playslot_rl.runs import Run

LAYERS = 3


class Head(nn.Module):
    """Layers that read a condition anew, each a linear map and a residual MLP: x (B, E_x) and c (B, E_c) to (B, out).

    x <- LN(y + MLP(y)),   y = W [x, c]
    """

    def __init__(self, width: int, condition: int, hidden: int, out: int) -> None:
        super().__init__()
        widths = (width, *[hidden] * (LAYERS - 1))
        self.reads = nn.ModuleList(nn.Linear(w + condition, hidden) for w in widths)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.Linear(hidden, 4 * hidden), nn.ReLU(), nn.Linear(4 * hidden, hidden)) for _ in widths
        )
        self.norms = nn.ModuleList(nn.LayerNorm(hidden) for _ in widths)
        self.out = nn.Linear(hidden, out)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        for read, block, norm in zip(self.reads, self.blocks, self.norms, strict=True):
            x = read(torch.cat((x, condition), dim=-1))
            x = norm(x + block(x))
        out: Tensor = self.out(x)
        return out


class Features(nn.Module):
    """f: frames (B, 3, H, W), float [0, 1], to features (B, E)."""

    def __init__(self, channels: tuple[int, ...], image_size: int) -> None:
        super().__init__()
        self.encoder = ConvEncoder(3, channels)
        self.width = channels[-1] * (image_size // 2 ** len(channels)) ** 2

    def forward(self, frames: Tensor) -> Tensor:
        out: Tensor = self.encoder(frames)[-1].flatten(1)
        return out


class LatentActions(nn.Module):
    """Encoder, inverse and forward model, and the linear map to real actions."""

    def __init__(self, config: LAOMConfig, image_size: int, action_dim: int) -> None:
        super().__init__()
        self.features = Features(config.channels, image_size)
        width = self.features.width
        self.inverse = Head(0, 2 * width, config.hidden, config.latent_dim)
        self.forward_model = Head(width, config.latent_dim, config.hidden, width)
        self.action = nn.Linear(config.latent_dim, action_dim)
        self.apply(_orthogonal)
        nn.init.zeros_(self.forward_model.out.weight)

    def infer(self, h: Tensor, later: Tensor) -> Tensor:
        """Features (B, E) now and k steps later to latent actions (B, Z)."""
        z: Tensor = self.inverse(h[:, :0], torch.cat((h, later), dim=-1))
        return z

    def change(self, h: Tensor, z: Tensor) -> Tensor:
        """The change (B, E) of the target's features in one step; no gradient reaches h (B, E)."""
        out: Tensor = self.forward_model(h.detach(), z)
        return out

    def forward(self, pairs: Tensor) -> Tensor:
        """Frames (B, 2, 3, H, W), uint8 or float [0, 1], to the latent actions (B, Z) between them."""
        h = self.features(torch.cat(normalise(pairs).unbind(1)))
        return self.infer(*h.chunk(2)).float()


def _orthogonal(part: nn.Module) -> None:
    if isinstance(part, nn.Conv2d | nn.Linear):
        nn.init.orthogonal_(part.weight)
        assert part.bias is not None
        nn.init.zeros_(part.bias)


class Target(nn.Module):
    """The target encoder f', a slow copy, and the mean squared `change` of its features, slow likewise."""

    change: Tensor

    def __init__(self, features: Features, channels: tuple[int, ...], image_size: int) -> None:
        super().__init__()
        self.features = Features(channels, image_size)
        self.features.load_state_dict(features.state_dict())
        self.requires_grad_(False)
        self.register_buffer("change", torch.ones(()))

    @torch.no_grad()
    def follow(self, features: Features, rate: float) -> None:
        """f' <- f' + rate (f - f')."""
        torch._foreach_lerp_(list(self.features.parameters()), list(features.parameters()), rate)

    @torch.no_grad()
    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """e_{t+1} - e_t (B, E) of frames (B, 3, H, W), float [0, 1]."""
        now, after = self.features(torch.cat((first, second))).float().chunk(2)
        change: Tensor = after - now
        return change


def load_actor(run: Run, device: torch.device | str = "cpu") -> Actor:
    """The actor of a finished run; a CheckpointError where it is missing, damaged, or of another model."""
    done = run.stage(NAME, MODEL.name)
    return pixel_actor(done, done.group(LAOMConfig, NAME), device)
