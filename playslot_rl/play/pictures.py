"""What the page shows, as bytes: frames, masks over them, the strip of slots, small animations, the error's curve.

Shapes: T frames, n slots that are there, H W image height and width. Frames are uint8 [0, 255].
"""

from __future__ import annotations

import io
import itertools
import uuid
from collections.abc import Callable, Sequence
from typing import ClassVar, Final

import numpy as np
import torch
from PIL import Image
from PIL.ImageColor import getrgb
from torch import Tensor

from playslot_rl.colours import OKABE_ITO
from playslot_rl.frames import png
from playslot_rl.play.session import Look, PlaySession
from playslot_rl.play.starts import Start
from playslot_rl.play.timeline import Frame, SceneMoment
from playslot_rl.visualization.grid import side_by_side
from playslot_rl.world_model import WorldModel, module_device

EDGE: Final = 0.75
TINT: Final = 0.35
ANIMATION_FPS: Final = 6.0
MOST_PICTURES: Final = 300
"""In a session's animation: each takes memory and time, and nobody watches minutes of it."""
PATH: Final = "/play/picture/{page}/{name}/{number}"
"""Where the server has them."""
CURVE: Final = (400, 96)
"""Width and height of the error's curve; the style sheet colours it."""


class Gallery:
    """The newest pictures of one page, served to its browser, which may skip some; `open` are those
    of all open pages.
    """

    open: ClassVar[dict[str, Gallery]] = {}

    def __init__(self) -> None:
        self.key = uuid.uuid4().hex
        self._numbers = itertools.count()
        self._newest: dict[str, tuple[bytes, str]] = {}
        self.open[self.key] = self

    def put(self, name: str, content: bytes, kind: str = "image/png") -> str:
        """Show a picture under a name; returns an address that no picture had before."""
        self._newest[name] = (content, kind)
        return f"/play/picture/{self.key}/{name}/{next(self._numbers)}"

    def get(self, name: str) -> tuple[bytes, str] | None:
        return self._newest.get(name)

    def close(self) -> None:
        self.open.pop(self.key, None)
        self._newest.clear()


def colour_of(slot: int) -> tuple[int, ...]:
    """A slot's colour, the same everywhere."""
    return getrgb(OKABE_ITO[slot % len(OKABE_ITO)])


def with_masks(look: Look, chosen: int | None = None) -> Frame:
    """The frame tinted by the slot that owns each pixel, with the borders drawn; the chosen slot the strongest."""
    owner = look.owner
    colours = np.array([colour_of(slot) for slot in range(int(owner.max()) + 1)], np.float32)
    border = np.zeros(owner.shape, bool)
    border[:, :-1] |= owner[:, :-1] != owner[:, 1:]
    border[:-1] |= owner[:-1] != owner[1:]
    share = np.full(owner.shape, TINT, np.float32)
    if chosen is not None:
        share[owner == chosen] = 0.6
    share[border] = EDGE
    mixed = share[..., None] * colours[owner] + (1 - share[..., None]) * look.frame
    out: Frame = np.clip(mixed, 0, 255).astype(np.uint8)
    return out


def strip(look: Look, session: PlaySession, chosen: int | None, gap: int) -> Frame:
    """What each slot draws, side by side in the order of their numbers, uint8 (H, N * W + (N - 1) * gap, 3); an empty
    place where one was removed. A bar above says its colour, one below that it is frozen; the chosen one has a frame.
    """
    n = session.world_model.slot_shape[0]
    height, width = look.frame.shape[:2]
    picture = np.full((height, n * width + (n - 1) * gap, 3), 255, np.uint8)
    for number in range(n):
        cell = picture[:, number * (width + gap) : number * (width + gap) + width]
        if number not in session.now.present:
            cell[:] = 232
            continue
        cell[:] = look.objects[session.now.present.index(number)]
        colour = colour_of(number)
        cell[:3] = colour
        if number in session.now.frozen:
            cell[-3:] = (30, 120, 255)
        if number == chosen:
            cell[:, :2] = cell[:, -2:] = cell[-2:] = colour
    return picture


