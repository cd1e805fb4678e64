"""Collectors: record episodes of a policy as a LeRobot v3.0 data set. Torch is imported when first used."""

from __future__ import annotations

from playslot_rl.collectors.collection import collect

__all__ = ["collect"]
