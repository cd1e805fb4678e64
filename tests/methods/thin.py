"""A ResNet-18 that is thin."""

from __future__ import annotations

from typing import Any

from torch import nn
from torchvision.models.resnet import BasicBlock, ResNet

WIDTHS = {64: 16, 128: 16, 256: 16, 512: 512}


class _Thin(ResNet):
    """One convolution a stage; names of the parts, strides, norms and last width are torchvision's."""

    def _make_layer(self, block: Any, planes: int, blocks: int, stride: int = 1, dilate: bool = False) -> nn.Sequential:
        read, self.inplanes = self.inplanes, WIDTHS[planes]
        assert self._norm_layer is not None
        convolution = nn.Conv2d(read, self.inplanes, 3, stride, 1, bias=False)
        return nn.Sequential(convolution, self._norm_layer(self.inplanes), nn.ReLU())


def thin_resnet18(*, weights: None = None, **options: Any) -> ResNet:
    """In place of torchvision's `resnet18`: a twentieth of its weights, from scratch."""
    assert weights is None
    return _Thin(BasicBlock, [2, 2, 2, 2], **options)
