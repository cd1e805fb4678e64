"""Video metrics."""

from __future__ import annotations

import pytest
import torch

from playslot_rl.evaluation.video import frame_scores, video_metrics


def test_psnr_of_a_known_error() -> None:
    target = torch.full((2, 3, 3, 16, 16), 0.5)
    metrics = video_metrics(target + 0.1, target)
    assert metrics.psnr == pytest.approx(20.0, abs=1e-3)
    assert metrics.psnr_steps == pytest.approx([20.0] * 3, abs=1e-3)


def test_equal_frames_have_the_highest_scores() -> None:
    frames = torch.rand(1, 2, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    metrics = video_metrics(frames, frames)
    assert metrics.psnr == pytest.approx(80.0)
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
    first, second = video_metrics(predicted, target).psnr_steps
    assert first == pytest.approx(80.0)
    assert second < 20


def test_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="video_metrics: got"):
        video_metrics(torch.zeros(1, 3, 16, 16), torch.zeros(1, 3, 16, 16))


def test_ssim_is_that_of_windows_inside_the_frame() -> None:
    """Against skimage-like arithmetic by hand: a Gaussian window of 11 pixels, sigma 1.5, no border."""
    numbers = torch.Generator().manual_seed(2)
    target = torch.rand(1, 1, 3, 20, 24, generator=numbers, dtype=torch.float64)
    predicted = (target + 0.2 * torch.randn(target.shape, generator=numbers, dtype=torch.float64)).clamp(0, 1)
    x = torch.arange(11, dtype=torch.float64) - 5
    line = torch.exp(-x.square() / (2 * 1.5**2))
    window = (line[:, None] * line / (line[:, None] * line).sum())[None, None].expand(3, 1, 11, 11)

    def blurred(image: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(image, window, groups=3)

    a, r = predicted[0], target[0]
    mean_a, mean_r = blurred(a), blurred(r)
    var_a, var_r = blurred(a * a) - mean_a**2, blurred(r * r) - mean_r**2
    cross = blurred(a * r) - mean_a * mean_r
    c1, c2 = 0.01**2, 0.03**2
    map_ = (2 * mean_a * mean_r + c1) * (2 * cross + c2) / ((mean_a**2 + mean_r**2 + c1) * (var_a + var_r + c2))
    assert map_.shape[-2:] == (10, 14)
    got = frame_scores(predicted.float(), target.float()).ssim
    assert float(got) == pytest.approx(float(map_.mean()), abs=1e-4)


def test_psnr_is_that_of_each_frame_with_1e_8_added() -> None:
    target, predicted = torch.zeros(2, 3, 3, 16, 16), torch.zeros(2, 3, 3, 16, 16)
    for b in range(2):
        for t in range(3):
            predicted[b, t] = 0.01 * (1 + b + 2 * t)
    scores = frame_scores(predicted, target)
    for b in range(2):
        for t in range(3):
            expected = -10 * torch.tensor((0.01 * (1 + b + 2 * t)) ** 2 + 1e-8).log10()
            assert float(scores.psnr[b, t]) == pytest.approx(float(expected), abs=1e-3)


def test_frames_too_small_for_the_window_are_refused() -> None:
    with pytest.raises(ValueError, match="expected more than 10"):
        frame_scores(torch.zeros(1, 1, 3, 10, 16), torch.zeros(1, 1, 3, 10, 16))
