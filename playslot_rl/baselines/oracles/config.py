"""Config of the ResNet oracle."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ResNetOracleConfig:
    """Sizes and schedule of the ResNet oracle."""
