"""PSNR, SSIM and LPIPS of predicted frames (paper, Table 1).

    d(x, y) = sum_l mean_hw w_l (f_l(x) - f_l(y))^2,   f_l unit-normalised features of layer l

is LPIPS (Zhang et al., 2018) on AlexNet, version 0.1. torchmetrics ships the linear heads w_l only. The features are
those of torchvision's AlexNet on ImageNet, which no package holds: a file is given, or torch's cache has it, or there
is no LPIPS. A substitute under its name there is not.

Shapes: B batch, T frames, H W image height and width.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from playslot_rl.frames import psnr
from playslot_rl.storage.tensors import cached, load_published

BORDER: Final = 5
"""Pixels a side whose SSIM window, 11 wide, leaves the frame: not counted, as the authors' `piqa` does not."""


class FrameScores(NamedTuple):
    """Scores of frames, each (B, T): PSNR in dB, 80 for equal ones; SSIM up to 1; LPIPS, lower is better, or None."""

    psnr: Tensor
    ssim: Tensor
    lpips: Tensor | None


class VideoMetrics(NamedTuple):
    """Means over all frames, and PSNR over those of each predicted step (T)."""

    psnr: float
    ssim: float
    psnr_steps: list[float]


@torch.no_grad()
def frame_scores(predicted: Tensor, target: Tensor, lpips: nn.Module | None = None) -> FrameScores:
    """Compare predicted with real frames (B, T, 3, H, W), frame by frame: the predicted are clamped to [0, 1], in which
    the real ones are. A ValueError where the shapes differ, are not those of clips, or frames are too small for SSIM's
    window.

    Note:
        The PSNR of each frame is taken before the mean, as in the paper; that of the mean error would be lower. SSIM
        leaves the borders out, which torchmetrics' own mean does not.
    """
    if predicted.shape != target.shape or predicted.ndim != 5:
        raise ValueError(
            f"video_metrics: got {tuple(predicted.shape)} and {tuple(target.shape)}, expected two equal (B, T, 3, H, W)"
        )
    if min(predicted.shape[-2:]) <= 2 * BORDER:
        raise ValueError(f"video_metrics: got frames of {tuple(predicted.shape[-2:])}, expected more than {2 * BORDER}")
    from torchmetrics.functional.image import structural_similarity_index_measure

    shape = predicted.shape[:2]
    a, r = predicted.clamp(0, 1).flatten(0, 1).float(), target.clamp(0, 1).flatten(0, 1).float()
    decibels = psnr((a - r).square().mean(dim=(1, 2, 3)))
    _, full = structural_similarity_index_measure(a, r, data_range=1.0, reduction="none", return_full_image=True)
    inner = slice(BORDER, -BORDER)
    ssim = full[..., inner, inner].mean(dim=(1, 2, 3))
    distance = None if lpips is None else lpips(a, r, normalize=True).flatten().reshape(shape)
    return FrameScores(decibels.reshape(shape), ssim.reshape(shape), distance)


def video_metrics(predicted: Tensor, target: Tensor) -> VideoMetrics:
    """Means of `frame_scores`, which says what they take and refuse."""
    decibels, ssim, _ = frame_scores(predicted, target)
    return VideoMetrics(float(decibels.mean()), float(ssim.mean()), decibels.mean(0).tolist())


KEY: Final = "metrics.lpips_weights"


class Perceptual(NamedTuple):
    """LPIPS, or the reason why there is none. It takes two batches (B, 3, H, W), with `normalize=True` of frames in [0,
    1], and gives (B, 1, 1, 1).
    """

    network: nn.Module | None
    reason: str


def open_lpips(weights: str = "") -> Perceptual:
    """LPIPS with the backbone of a file (torchvision's AlexNet, `.pth` as published, or `.safetensors` with the same
    names), or of torch's cache. A CheckpointError where the file is missing, damaged, or not AlexNet's.
    """
    from torchvision.models import AlexNet_Weights

    path = Path(weights) if weights else cached(AlexNet_Weights.IMAGENET1K_V1.url)
    if not weights and not path.is_file():
        return Perceptual(
            None, f"AlexNet's weights are not at hand: metrics.lpips_weights=PATH, or {path.name} in cache"
        )
    from torchmetrics.functional.image.lpips import _LPIPS

    network = _LPIPS(pretrained=True, net="alex", pnet_rand=True)
    # `slice2.3.weight` here is `features.3.weight` there.
    names = {name: "features." + name.split(".", 1)[1] for name in network.net.state_dict()}
    load_published(network.net, path, KEY, "AlexNet", ("give another file", "leave it out"), names)
    return Perceptual(network.eval().requires_grad_(False), "")
