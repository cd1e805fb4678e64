"""A tiny CADDY."""

from __future__ import annotations

import pytest
import torch


@pytest.fixture
def model() -> torch.nn.Module:
    from caddy_parts import tiny

    return tiny().eval()
