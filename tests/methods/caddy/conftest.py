"""A tiny CADDY, and its helper module made importable."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def model() -> torch.nn.Module:
    from caddy_parts import tiny

    return tiny().eval()
