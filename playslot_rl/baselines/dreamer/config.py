"""Config of DreamerV3."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DreamerConfig:
    """Sizes and schedule of DreamerV3."""
