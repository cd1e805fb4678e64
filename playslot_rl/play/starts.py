"""Where playing starts: a frame of a data set, a fresh episode of the simulator, or an uploaded picture.

Shapes: N slots, D slot width, E episodes, T frames, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.acting.episodes import Task
from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.data.rows import FrameRows
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.windows import spread_evenly
from playslot_rl.errors import RenderError
from playslot_rl.frames import to_float
from playslot_rl.play.picture import read_picture
from playslot_rl.play.timeline import Frame
from playslot_rl.play.twin import Twin
from playslot_rl.seeds.episodes import redraw_stride
from playslot_rl.world_model import WorldModel, module_device

SAME: Final = 2.0
"""Mean difference, of 255, up to which a re-run episode shows the recorded frame."""
CLIPS: Final = 24
CLIP_FRAMES: Final = 16
SIMULATED_CLIPS: Final = 4


@dataclass(frozen=True)
class Recorded:
    """How an episode went on when it was recorded, by its own actions.

    Attributes:
        frames: of the data set.
        first: row of the frame that is started from.
        count: frames from there to the episode's end.
    """

    frames: FrameRows
    first: int
    count: int

    def at(self, step: int) -> Frame | None:
        """The frame uint8 (H, W, 3) that many steps on; None after the end."""
        return np.array(self.frames[self.first + step]) if step < self.count else None


@dataclass(frozen=True)
class Start:
    """A first frame, parsed.

    Attributes:
        frame: uint8 (H, W, 3), as it was seen.
        slots: (1, N, D).
        fps: agent steps a second.
        twin: the simulator in the same state.
        recorded: what was recorded from here on; None beside a simulator.
    """

    title: str
    frame: Frame
    slots: Tensor
    fps: float = 10.0
    task: str = "playing in imagination"
    twin: Twin | None = None
    recorded: Recorded | None = None


@torch.no_grad()
def parse_last(model: WorldModel, frames: Frame, seed: int) -> Tensor:
    """Slots (1, N, D) of the last of some consecutive frames uint8 (T, H, W, 3), the first of which starts an episode.

    Earlier frames matter: SAVi goes on from them, as it did in training.
    """
    device = module_device(model)
    slots, _ = model.savi(to_float(frames, device)[None], generator=torch.Generator(device).manual_seed(seed))
    out: Tensor = slots[:, -1].clone()
    return out


class RecordedStarts:
    """Frames of a data set.

    Args:
        source: of the model's frame size.
        make_task: makes the simulator of the data set's episodes.
        seed: of sampled initial slots.
    """

    def __init__(
        self, model: WorldModel, source: EpisodeFrames, make_task: Callable[[], Task] | None = None, seed: int = 0
    ) -> None:
        self.model, self.source, self.make_task, self.seed = model, source, make_task, seed
        actions = source.actions
        usable = source.seeds is not None and actions is not None and actions.shape[1] == model.env.action_dim
        self._simulated = make_task is not None and usable

    @property
    def episodes(self) -> int:
        """E."""
        return self.source.episodes

    def start(self, episode: int, step: int) -> Start:
        """Start at a frame of an episode; with the simulator where it runs the recorded episode again, else with what
        was recorded after it.

        Raises:
            ValueError: there is no such frame.
        """
        if not 0 <= episode < self.episodes or not 0 <= step < int(self.source.lengths[episode]):
            raise ValueError(
                f"start: got frame {step} of episode {episode}, expected one of {self.episodes} episodes, and one of "
                "its frames"
            )
        rows = self.source.episode_rows(episode)[: step + 1]
        frames = np.asarray(self.source.frames[rows])
        length = int(self.source.lengths[episode])
        title = f"episode {episode}, frame {step} of {length}"
        slots = parse_last(self.model, frames, self.seed)
        task = self.source.task or "playing in imagination"
        twin = self._twin(episode, rows, frames[-1])
        recorded = Recorded(self.source.frames, int(rows[-1]), length - step) if twin is None else None
        return Start(title, frames[-1].copy(), slots, self.source.fps, task, twin, recorded)

    def _twin(self, episode: int, rows: npt.NDArray[np.int64], seen: Frame) -> Twin | None:
        """The episode run again to this frame, if it can be drawn and shows what was recorded."""
        if not self._simulated or self.make_task is None:
            return None
        assert self.source.seeds is not None
        assert self.source.actions is not None
        task = self.make_task()
        try:
            twin = Twin(task, int(self.source.seeds[episode]), list(self.source.actions[rows[:-1]]))
        except RenderError:
            task.close()
            return None
        if twin.first.shape != seen.shape or np.abs(twin.first.astype(float) - seen).mean() > SAME:
            twin.close()
            return None
        return twin

    def clips(self) -> Frame | None:
        """Some clips of the data set, uint8 (n, T, H, W, 3), evenly over its episodes; None where all are too short."""
        long = np.flatnonzero(self.source.lengths >= 2)
        if not len(long):
            return None
        frames = min(CLIP_FRAMES, int(self.source.lengths[long].max()))
        fit = long[self.source.lengths[long] >= frames]
        chosen = spread_evenly(fit, CLIPS)
        rows = self.source.starts[chosen][:, None] + np.arange(frames)
        clips: Frame = np.asarray(self.source.frames[rows])
        return clips


class SimulatedStarts:
    """Fresh episodes of the simulator, from `first_seed` on, `fps` agent steps a second."""

    def __init__(
        self,
        model: WorldModel,
        make_task: Callable[[], Task],
        fps: float = 10.0,
        task: str = "",
        first_seed: int = 0,
    ) -> None:
        self.model, self.make_task, self.fps, self.task, self.first_seed = model, make_task, fps, task, first_seed

    def start(self, number: int) -> Start:
        """Start episode `number`, from 0 on.

        Raises:
            RenderError: there is no GL backend.
        """
        seed = self.first_seed + number
        twin = Twin(self.make_task(), seed, stride=redraw_stride(seed))
        slots = parse_last(self.model, twin.first[None], seed)
        title = f"fresh episode {number}"
        return Start(title, twin.first, slots, self.fps, self.task or "playing in imagination", twin)

    def clips(self) -> Frame:
        """A few episodes of random actions, uint8 (n, T, H, W, 3)."""
        task, clips = self.make_task(), []
        rng = np.random.default_rng(self.first_seed)
        width = self.model.env.action_dim
        try:
            task.draw_steps = True
            for number in range(SIMULATED_CLIPS):
                observation, _ = task.reset(seed=self.first_seed + number)
                frames = [observation["pixels"]]
                for _ in range(CLIP_FRAMES - 1):
                    frames.append(task.step(rng.uniform(-1, 1, width).astype(np.float32))[0]["pixels"])
                clips.append(np.stack(frames))
        finally:
            task.close()
        return np.stack(clips)


def task_maker(env: EnvConfig, render: RenderConfig) -> Callable[[], Task]:
    """Makes environments of a task."""

    def make() -> Task:
        from playslot_rl.envs import make_env

        task: Any = make_env(env, render).unwrapped
        return task  # type: ignore[no-any-return]

    return make


def picture_start(
    model: WorldModel, content: bytes, name: str = "picture", seed: int = 0, whole: bool = False
) -> Start:
    """Start from a picture of any size, resized by area averaging: its largest centred square, or all of it.

    Args:
        whole: squeeze all of it into a square, as the frames of a model that was trained with `data.resize` were.

    Raises:
        DataError: it is no picture, or too large.
    """
    frame = read_picture(content, name, model.env.image_size, whole)
    return Start(name, frame, parse_last(model, frame[None], seed))
