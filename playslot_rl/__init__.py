"""PlaySlot-RL: robot behaviours from unlabelled videos through object slots and latent actions.

Importing the package is quick and has no side effect; the names below load on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = ["PlaySlot", "__version__", "load"]

if TYPE_CHECKING:
    from playslot_rl.api import PlaySlot, load


def __getattr__(name: str) -> Any:
    if name in {"PlaySlot", "load"}:
        from playslot_rl import api

        return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
