"""What the user sees of a running stage: a bar on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Any, Final, Literal, Self

PICTURE_WRITER: Final = "lerobot.datasets.image_writer"
PLAIN_EVERY_S: Final = 10.0
"""Seconds between lines where no number of steps is given."""


def format_seconds(seconds: float) -> str:
    """Short duration: `42 s`, `7 min 05 s`, `3 h 02 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


class StageProgress:
    """How far a stage is, how fast, and what remains of its time: `start` were done before, of `total`. Where standard
    error is no terminal there is a line every `plain_every` of a unit; 0 means ten seconds.
    """

    def __init__(
        self,
        name: str,
        start: int,
        total: int,
        enabled: bool,
        plain_every: int = 0,
        unit: Literal["steps", "episodes"] = "steps",
    ) -> None:
        self.name, self.start, self.total, self.enabled = name, start, total, enabled
        self.plain_every, self.unit = plain_every, unit
        self._began = self._last = time.monotonic()
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
            self._task = self._bar.add_task(self.name, total=self.total, completed=self.start, info="")
            self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, done: int, values: Mapping[str, float] | None = None) -> None:
        """Show that `done` are finished, and the `loss` among `values`."""
        if not self.enabled:
            return
        rate = (done - self.start) / max(1e-9, time.monotonic() - self._began)
        speed = f"{rate:.2f} steps/s" if self.unit == "steps" else f"{rate:.1f} episodes/s"
        loss = f"loss {values['loss']:.5f}" if values and "loss" in values else ""
        if self._bar is not None:
            info = f"{loss}  {speed}" if loss or self.unit == "episodes" else None
            shown = {} if info is None else {"info": info.strip()}
            self._bar.update(self._task, completed=done, total=self.total, **shown)
        elif self._due(done):
            left = format_seconds((self.total - done) / max(rate, 1e-9))
            count = f"{'step ' if self.unit == 'steps' else ''}{done}/{self.total}"
            parts = [count, *([loss] if loss else []), speed, f"{left} left"]
            print(f"{self.name}: {', '.join(parts)}", file=sys.stderr, flush=True)

    def _due(self, done: int) -> bool:
        """Whether it is time for a plain line."""
        now = time.monotonic()
        due = done % self.plain_every == 0 if self.plain_every else now - self._last >= PLAIN_EVERY_S
        if due:
            self._last = now
        return due or done == self.total


@contextlib.contextmanager
def quiet(name: str, level: int) -> Iterator[None]:
    """Without a logger's lines below a level."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.setLevel(before)


@contextlib.contextmanager
def quiet_datasets() -> Iterator[None]:
    """Without the progress bar that `datasets` draws for every episode, and without LeRobot's line about a picture that
    cannot be written: the episode that lacks it cannot be saved.
    """
    import datasets

    shown = datasets.utils.logging.is_progress_bar_enabled()
    datasets.disable_progress_bars()
    try:
        with quiet(PICTURE_WRITER, logging.CRITICAL):
            yield
    finally:
        if shown:
            datasets.enable_progress_bars()
