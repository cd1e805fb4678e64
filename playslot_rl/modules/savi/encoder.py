"""SAVi's encoder: frame -> feature tokens (paper, appendix A.1).

    h_t = MLP(LN(Conv(o_t) + PositionEmbedding))      frame (B, 3, H, W) -> tokens (B, L, token_dim)

Full (paper): four 5x5 stride-1 convs, L = H * W. Strided (compact): the same with strides, L = H * W / prod(strides)^2.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor, nn


class SoftPositionEmbedding(nn.Module):
    """A linear map of the four-channel coordinate grid (x, 1 - x, y, 1 - y in [0, 1]).

    Args:
        size: side of the square map.
        channels: width of the embedding.
    """

    grid: Tensor

    def __init__(self, size: int, channels: int) -> None:
        super().__init__()
        ramp = torch.linspace(0.0, 1.0, size)
        y, x = torch.meshgrid(ramp, ramp, indexing="ij")
        self.register_buffer("grid", torch.stack((x, 1 - x, y, 1 - y), dim=-1), persistent=False)
        self.project = nn.Linear(4, channels)

    def forward(self) -> Tensor:
        """The embedding (1, channels, size, size)."""
        embedding: Tensor = self.project(self.grid).permute(2, 0, 1).unsqueeze(0)
        return embedding


class SAViEncoder(nn.Module):
    """Convolutional encoder.

    Args:
        image_size: side of the frames.
        channels: output channels of each 5x5 conv.
        strides: stride of each conv.
        token_dim: width of the tokens.

    Attributes:
        channels_last: memory format of the maps (results do not change); False is what PyTorch does by itself.
    """

    channels_last = True

    def __init__(self, image_size: int, channels: tuple[int, ...], strides: tuple[int, ...], token_dim: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width, size = 3, image_size
        for i, (out, stride) in enumerate(zip(channels, strides, strict=True)):
            layers.append(nn.Conv2d(width, out, 5, stride=stride, padding=2))
            if i < len(channels) - 1:
                layers.append(nn.ReLU())
            width, size = out, size // stride
        self.convs = nn.Sequential(*layers)
        self.position = SoftPositionEmbedding(size, width)
        self.mlp = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, token_dim), nn.ReLU(), nn.Linear(token_dim, token_dim)
        )

    def forward(self, frames: Tensor, autocast: AbstractContextManager[object] | None = None) -> Tensor:
        """Frames (B, 3, H, W) in [0, 1] to tokens (B, L, token_dim); `autocast` surrounds the convolutions only, what
        follows is float32 then."""
        memory_format = torch.channels_last if self.channels_last else torch.contiguous_format
        with autocast or nullcontext():
            maps = self.convs(frames.contiguous(memory_format=memory_format))
        position = self.position()
        maps = maps + position.to(maps.dtype) if autocast is None else maps.float() + position
        tokens: Tensor = self.mlp(maps.flatten(2).transpose(1, 2))
        return tokens
