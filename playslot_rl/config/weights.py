"""`data.root=a:2,b:1`: the data sets that a command reads, and how often each is drawn from."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final, NamedTuple

from playslot_rl.errors import ConfigError

SCHEME: Final = "hf://"


def is_remote(root: str | Path) -> bool:
    """Whether a data set's name is an address on the Hub (`playslot_rl.data.remote`).

    Examples:
        >>> is_remote("hf://datasets/user/name"), is_remote("data/random")
        (True, False)
    """
    return str(root).startswith(SCHEME)


class DataRoot(NamedTuple):
    """One data set of `data.root`, as it was written; windows are drawn from it so often, relative to the others."""

    path: str
    weight: float | None

    @property
    def text(self) -> str:
        """As in `data.root`."""
        return self.path if self.weight is None else f"{self.path}:{self.weight:g}"


def data_roots(text: str) -> list[DataRoot]:
    """The data sets that a text such as `a`, `a,b` or `a:2,b` names; where only some have a weight, the others have 1.

    What follows a part's last colon is its weight if it is a number, unless a folder has the whole part as its name.
    Windows' `C:/sets/a` has no weight. A ConfigError where a weight is not above 0.

    Examples:
        >>> data_roots("sets/a, sets/b")
        [DataRoot(path='sets/a', weight=None), DataRoot(path='sets/b', weight=None)]
        >>> [root.text for root in data_roots("a:2,b")]
        ['a:2', 'b:1']
    """
    roots = [_one(part.strip()) for part in text.split(",") if part.strip()]
    if any(root.weight is not None for root in roots):
        roots = [root if root.weight is not None else DataRoot(root.path, 1.0) for root in roots]
    return roots


def _one(part: str) -> DataRoot:
    path, _, number = part.rpartition(":")
    if not path or Path(part).expanduser().exists():
        return DataRoot(part, None)
    try:
        weight = float(number)
    except ValueError:
        return DataRoot(part, None)
    if not (math.isfinite(weight) and weight > 0):
        raise ConfigError(f"data.root: got the weight {number} in {part}, expected a number above 0, as in a:2,b:1")
    return DataRoot(path, weight)
