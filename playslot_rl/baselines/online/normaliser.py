"""The scale of returns: the exponential moving average of their 5-95 percentile range, which TorchRL ships.

`PercentileValueNorm(rate=0.01, min_scale=1.0)`: `update(returns)` with returns (..., 1), then `scale()` is
max(1, high - low), shape (1,). The averages start at zero, as in DreamerV3. They are buffers: keep the module among a
learner's `modules`.
"""

from torchrl.modules import PercentileValueNorm

__all__ = ["PercentileValueNorm"]
