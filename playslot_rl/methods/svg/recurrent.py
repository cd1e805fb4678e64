"""SVG's recurrent parts (Denton and Fergus, 2018, section 3): what comes next, and what is likely to.

    g_t = LSTM_f([h_{t-1}, z_t]),   q_t = N(mu, sigma^2) = LSTM_q(h_t),   p_t = N(mu, sigma^2) = LSTM_p(h_{t-1})

All three run in float32, whatever the convolutions do.

Shapes: B clips, M steps, F width of a frame's code, Z latent.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from playslot_rl.runtime.shares import own_noise

State = tuple[Tensor, Tensor]
"""Hidden and cell state of an LSTM (layers, B, hidden)."""


class Gaussian(NamedTuple):
    """Diagonal Gaussians: mean and log sigma^2, each (..., Z)."""

    mean: Tensor
    log_variance: Tensor

    def sample(self, generator: torch.Generator) -> Tensor:
        """mu + sigma eps (..., Z), differentiable in both; eps is drawn on the generator's device."""
        device, dtype = generator.device, self.mean.dtype
        noise = own_noise(
            self.mean.shape, lambda shape: torch.randn(shape, generator=generator, device=device, dtype=dtype)
        )
        return self.mean + (0.5 * self.log_variance).exp() * noise.to(self.mean.device)


class Recurrent(nn.Module):
    """A linear layer and an LSTM of `layers` cells after it."""

    def __init__(self, in_dim: int, hidden: int, layers: int) -> None:
        super().__init__()
        self.embed = nn.Linear(in_dim, hidden)
        self.lstm = nn.LSTM(hidden, hidden, layers, batch_first=True)

    def forward(self, inputs: Tensor, state: State | None = None) -> tuple[Tensor, State]:
        """Inputs (B, M, in_dim), M at least 1, to outputs (B, M, hidden) and the state after them; None starts at 0."""
        outputs, after = self.lstm(self.embed(inputs), state)
        return outputs, after


class FramePredictor(nn.Module):
    """LSTM_f: the last frame's code and the latent of the change, to the code that is decoded."""

    def __init__(self, features: int, latent_dim: int, hidden: int, layers: int) -> None:
        super().__init__()
        self.recurrent = Recurrent(features + latent_dim, hidden, layers)
        self.to_code = nn.Linear(hidden, features)

    def forward(self, codes: Tensor, latents: Tensor, state: State | None = None) -> tuple[Tensor, State]:
        """h_{t-1} (B, M, F) and z_t (B, M, Z) to g_t (B, M, F) in (-1, 1), and the state after them."""
        with torch.autocast(codes.device.type, enabled=False):
            outputs, after = self.recurrent(torch.cat((codes.float(), latents.float()), dim=-1), state)
            return torch.tanh(self.to_code(outputs)), after


class GaussianLSTM(nn.Module):
    """LSTM_q or LSTM_p: frames' codes to a Gaussian over z after each."""

    def __init__(self, features: int, latent_dim: int, hidden: int) -> None:
        super().__init__()
        self.recurrent = Recurrent(features, hidden, 1)
        self.to_mean = nn.Linear(hidden, latent_dim)
        self.to_log_variance = nn.Linear(hidden, latent_dim)

    def forward(self, codes: Tensor, state: State | None = None) -> tuple[Gaussian, State]:
        """Codes (B, M, F) to Gaussians (B, M, Z), and the state after them."""
        with torch.autocast(codes.device.type, enabled=False):
            outputs, after = self.recurrent(codes.float(), state)
            return Gaussian(self.to_mean(outputs), self.to_log_variance(outputs)), after
