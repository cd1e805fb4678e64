"""What all pages share: one model, one worker, the places to start from.

Models, simulators and their renderers belong to one thread, so every call that touches them goes through the worker,
one after the other: several pages at once take turns, and the server's own thread stays free for clicks.

Shapes: K prototypes, N slots, D slot width, Z latent-action width.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from playslot_rl import keys
from playslot_rl.errors import DataError
from playslot_rl.play.session import PlaySession
from playslot_rl.play.starts import RecordedStarts, SimulatedStarts, Start, parse_last
from playslot_rl.play.steering import Driver, variability_directions
from playslot_rl.world_model import Agent, WorldModel


@dataclass(eq=False)
class Studio:
    """A model to play with: for its agent's policy, and in the simulator beside.

    Attributes:
        out: folder that recordings go to.
        drivers: further ones that may take over, by name.
        squeezes: the model's frames were squeezed into squares (`data.resize`), and uploaded pictures are likewise.
        horizon: steps that the model was trained to predict; 0 where that is not known.
        directions: (K, Z), see `variability_directions`.
        donors: (n, N, D), slots of other scenes for swapping; None where there are none.
    """

    world_model: WorldModel
    agent: Agent | None = None
    recorded: RecordedStarts | None = None
    simulated: SimulatedStarts | None = None
    out: Path = Path("runs/play")
    title: str = "world model"
    fps: float = 8.0
    drivers: dict[str, Driver] = field(default_factory=dict)
    squeezes: bool = False
    horizon: int = 0
    camera: str = keys.FEATURE_IMAGE

    def __post_init__(self) -> None:
        self._worker = ThreadPoolExecutor(1, "play")
        self.call(self._prepare).result()

    def _prepare(self) -> None:
        model, clips_of = self.world_model.eval(), self.recorded or self.simulated
        clips = None if clips_of is None else clips_of.clips()
        self.directions = variability_directions(model, clips)
        self.donors: Tensor | None = None
        if clips is not None:
            self.donors = torch.cat([parse_last(model, clip[:1], 0) for clip in clips])

    def call[Result](self, work: Callable[[], Result]) -> Future[Result]:
        return self._worker.submit(work)

    async def do[Result](self, work: Callable[[], Result]) -> Result:
        """The result of work, without standing in the way of other pages' clicks."""
        return await asyncio.wrap_future(self.call(work))

    def session(self) -> PlaySession:
        session = PlaySession(self.world_model, self.agent, self.directions)
        session.drivers.update(self.drivers)
        return session

    def start(self, source: str, number: int = 0, step: int = 0) -> Start:
        """A start by its source, `recorded` or `simulated`; `step` is of the frame in a recorded episode. A DataError
        where there is no such source, a ValueError where there is no such frame.
        """
        if source == "recorded" and self.recorded is not None:
            return self.recorded.start(number, step)
        if source == "simulated" and self.simulated is not None:
            return self.simulated.start(number)
        raise DataError(f"start: got {source}, expected one of {', '.join(self.sources) or 'none'}: upload a picture")

    @property
    def sources(self) -> dict[str, str]:
        """Titles of the sources that are there, by name; the first is where a page starts."""
        found = {}
        if self.recorded is not None:
            found["recorded"] = f"data set ({self.recorded.source.episodes} episodes)"
        if self.simulated is not None:
            found["simulated"] = "fresh simulator episode"
        return found

    def close(self) -> None:
        """End the worker when it has finished what it was given: pages that were closed have their simulators there."""
        self._worker.shutdown(wait=True)
