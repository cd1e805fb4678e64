"""Dreamer's networks and objective as a fixture."""

from __future__ import annotations

import pytest
from dreamer_parts import Parts, make_parts


@pytest.fixture
def parts() -> Parts:
    """Networks and objective."""
    return make_parts()
