"""The convolutional encoder that LAPO's three networks share in form (not in weights).

Shapes: B batch, C input channels, H W image height and width.
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional as F


class ResidualBlock(nn.Module):
    """x + conv(relu(conv(relu(x)))), 3x3, same channels.

    Args:
        channels: of input and output.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same shape."""
        out: Tensor = x + self.second(F.relu(self.first(F.relu(x))))
        return out


class ConvEncoder(nn.Module):
    """Levels of halved resolution, each a strided 3x3 conv and a residual block (after IMPALA, Espeholt et al., 2018).

    Args:
        in_channels: C.
        channels: of each level.
    """

    def __init__(self, in_channels: int, channels: tuple[int, ...]) -> None:
        super().__init__()
        ins = (in_channels, *channels[:-1])
        self.levels = nn.ModuleList(
            nn.Sequential(nn.Conv2d(a, b, 3, stride=2, padding=1), ResidualBlock(b))
            for a, b in zip(ins, channels, strict=True)
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        """(B, C, H, W) to the outputs of all levels, (B, channels[i], H / 2^(i+1), W / 2^(i+1)), after a ReLU."""
        outputs = []
        for level in self.levels:
            x = F.relu(level(x))
            outputs.append(x)
        return outputs


class EncoderMLP(nn.Module):
    """A ConvEncoder's last level, flattened, through one hidden layer to a vector.

    Args:
        in_channels: C.
        channels: of the encoder's levels.
        image_size: H = W.
        hidden: width of the hidden layer.
        out_dim: width of the output.
    """

    def __init__(self, in_channels: int, channels: tuple[int, ...], image_size: int, hidden: int, out_dim: int) -> None:
        super().__init__()
        self.encoder = ConvEncoder(in_channels, channels)
        side = image_size // 2 ** len(channels)
        self.mlp = nn.Sequential(nn.Linear(channels[-1] * side * side, hidden), nn.ReLU(), nn.Linear(hidden, out_dim))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, out_dim)."""
        out: Tensor = self.mlp(self.encoder(x)[-1].flatten(1))
        return out
