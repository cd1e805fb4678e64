"""What `playslot adopt` decided, kept so that a second call decides the same."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from playslot_rl.datasets.survey import Choice
from playslot_rl.errors import ConfigError
from playslot_rl.storage.atomic import write_json

NAME: Final = "adopt.json"


class Decisions:
    """What was decided, by name, in `RUN/adopt.json`.

    Args:
        facts: what the decisions depend on.
        began: `time.monotonic()` when this process began with the work.

    Attributes:
        made: what was decided.

    Raises:
        ConfigError: the run was begun with other facts.
    """

    def __init__(self, run: Path, facts: dict[str, Any], began: float) -> None:
        self.path = run / NAME
        stored: dict[str, Any] = json.loads(self.path.read_text()) if self.path.is_file() else {}
        facts = json.loads(json.dumps(facts))
        for key, value in stored.get("facts", facts).items():
            if facts.get(key) != value:
                raise ConfigError(
                    f"{key}: got {facts.get(key)}, expected {value}, with which out={run} was begun: leave it, or use "
                    "another out="
                )
        self.facts, self.made = facts, dict[str, Any](stored.get("choices", {}))
        self._before, self._began = float(stored.get("spent", 0.0)), began

    @property
    def spent(self) -> float:
        """Seconds of wall clock, with those of earlier processes up to the last that they noted."""
        return self._before + time.monotonic() - self._began

    def note(self, least: float = 0.0) -> None:
        """Write what is spent, which is so many seconds at least: a process that was killed noted less than it took."""
        self._before += max(0.0, least - self.spent)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_json(self.path, {"facts": self.facts, "choices": self.made, "spent": round(self.spent, 1)})

    def __call__(self, name: str, decide: Callable[[], Choice]) -> int:
        """The value of a decision, made now if it was not made before; it is said and written."""
        if name not in self.made:
            value, reason = decide()
            self.made[name] = {"value": value, "reason": reason}
            self.note()
        print(f"{name}: {self.made[name]['value']} ({self.made[name]['reason']})", flush=True)
        return int(self.made[name]["value"])
