"""`playslot cache ACTION ...`: what the caches of decoded frames and parsed slots hold, and making room."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from playslot_rl.recipes.actions import JSON, Action, argument

USAGE: Final = "ACTION [options]"
DESCRIPTION: Final = (
    "Look after the caches of decoded frames and parsed slots. What is removed is made again when it is needed."
)
CACHE: Final = argument("--cache", "DIR", "the cache (default $PLAYSLOT_CACHE or ~/.cache/playslot_rl)", type=Path)
NAMES: Final = argument("names", "NAME", "entries of `playslot cache list`; none means all", nargs="*")
ACTIONS: Final[dict[str, Action]] = {
    "list": Action(
        "what is there: data set, size, last use, and whether a process uses it",
        "One line an entry, the least recently used first: those make room where data.cache_limit= is reached.",
        ("playslot cache list", "playslot cache list --json --cache data/cache"),
        "playslot_rl.data.cache:listing",
        (CACHE, JSON),
    ),
    "clear": Action(
        "remove what no process uses",
        "Removes all entries, or those named (the beginning of a name will do). What a process has open or makes "
        "stays.",
        ("playslot cache clear", "playslot cache clear 3f9a01 --cache data/cache"),
        "playslot_rl.data.cache:clear",
        (NAMES, CACHE, JSON),
    ),
}
