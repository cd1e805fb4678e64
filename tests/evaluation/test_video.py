"""Video metrics."""

from __future__ import annotations

import pytest
import torch

from playslot_rl.evaluation.video import video_metrics


def test_psnr_of_a_known_error() -> None:
    target = torch.full((2, 3, 3, 16, 16), 0.5)
    metrics = video_metrics(target + 0.1, target)
    assert metrics.psnr == pytest.approx(20.0, abs=1e-3)
    assert metrics.psnr_steps == pytest.approx([20.0] * 3, abs=1e-3)


def test_equal_frames_have_the_highest_scores() -> None:
    frames = torch.rand(1, 2, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    metrics = video_metrics(frames, frames)
    assert metrics.psnr == pytest.approx(100.0)
    assert metrics.ssim == pytest.approx(1.0)


def test_psnr_is_averaged_over_frames_not_over_errors() -> None:
    target = torch.zeros(1, 2, 3, 16, 16)
    predicted = target.clone()
    predicted[:, 0] += 0.1
    predicted[:, 1] += 0.01
    assert video_metrics(predicted, target).psnr == pytest.approx(30.0, abs=1e-3)


def test_steps_are_kept_apart() -> None:
    target = torch.rand(2, 2, 3, 16, 16, generator=torch.Generator().manual_seed(1))
    predicted = target.clone()
    predicted[:, 1] = 1 - predicted[:, 1]
    first, second = video_metrics(predicted, target).ssim_steps
    assert first == pytest.approx(1.0)
    assert second < 0.5


def test_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="video_metrics: got"):
        video_metrics(torch.zeros(1, 3, 16, 16), torch.zeros(1, 3, 16, 16))
