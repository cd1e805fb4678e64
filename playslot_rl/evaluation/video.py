"""PSNR, SSIM and LPIPS of predicted frames (paper, Table 1).

Shapes: B batch, T frames, H W image height and width.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from playslot_rl.frames import psnr

BORDER: Final = 5
"""Pixels a side whose SSIM window, 11 wide, leaves the frame: not counted, as the authors' `piqa` does not."""


class FrameScores(NamedTuple):
    """Scores of single frames, each (B, T): PSNR in dB, 80 for equal frames; SSIM up to 1; LPIPS from 0 on, lower is
    better, None without a network.
    """

    psnr: Tensor
    ssim: Tensor
    lpips: Tensor | None


class VideoMetrics(NamedTuple):
    """Means over all frames, and over those of each predicted step (T)."""

    psnr: float
    ssim: float
    psnr_steps: list[float]
    ssim_steps: list[float]


@torch.no_grad()
def frame_scores(predicted: Tensor, target: Tensor, lpips: nn.Module | None = None) -> FrameScores:
    """Compare predicted with real frames, frame by frame.

    Args:
        predicted: (B, T, 3, H, W) float; values outside [0, 1] are clamped.
        target: (B, T, 3, H, W) float in [0, 1].
        lpips: the network of `playslot_rl.evaluation.lpips`.

    Raises:
        ValueError: the shapes differ, are not those of clips, or frames are too small for SSIM's window.

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
    return VideoMetrics(float(decibels.mean()), float(ssim.mean()), decibels.mean(0).tolist(), ssim.mean(0).tolist())
