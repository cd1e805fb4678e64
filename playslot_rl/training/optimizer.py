"""Adam as every stage uses it: its parameters, its learning rate, and the clipping before it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from playslot_rl.config import OptimConfig


def learning_rate(config: OptimConfig, step: int, steps: int) -> float:
    """Learning rate of step `step` (from 0) of `steps`: linear warm-up, then constant or cosine to zero.

    Example:
        >>> [learning_rate(OptimConfig(lr=1.0, warmup_steps=2), s, 4) for s in range(4)]
        [0.5, 1.0, 1.0, 0.5]
    """
    if step < config.warmup_steps:
        return config.lr * (step + 1) / config.warmup_steps
    if config.schedule == "constant":
        return config.lr
    done = (step - config.warmup_steps) / max(1, steps - config.warmup_steps)
    return config.lr * 0.5 * (1.0 + math.cos(math.pi * min(1.0, done)))


def trainable_parameters(modules: Mapping[str, nn.Module]) -> dict[str, nn.Parameter]:
    """Parameters with gradients by their full name, in a fixed order."""
    return {
        f"{name}.{key}": parameter
        for name, module in modules.items()
        for key, parameter in module.named_parameters()
        if parameter.requires_grad
    }


def build_adam(parameters: Mapping[str, nn.Parameter], config: OptimConfig, **settings: Any) -> torch.optim.Adam:
    """Adam over `parameters`, with further settings of torch, fused: one kernel for all tensors, on CPU and GPU alike.
    On a GPU its learning rate is a tensor there, so that a captured step can be given another one.
    """
    if not parameters:
        raise ValueError("got no trainable parameters, expected at least one: a stage's modules must not be frozen")
    device = next(iter(parameters.values())).device
    on_gpu = device.type == "cuda"
    lr = torch.tensor(config.lr, dtype=torch.float32, device=device) if on_gpu else config.lr
    return torch.optim.Adam(list(parameters.values()), lr=lr, fused=True, capturable=on_gpu, **settings)


def clip_gradients(parameters: Mapping[str, nn.Parameter], maximum: float, *, separate: bool = False) -> Tensor:
    """Clip the gradient norm in place (0: leave it) and return the norm before clipping, a scalar tensor.

    Args:
        separate: each module, by the first word of the names, is clipped by its own norm; that of all is returned.
    """
    together: dict[str, list[nn.Parameter]] = {}
    for name, parameter in parameters.items():
        together.setdefault(name.partition(".")[0] if separate else "", []).append(parameter)
    limit = maximum if maximum > 0 else math.inf
    norms = [nn.utils.clip_grad_norm_(group, limit) for group in together.values()]
    return norms[0] if len(norms) == 1 else torch.linalg.vector_norm(torch.stack(norms))
