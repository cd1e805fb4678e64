"""Config of SOLD."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SOLDConfig:
    """Sizes and schedule of SOLD."""
