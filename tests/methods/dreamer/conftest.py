"""Makes `dreamer_parts` importable, and its parts a fixture."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from dreamer_parts import Parts, make_parts


@pytest.fixture
def parts() -> Parts:
    """Networks and objective."""
    return make_parts()
