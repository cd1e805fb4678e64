"""Features of VGG19 for the perceptual loss (Johnson et al., 2016), where its weights are at hand.

    L_perc(x^, x) = sum_l mean |phi_l(x^) - phi_l(x)|,   l over the first ReLU of each of VGG19's five resolutions

No package ships the weights, so without a file there is no such loss; `load_perceptual` then returns None.

Note: which five ReLUs the original takes is not stated; the first of each resolution is the common choice. A frame that
is too small for the last ones has fewer.

Shapes: B batch, H W image height and width.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from playslot_rl.storage.tensors import pick_published, read_published

KEY = "baselines.caddy.perceptual"

# Widths of VGG19's convolutions up to the last ReLU that is read; M halves the resolution.
_LAYERS: tuple[int | str, ...] = (64, 64, "M", 128, 128, "M", *(256,) * 4, "M", *(512,) * 4, "M", 512)

# Places of the ReLUs among the layers.
_READ = (1, 6, 11, 20, 29)

# Statistics of ImageNet, with which torchvision's weights were trained.
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class VGGFeatures(nn.Module):
    """VGG19 up to the last layer that is read, frozen; layers are named as torchvision names them."""

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width = 3
        for entry in _LAYERS:
            if isinstance(entry, str):
                layers.append(nn.MaxPool2d(2))
            else:
                layers += [nn.Conv2d(width, entry, 3, padding=1), nn.ReLU()]
                width = entry
        self.features = nn.Sequential(*layers)
        self.register_buffer("mean", torch.tensor(_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(_STD).view(3, 1, 1), persistent=False)
        self.requires_grad_(False)
        self.eval()

    def forward(self, x: Tensor) -> list[Tensor]:
        """Frames (B, 3, H, W) in [-1, 1] to the outputs of the ReLUs that are read, as many as the size allows."""
        x = ((x + 1) / 2 - self.mean) / self.std
        outputs = []
        for place, layer in enumerate(self.features):
            if isinstance(layer, nn.MaxPool2d) and min(x.shape[-2:]) < 2:
                break
            x = layer(x)
            if place in _READ:
                outputs.append(x)
        return outputs

    def distance(self, predicted: Tensor, target: Tensor) -> Tensor:
        """L_perc (scalar) of frames (B, 3, H, W) in [-1, 1]; no gradient goes to the target."""
        with torch.no_grad():
            wanted = self(target)
        levels = [(a - b).float().abs().mean() for a, b in zip(self(predicted), wanted, strict=True)]
        return torch.stack(levels).sum()


def load_perceptual(weights: str) -> VGGFeatures | None:
    """VGG19's features on the CPU, frozen, for `CADDYConfig.perceptual`; None where it is empty, or `auto` and torch's
    cache does not have the weights; a CheckpointError where the file is missing, damaged or not VGG19's.
    """
    path = cached_weights() if weights == "auto" else Path(weights)
    if not weights or (weights == "auto" and not path.is_file()):
        return None
    with torch.random.fork_rng(devices=[]):
        network = VGGFeatures()
    own, cure = network.state_dict(), "leave it empty"
    state = read_published(path, KEY, "VGG19", cure)
    names = {name: name for name in own}
    where = f"{KEY}={path}"
    network.load_state_dict(pick_published(state, names, own, where, f"give torchvision's VGG19, or {cure}"))
    return network


def cached_weights() -> Path:
    """Where torchvision keeps VGG19's ImageNet weights, there or not."""
    from torchvision.models import VGG19_Weights

    return Path(torch.hub.get_dir()) / "checkpoints" / Path(VGG19_Weights.IMAGENET1K_V1.url).name