def animated(frames: Frame, fps: float = ANIMATION_FPS) -> bytes:
    """Endless GIF of frames (T, H, W, 3), whose last one stays a little longer."""
    first, *others = (Image.fromarray(frame) for frame in frames)
    times = [round(1000 / fps)] * len(others) + [600]
    buffer = io.BytesIO()
    first.save(buffer, format="GIF", save_all=True, append_images=others, duration=times, loop=0)
    return buffer.getvalue()


def session_animation(path: Sequence[SceneMoment], fps: float) -> bytes:
    """The moments of a path as an endless GIF: imagined, and beside it the simulator, or what was recorded. Of more
    than `MOST_PICTURES` moments every so many-th, at the speed of the session.
    """
    stride = -(-len(path) // MOST_PICTURES)
    path = path[::stride]
    clips = {"imagined": [moment.frame for moment in path]}
    for name, frames in (("simulator", [m.true for m in path]), ("recorded", [m.recorded for m in path])):
        there = [frame for frame in frames if frame is not None]
        if len(there) == len(path):
            clips[name] = there
    pictures = side_by_side(np.stack([np.stack(frames) for frames in clips.values()])[None], list(clips), [], scale=3)
    whites = []
    for picture in pictures:
        ground = Image.new("RGBA", picture.size, (255, 255, 255, 255))
        ground.alpha_composite(picture)
        whites.append(np.asarray(ground.convert("RGB")))
    return animated(np.stack(whites), fps / stride)


def error_curve(errors: Sequence[float | None], at: int) -> str:
    """The error over the steps as an SVG: RMS differences of [0, 1], None leaving a gap; `at` is the present one."""
    width, height = CURVE
    left, bottom, top = 34, height - 18, 8
    known = [error for error in errors if error is not None]
    most = max([0.05, *known])
    steps = max(1, len(errors) - 1)

    def place(step: int, error: float) -> tuple[float, float]:
        return left + (width - left - 6) * step / steps, bottom - (bottom - top) * error / most

    points = [place(step, error) for step, error in enumerate(errors) if error is not None]
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    error_here = errors[at] if at < len(errors) else None
    here = None if error_here is None else place(at, error_here)
    dot = f'<circle cx="{here[0]:.1f}" cy="{here[1]:.1f}" r="4"/>' if here else ""
    return (
        f'<svg viewBox="0 0 {width} {height}" xmlns="http://www.w3.org/2000/svg">'
        f'<line x1="{left}" y1="{bottom}" x2="{width - 6}" y2="{bottom}"/>'
        f'<line x1="{left}" y1="{top}" x2="{left}" y2="{bottom}"/>'
        f'<text x="2" y="{top + 8}">{most:.2f}</text><text x="22" y="{bottom}">0</text>'
        f'<text x="{left}" y="{height - 4}">start</text>'
        f'<text x="{width - 6}" y="{height - 4}" text-anchor="end">moment {steps}</text>'
        f'<polyline points="{line}"/>{dot}</svg>'
    )


def game(model: WorldModel, steps: int) -> Callable[[], Tensor]:
    """A game without a browser, from random slots, prototype after prototype: each step is predicted, decoded and
    encoded as what the page sends. What plays one returns the mean square of the last slots.
    """
    session, side = PlaySession(model), model.env.image_size
    first = Start("", np.zeros((side, side, 3), np.uint8), torch.randn(1, *model.slot_shape).to(module_device(model)))

    @torch.no_grad()
    def play() -> Tensor:
        session.begin(first)
        for number in range(steps):
            session.press(number % len(session.prototypes), 1.0)
            look = session.look()
            png(look.frame, level=1)
            png(with_masks(look), level=1)
            png(strip(look, session, None, 4), level=1)
        return session.slots.square().mean()

    return play
