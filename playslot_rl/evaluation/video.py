"""PSNR and SSIM of predicted frames (paper, Table 1).

Shapes: B batch, T frames, H W image height and width.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class VideoMetrics(NamedTuple):
    """Means over the batch.

    Attributes:
        psnr: dB, mean over all frames.
        ssim: 0 to 1, mean over all frames.
        psnr_steps: dB for each predicted step, length T.
        ssim_steps: SSIM for each predicted step, length T.
    """

    psnr: float
    ssim: float
    psnr_steps: list[float]
    ssim_steps: list[float]


@torch.no_grad()
def video_metrics(predicted: Tensor, target: Tensor) -> VideoMetrics:
    """Compare predicted with real frames, frame by frame.

    Args:
        predicted: (B, T, 3, H, W) float; values outside [0, 1] are clamped.
        target: (B, T, 3, H, W) float in [0, 1].

    Raises:
        ValueError: the shapes differ or are not those of clips.

    Note:
        The PSNR of each frame is taken before the mean, as in the paper; that of the mean error would be lower.
        Equal frames are counted as 100 dB instead of infinity.
    """
    if predicted.shape != target.shape or predicted.ndim != 5:
        raise ValueError(
            f"video_metrics: got {tuple(predicted.shape)} and {tuple(target.shape)}, expected two equal (B, T, 3, H, W)"
        )
    from torchmetrics.functional.image import structural_similarity_index_measure

    b, t = predicted.shape[:2]
    a, r = predicted.clamp(0, 1).flatten(0, 1).float(), target.clamp(0, 1).flatten(0, 1).float()
    error = (a - r).square().mean(dim=(1, 2, 3)).clamp(min=1e-10)
    psnr = (-10 * error.log10()).reshape(b, t)
    per_frame = structural_similarity_index_measure(a, r, data_range=1.0, reduction="none")
    assert isinstance(per_frame, Tensor)
    ssim = per_frame.reshape(b, t)
    return VideoMetrics(float(psnr.mean()), float(ssim.mean()), psnr.mean(0).tolist(), ssim.mean(0).tolist())
