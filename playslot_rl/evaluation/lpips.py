"""LPIPS (Zhang et al., 2018) on AlexNet, version 0.1, where its backbone's weights are at hand.

    d(x, y) = sum_l mean_hw w_l (f_l(x) - f_l(y))^2,   f_l unit-normalised features of layer l

torchmetrics ships the linear heads w_l only. The features are those of torchvision's AlexNet on ImageNet, which no
package holds: a file is given, or torch's cache has it, or there is no LPIPS. A substitute under its name there is not.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

import torch
from torch import nn

from playslot_rl.storage.tensors import pick_published, read_published

KEY: Final = "metrics.lpips_weights"


class Perceptual(NamedTuple):
    """LPIPS, or why there is none.

    Attributes:
        network: takes two batches (B, 3, H, W), with `normalize=True` of frames in [0, 1]; gives (B, 1, 1, 1).
        reason: why it is not available; empty where it is.
    """

    network: nn.Module | None
    reason: str


def open_lpips(weights: str = "") -> Perceptual:
    """LPIPS with the backbone of a file, or of torch's cache.

    Args:
        weights: path of torchvision's AlexNet (`.pth` as published, or `.safetensors` with the same names); empty looks
            into torch's cache.

    Raises:
        CheckpointError: the file is missing, damaged, or not AlexNet's.
    """
    path = Path(weights) if weights else cached_alexnet()
    if not weights and not path.is_file():
        return Perceptual(
            None, f"AlexNet's weights are not at hand: metrics.lpips_weights=PATH, or {path.name} in cache"
        )
    from torchmetrics.functional.image.lpips import _LPIPS

    network = _LPIPS(pretrained=True, net="alex", pnet_rand=True)
    # `slice2.3.weight` here is `features.3.weight` there.
    own, cure = network.net.state_dict(), "give another file, or leave it out"
    names = {name: "features." + name.split(".", 1)[1] for name in own}
    stored = read_published(path, KEY, "AlexNet", "leave it out")
    network.net.load_state_dict(pick_published(stored, names, own, f"{KEY}={path}", cure))
    return Perceptual(network.eval().requires_grad_(False), "")


def cached_alexnet() -> Path:
    """Where torchvision keeps AlexNet's ImageNet weights, there or not."""
    from torchvision.models import AlexNet_Weights

    return Path(torch.hub.get_dir()) / "checkpoints" / Path(AlexNet_Weights.IMAGENET1K_V1.url).name
