"""SAVi's slot decoders (paper, appendix A.1; Watters et al., 2019): slot -> RGB and mask logit.

Shapes: slots (M, D) -> (M, 4, H, W): three channels of RGB without activation, one mask logit.

Broadcast (paper): each slot is broadcast to H x W, a position map P is added, then four 5x5 convs and one 3x3 conv.
The first conv is linear, so conv(broadcast(s) + P) = conv0(broadcast(s)) + conv(P), and conv0 of a constant map takes
only 5 x 5 values a channel (two border rows, the inside, two border rows, and so for columns): the kernel summed over
its part inside the image, applied to the slot. That is exact and removes most of the first layer's arithmetic.

Pixel shuffle (compact): broadcast to 8x8, then a 3x3 conv and pixel shuffle for each doubling; or to 16x16, and the
first conv goes without.
"""

from __future__ import annotations

import itertools
import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from playslot_rl.modules.savi.encoder import SoftPositionEmbedding

BASE = 8
"""Side of the smallest map that the pixel-shuffle decoder starts from."""


class BroadcastDecoder(nn.Module):
    """Full-resolution spatial broadcast decoder.

    Args:
        image_size: side of the frames.
        slot_dim: D.
        channels: channels of the 5x5 convs.
        collapse: compute the first layer in its collapsed form.

    Attributes:
        channels_last: memory format of the maps (results do not change); False is what PyTorch does by itself.
    """

    inside: Tensor
    channels_last = True

    def __init__(self, image_size: int, slot_dim: int, channels: tuple[int, ...], collapse: bool = True) -> None:
        super().__init__()
        self.image_size, self.collapse = image_size, collapse
        self.position = SoftPositionEmbedding(image_size, slot_dim)
        widths = (slot_dim, *channels)
        self.convs = nn.ModuleList(nn.Conv2d(a, b, 5, padding=2) for a, b in itertools.pairwise(widths))
        self.head = nn.Conv2d(widths[-1], 4, 3, padding=1)
        # Row r: which of the 5 kernel rows lie inside the image for output rows 0, 1, inside, H-2, H-1.
        cases = torch.tensor([[0, 0, 1, 1, 1], [0, 1, 1, 1, 1], [1, 1, 1, 1, 1], [1, 1, 1, 1, 0], [1, 1, 1, 0, 0]])
        self.register_buffer("inside", cases.float(), persistent=False)

    def first_layer(self, slots: Tensor) -> Tensor:
        """First conv of the broadcast slots (M, D) plus position map: (M, C, H, W)."""
        conv = self.convs[0]
        if not self.collapse:
            maps = slots[:, :, None, None] + self.position()
            return conv(self._formatted(maps))  # type: ignore[no-any-return]
        weight = torch.einsum("oikl,rk,cl->rcoi", conv.weight, self.inside, self.inside)
        small = torch.einsum("mi,rcoi->morc", slots, weight.to(slots.dtype))
        middle = self.image_size - 4
        # cat and expand, not an index gather: the gather's backward is slow.
        rows = torch.cat((small[:, :, :2], small[:, :, 2:3].expand(-1, -1, middle, -1), small[:, :, 3:]), dim=2)
        maps = torch.cat((rows[..., :2], rows[..., 2:3].expand(-1, -1, -1, middle), rows[..., 3:]), dim=3)
        return self._formatted(maps) + self._formatted(conv(self.position()))

    def _formatted(self, maps: Tensor) -> Tensor:
        return maps.contiguous(memory_format=torch.channels_last if self.channels_last else torch.contiguous_format)

    def forward(self, slots: Tensor) -> Tensor:
        """Slots (M, D) to RGB and mask logit (M, 4, H, W)."""
        x = F.relu(self.first_layer(slots))
        for conv in self.convs[1:]:
            x = F.relu(conv(x))
        out: Tensor = self.head(x)
        return out


class PixelShuffleDecoder(nn.Module):
    """Decoder from a broadcast to a small map, by 3x3 convs and pixel shuffles.

    Args:
        image_size: side of the frames, 8 times a power of two.
        slot_dim: D.
        channels: channels at 8x8, 16x16, ... : one for each doubling.
        learned_position: add a free map to the linear position embedding; it starts at zero.
        start: side of the map, 8 times a power of two; the doublings up to it are left out, their convs are not.
    """

    def __init__(
        self,
        image_size: int,
        slot_dim: int,
        channels: tuple[int, ...],
        learned_position: bool = False,
        start: int = BASE,
    ) -> None:
        super().__init__()
        doublings = int(math.log2(image_size // BASE))
        if len(channels) != doublings:
            raise ValueError(
                f"model.savi.decoder_channels: got {len(channels)} widths, expected {doublings} for {image_size}x"
                f"{image_size} frames; give one for each doubling from {BASE}x{BASE}"
            )
        self.project = nn.Linear(slot_dim, channels[0])
        self.plain = int(math.log2(start // BASE))
        self.position = SoftPositionEmbedding(start, channels[0])
        self.position_map = nn.Parameter(torch.zeros(1, channels[0], start, start)) if learned_position else None
        widths = zip(channels, (*channels[1:], 4), strict=True)
        self.convs = nn.ModuleList(
            nn.Conv2d(a, b if i < self.plain else 4 * b, 3, padding=1) for i, (a, b) in enumerate(widths)
        )

    def forward(self, slots: Tensor) -> Tensor:
        """Slots (M, D) to RGB and mask logit (M, 4, H, W)."""
        position = self.position() if self.position_map is None else self.position() + self.position_map
        x = F.relu(self.project(slots)[:, :, None, None] + position)
        x = x.contiguous(memory_format=torch.channels_last)
        for i, conv in enumerate(self.convs):
            x = F.relu(conv(x)) if i < self.plain else _doubled(conv, x, activate=i < len(self.convs) - 1)
        return x


def _doubled(conv: nn.Module, x: Tensor, activate: bool) -> Tensor:
    """`pixel_shuffle(conv(x), 2)`, with a ReLU or not: (M, C_in, H, W) to (M, C, 2 H, 2 W), both channels_last.

    A shuffle takes channel 4 c + 2 i + j to pixel (2 h + i, 2 w + j). With the convolution's channels in the order
    (i, j, c) instead, the same numbers are moved in runs of 2 C, not one by one: twice as fast, backward too.
    """
    assert isinstance(conv, nn.Conv2d)
    assert conv.bias is not None
    weight = conv.weight.unflatten(0, (-1, 4)).transpose(0, 1).flatten(0, 1)
    bias = torch.cat(conv.bias.unflatten(0, (-1, 4)).unbind(1))  # torch.compile takes no view as a bias on a CPU
    y = F.conv2d(x, weight, bias, padding=conv.padding)
    y = F.relu(y) if activate else y
    m, c, h, w = y.shape
    y = y.permute(0, 2, 3, 1).reshape(m, h, w, 2, c // 2).transpose(2, 3).reshape(m, 2 * h, 2 * w, c // 4)
    return y.permute(0, 3, 1, 2)
