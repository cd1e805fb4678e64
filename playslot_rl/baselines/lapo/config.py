"""Config of LAPO."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LAPOConfig:
    """Sizes and schedule of LAPO."""
