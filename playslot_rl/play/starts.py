"""Where playing starts: a frame of a data set, a fresh episode of the simulator, or an uploaded picture; and the
simulator beside the imagined scene, which does what was decoded.

Shapes: N slots, D slot width, A action width, E episodes, T frames, H W image height and width.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.acting.episodes import Task, start_episode
from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.data.frames import resize_frames
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import FrameRows
from playslot_rl.data.windows import spread_evenly
from playslot_rl.errors import DataError, RenderError
from playslot_rl.frames import to_float
from playslot_rl.play.timeline import Frame
from playslot_rl.seeds.episodes import redraw_stride
from playslot_rl.world_model import WorldModel, module_device

MOST_BYTES: Final = 50_000_000
MOST_PIXELS: Final = 64 * 2**20
FORMATS: Final = ("PNG", "JPEG", "WEBP", "GIF", "BMP", "TIFF")
"""Others that Pillow knows need programs of their own (EPS) or decode what a header claims."""


def read_picture(content: bytes, name: str, side: int, whole: bool = False) -> Frame:
    """A model's frame, uint8 (side, side, 3), of a picture file, bounded in bytes and in pixels before anything of it
    is decoded: its largest centred square or, with `whole`, all of it squeezed into one, by area averaging. A DataError
    where it is no picture, or too large.
    """
    if len(content) > MOST_BYTES:
        raise DataError(
            f"{name}: got {len(content) / 1e6:.0f} MB, expected at most {MOST_BYTES // 1_000_000}: make it smaller"
        )
    pixels = _decode(content, name)
    if not whole:
        height, width = pixels.shape[:2]
        cut = min(height, width)
        top, left = (height - cut) // 2, (width - cut) // 2
        pixels = pixels[top : top + cut, left : left + cut]
    frame: Frame = resize_frames(pixels[None], side)[0]
    return frame


def _decode(content: bytes, name: str) -> npt.NDArray[np.uint8]:
    from PIL import Image

    size = "too many"
    try:
        # Pillow warns of sizes above the limit here, and of all kinds of damage.
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(content), formats=FORMATS) as image:
            size = f"{image.width}x{image.height}"  # from the header, nothing is decoded yet
            if image.width * image.height > MOST_PIXELS:
                raise Image.DecompressionBombError
            if not image.width * image.height:
                raise ValueError
            return np.asarray(image.convert("RGB"))
    except Image.DecompressionBombError as error:
        raise DataError(
            f"{name}: got {size} pixels, expected at most {MOST_PIXELS // 2**20} million: make it smaller"
        ) from error
    except Exception as error:  # a damaged file has Pillow raise whatever its decoders do
        raise DataError(
            f"{name}: got no picture that can be read, expected a PNG or JPEG file: choose another"
        ) from error


Action = npt.NDArray[np.float32]


class Twin:
    """A simulated episode that can be brought to any sequence of actions.

    Not all simulators have a state that can be kept and put back, but an episode is a function of its seed and its
    actions: where the wanted actions do not go on from those that were executed, it is run again from its start.
    Actions (A,) `lead` to where playing starts; `stride` is the distance to the seed tried next where the episode
    starts solved, 0 never tries another.
    """

    def __init__(self, task: Task, seed: int, lead: Sequence[Action] = (), stride: int = 0) -> None:
        self._task, self._lead = task, [np.asarray(action, np.float32) for action in lead]
        begun = start_episode(task, seed, stride) if stride else ({"pixels": self._reset(seed)}, seed, 0)
        self._frame, self.seed = begun[0]["pixels"], begun[1]
        self._done: list[bytes] = []
        self.first = self.follow([])

    def _reset(self, seed: int) -> Frame:
        return self._task.reset(seed=seed)[0]["pixels"]

    def follow(self, actions: Sequence[Action]) -> Frame:
        """Bring the simulator to where actions (A,), clipped to [-1, 1], lead from the start: a frame uint8 (H, W, 3)
        to keep.
        """
        wanted = [*self._lead, *(np.clip(np.asarray(action, np.float32), -1, 1) for action in actions)]
        known = [action.tobytes() for action in wanted]
        if known[: len(self._done)] != self._done:
            self._frame, self._done = self._reset(self.seed), []
        for number in range(len(self._done), len(wanted)):
            self._task.draw_steps = number == len(wanted) - 1  # drawing is most of a step
            observation, *_ = self._task.step(wanted[number])
            self._frame = observation["pixels"]
            self._done.append(known[number])
        return self._frame.copy()

    def close(self) -> None:
        self._task.close()


PLAYING: Final = "playing in imagination"
SAME: Final = 2.0
"""Mean difference, of 255, up to which a re-run episode shows the recorded frame."""
CLIPS: Final = 24
CLIP_FRAMES: Final = 16
SIMULATED_CLIPS: Final = 4


@dataclass(frozen=True)
class Recorded:
    """How an episode went on by its own actions: `count` frames from the row `first` on, which is started from."""

    frames: FrameRows
    first: int
    count: int

    def at(self, step: int) -> Frame | None:
        """The frame uint8 (H, W, 3) that many steps on; None after the end."""
        return np.array(self.frames[self.first + step]) if step < self.count else None


@dataclass(frozen=True)
class Start:
    """A first frame uint8 (H, W, 3) as it was seen, and its slots (1, N, D).

    Attributes:
        fps: agent steps a second.
        twin: the simulator in the same state.
        recorded: what was recorded from here on; None beside a simulator.
    """

    title: str
    frame: Frame
    slots: Tensor
    fps: float = 10.0
    task: str = PLAYING
    twin: Twin | None = None
    recorded: Recorded | None = None


@torch.no_grad()
def parse_last(model: WorldModel, frames: Frame, seed: int) -> Tensor:
    """Slots (1, N, D) of the last of some consecutive frames uint8 (T, H, W, 3), the first of which starts an episode:
    SAVi goes on from earlier frames, as it did in training.
    """
    return model.savi.parse(to_float(frames, module_device(model))[None], seed)[:, -1].clone()


class RecordedStarts:
    """Frames of a data set of the model's frame size; `make_task` makes its simulator, `seed` is of sampled initial
    slots.
    """

    def __init__(
        self, model: WorldModel, source: EpisodeFrames, make_task: Callable[[], Task] | None = None, seed: int = 0
    ) -> None:
        self.model, self.source, self.make_task, self.seed = model, source, make_task, seed

    def start(self, episode: int, step: int) -> Start:
        """Start at a frame of an episode; with the simulator where it runs the recorded episode again, else with what
        was recorded after it. A ValueError where there is no such frame.
        """
        if not 0 <= episode < self.source.episodes or not 0 <= step < int(self.source.lengths[episode]):
            raise ValueError(
                f"start: got frame {step} of episode {episode}, expected one of {self.source.episodes} "
                "episodes, and one of its frames"
            )
        rows, length = self.source.episode_rows(episode)[: step + 1], int(self.source.lengths[episode])
        frames = np.asarray(self.source.frames[rows])
        title = f"episode {episode}, frame {step} of {length}"
        slots = parse_last(self.model, frames, self.seed)
        task = self.source.task or PLAYING
        twin = self._twin(episode, rows, frames[-1])
        recorded = Recorded(self.source.frames, int(rows[-1]), length - step) if twin is None else None
        return Start(title, frames[-1].copy(), slots, self.source.fps, task, twin, recorded)

    def _twin(self, episode: int, rows: npt.NDArray[np.int64], seen: Frame) -> Twin | None:
        """The episode run again to this frame, if it can be drawn and shows what was recorded."""
        seeds, actions = self.source.seeds, self.source.actions
        if self.make_task is None or seeds is None or actions is None or actions.shape[1] != self.model.env.action_dim:
            return None
        if not np.isfinite(actions[rows[:-1]]).all():
            return None
        task = self.make_task()
        try:
            twin = Twin(task, int(seeds[episode]), list(actions[rows[:-1]]))
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
        chosen = spread_evenly(long[self.source.lengths[long] >= frames], CLIPS)
        return np.asarray(self.source.frames[self.source.starts[chosen][:, None] + np.arange(frames)])


class SimulatedStarts:
    """Fresh episodes of the simulator, from `first_seed` on, `fps` agent steps a second."""

    def __init__(
        self, model: WorldModel, make_task: Callable[[], Task], fps: float = 10.0, task: str = "", first_seed: int = 0
    ) -> None:
        self.model, self.make_task, self.fps, self.task, self.first_seed = model, make_task, fps, task, first_seed

    def start(self, number: int) -> Start:
        """Start episode `number`, from 0 on; a RenderError where there is no GL backend."""
        seed = self.first_seed + number
        twin = Twin(self.make_task(), seed, stride=redraw_stride(seed))
        slots = parse_last(self.model, twin.first[None], seed)
        return Start(f"fresh episode {number}", twin.first, slots, self.fps, self.task or PLAYING, twin)

    def clips(self) -> Frame:
        """A few episodes of random actions, uint8 (n, T, H, W, 3)."""
        task, clips = self.make_task(), []
        rng, width = np.random.default_rng(self.first_seed), self.model.env.action_dim
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
    def make() -> Task:
        from playslot_rl.envs import make_env

        task: Any = make_env(env, render).unwrapped
        return task  # type: ignore[no-any-return]

    return make


def picture_start(model: WorldModel, content: bytes, name: str = "picture", whole: bool = False) -> Start:
    """Start from a picture of any size (`read_picture`); `whole` is for a model trained with `data.resize`."""
    frame = read_picture(content, name, model.env.image_size, whole)
    return Start(name, frame, parse_last(model, frame[None], 0))
