"""What the user sees of a running stage: a bar on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self


def format_seconds(seconds: float) -> str:
    """Short duration: `42 s`, `7 min 05 s`, `3 h 02 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


class StageProgress:
    """Step, rate, loss and remaining time of a stage.

    Args:
        name: the stage.
        start, steps: the first step of this process and the last one.
        enabled: `false` prints nothing.
        plain_every: steps between lines where standard error is no terminal.
    """

    def __init__(self, name: str, start: int, steps: int, enabled: bool, plain_every: int) -> None:
        self.name, self.start, self.steps, self.enabled = name, start, steps, enabled
        self.plain_every = max(1, plain_every)
        self._began = time.monotonic()
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> Self:
        if self.enabled and sys.stderr.isatty():
            from rich import progress as rich
            from rich.console import Console

            columns = (
                rich.TextColumn("{task.description}"),
                rich.BarColumn(),
                rich.MofNCompleteColumn(),
                rich.TextColumn("{task.fields[info]}"),
                rich.TimeRemainingColumn(),
            )
            self._bar = rich.Progress(*columns, console=Console(stderr=True))
            self._task = self._bar.add_task(self.name, total=self.steps, completed=self.start, info="")
            self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, done: int, values: Mapping[str, float]) -> None:
        """Show that `done` steps are finished."""
        if not self.enabled:
            return
        rate = (done - self.start) / max(1e-9, time.monotonic() - self._began)
        if self._bar is not None:
            info = f"loss {values['loss']:.5f}  {rate:.2f} steps/s" if "loss" in values else ""
            self._bar.update(self._task, completed=done, **({"info": info} if info else {}))
        elif done % self.plain_every == 0 or done == self.steps:
            left = format_seconds((self.steps - done) / max(rate, 1e-9))
            loss = f"loss {values['loss']:.5f}, " if "loss" in values else ""
            text = f"{self.name}: step {done}/{self.steps}, {loss}{rate:.2f} steps/s, {left} left"
            print(text, file=sys.stderr, flush=True)
