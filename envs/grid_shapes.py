"""GridShapes: shapes that move up, down, left and right on a plain ground, drawn by numpy (environments.md; paper).

A clip is a function of its seed and the settings alone. There is no simulator and nothing to act on: the shapes move by
themselves, and what they did is known, to score what a model finds without labels.

Shapes: C clips, T steps (a clip has T + 1 frames), O objects, H W image height and width, G size of a shape.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.config import EnvConfig
from playslot_rl.errors import ConfigError

MOVES: Final = ("up", "down", "left", "right", "stay")
"""Names of the moves, by label."""
DISPLACEMENTS: Final[npt.NDArray[np.int64]] = np.array([[0, -1], [0, 1], [-1, 0], [1, 0], [0, 0]])
"""(dx, dy) of each move, in units of the speed; y grows downwards, as in pictures."""
REVERSED: Final[npt.NDArray[np.int64]] = np.array([1, 0, 3, 2, 4])
"""The move that undoes each move."""
SHAPES: Final = ("ball", "triangle", "square")
_HEX: Final = "e41a1c 377eb8 4daf4a ffdd33 984ea3 ff7f00 00ced1 f781bf 1e1e1e f5f5f5"
PALETTE: Final[npt.NDArray[np.uint8]] = np.frombuffer(bytes.fromhex(_HEX), np.uint8).reshape(-1, 3)
"""Colours of shapes and ground. More colours than shapes, so that one is always left for the ground."""
METADATA: Final[dict[str, Any]] = {"control_hz": 10, "task": "Shapes move on a plane."}
"""Frames a second and task of a data set of clips."""


@dataclass(frozen=True)
class Clips:
    """Clips with all that is known about them.

    Attributes:
        frames: uint8 [0, 255] (C, T + 1, H, W, 3).
        moves: int64 (C, T, O), index into `MOVES`: what each object did between frames t and t + 1, bounces included.
        masks: uint8 (C, T + 1, H, W): 0 for the ground, o + 1 where object o is what is seen.
        corners: int64 (C, T + 1, O, 2), x and y of each object's upper left corner, pixels.
        shapes: int64 (C, O), index into `SHAPES`.
        colours: uint8 (C, O, 3).
        ground: uint8 (C, 3), colour of the ground.
    """

    frames: npt.NDArray[np.uint8]
    moves: npt.NDArray[np.int64]
    masks: npt.NDArray[np.uint8]
    corners: npt.NDArray[np.int64]
    shapes: npt.NDArray[np.int64]
    colours: npt.NDArray[np.uint8]
    ground: npt.NDArray[np.uint8]

    @property
    def actions(self) -> npt.NDArray[np.float32]:
        """(C, T, 2 O), values -1, 0 or 1: dx and dy of each object, in units of the speed."""
        return DISPLACEMENTS[self.moves].reshape(*self.moves.shape[:2], -1).astype(np.float32)

    @property
    def states(self) -> npt.NDArray[np.float32]:
        """(C, T + 1, 2 O): x and y of each object's upper left corner, pixels."""
        return self.corners.reshape(*self.corners.shape[:2], -1).astype(np.float32)


def moves_of(actions: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Labels (..., O), index into `MOVES`, of the actions (..., 2 O) of a recorded data set."""
    pairs = np.rint(np.asarray(actions)).astype(np.int64).reshape(*np.shape(actions)[:-1], -1, 2)
    labels: npt.NDArray[np.int64] = np.abs(pairs[..., None, :] - DISPLACEMENTS).sum(-1).argmin(-1)
    return labels


def generate(seeds: Iterable[int], steps: int, env: EnvConfig) -> Clips:
    """Draw the clips of some seeds, of T steps each.

    Each object starts at a place drawn uniformly from those where it lies inside the frame, and with a random move. At
    each step it draws a new move with probability `env.grid.change` (uniformly from all five), else it keeps the last
    one. A move that would leave the frame is reversed. Later objects occlude earlier ones. A ConfigError where a shape
    is larger than the frame.

    Examples:
        >>> clips = generate([3, 4], 5, EnvConfig(name="grid_shapes"))
        >>> clips.frames.shape, clips.moves.shape
        ((2, 6, 64, 64, 3), (2, 5, 2))
    """
    grid, room = env.grid, _room(env)
    drawn = [_draw(seed, steps, env) for seed in seeds]
    start, shapes, colours, ground, turns, wanted = (np.stack(part) for part in zip(*drawn, strict=True))
    corners, moves = _move(start, turns, wanted, room, grid.speed)
    frames, masks = _paint(corners, sprites(grid.size)[shapes], colours, ground, env.image_size)
    return Clips(frames, moves, masks, corners, shapes, colours, ground)


def visited(
    rng: np.random.Generator, clips: int, steps: int, env: EnvConfig
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Where, of what shape and colour the objects of some clips are, all drawn by one generator with the probabilities
    of `generate`; raises as that.

    Returns:
        Corners (C, T + 1, O, 2) and shapes (C, O) as of `Clips`; colours (C, 1 + O), index into `PALETTE`, the ground's
        first.
    """
    grid, room, each = env.grid, _room(env), (clips, env.grid.objects)
    start, shapes = rng.integers(0, room + 1, (*each, 2)), rng.integers(len(SHAPES), size=each)
    chosen, rank = rng.integers(len(PALETTE), size=each), rng.random((clips, len(PALETTE)))
    np.put_along_axis(rank, chosen, -1.0, 1)  # the ground has the first of those that are left, in any order
    along = (clips, steps, grid.objects)
    turns, wanted = rng.random(along) < grid.change, rng.integers(len(MOVES), size=along)
    corners, _ = _move(start, turns, wanted, room, grid.speed)
    return corners, shapes, np.concatenate([rank.argmax(1)[:, None], chosen], 1)


def check_actions(env: EnvConfig) -> None:
    """Refuse actions that are not two for each object, and objects that do not fit into a frame (ConfigError)."""
    if env.grid.size > env.image_size:
        raise ConfigError(
            f"env.grid.size: got {env.grid.size}, expected at most the {env.image_size} pixels of env.image_size"
        )
    expected = 2 * env.grid.objects
    if env.action_dim != expected:
        raise ConfigError(
            f"env.action_dim: got {env.action_dim}, expected {expected}, two for each of the {env.grid.objects} "
            f"objects: set env.action_dim={expected} and model.savi.n_slots={env.grid.objects + 1}"
        )


def _room(env: EnvConfig) -> int:
    """Pixels that a shape can be moved by inside the frame; a ConfigError where it cannot turn round in them."""
    grid, room = env.grid, env.image_size - env.grid.size
    if room < 2 * grid.speed:
        raise ConfigError(
            f"env.grid.size: got {grid.size} with speed {grid.speed}, expected shapes that can move in a frame of "
            f"{env.image_size} pixels; make them smaller, or the frames larger"
        )
    return room


def _draw(seed: int, steps: int, env: EnvConfig) -> tuple[npt.NDArray[Any], ...]:
    """All random numbers of one clip."""
    rng, objects = np.random.default_rng(seed), env.grid.objects
    start = rng.integers(0, env.image_size - env.grid.size + 1, (objects, 2))
    shapes = rng.integers(len(SHAPES), size=objects)
    chosen = rng.integers(len(PALETTE), size=objects)
    left = np.setdiff1d(np.arange(len(PALETTE)), chosen)
    ground = PALETTE[left[rng.integers(len(left))]]
    turns = rng.random((steps, objects)) < env.grid.change
    turns[0] = True  # the first move is drawn, too
    return start, shapes, PALETTE[chosen], ground, turns, rng.integers(len(MOVES), size=(steps, objects))


def _move(
    start: npt.NDArray[np.int64],
    turns: npt.NDArray[np.bool_],
    wanted: npt.NDArray[np.int64],
    room: int,
    speed: int,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Corners (C, T + 1, O, 2) and moves (C, T, O) from starts (C, O, 2), turns and wanted moves (C, T, O)."""
    corners, moves = [start], []
    move = wanted[:, 0]
    for t in range(turns.shape[1]):
        move = np.where(turns[:, t], wanted[:, t], move)
        after = corners[-1] + speed * DISPLACEMENTS[move]
        outside = ((after < 0) | (after > room)).any(-1)
        move = np.where(outside, REVERSED[move], move)
        corners.append(corners[-1] + speed * DISPLACEMENTS[move])
        moves.append(move)
    return np.stack(corners, 1), np.stack(moves, 1)


def sprites(size: int) -> npt.NDArray[np.bool_]:
    """(3, G, G): the pixels of ball, triangle and square."""
    middle = (size - 1) / 2
    y, x = np.mgrid[:size, :size] - middle
    ball = x**2 + y**2 <= (size / 2) ** 2
    triangle = np.abs(x) <= (y + middle) / 2
    return np.stack([ball, triangle, np.ones_like(ball)])


def _paint(
    corners: npt.NDArray[np.int64],
    drawn: npt.NDArray[np.bool_],
    colours: npt.NDArray[np.uint8],
    ground: npt.NDArray[np.uint8],
    size: int,
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Frames and masks; the shapes are drawn as (C, O, G, G) say."""
    clips, frames_each, objects = corners.shape[:3]
    masks = np.zeros((clips, frames_each, size, size), np.uint8)
    inside = np.arange(drawn.shape[-1])
    clip = np.arange(clips)[:, None, None, None]
    time = np.arange(frames_each)[:, None, None]
    for o in range(objects):
        rows = corners[:, :, o, 1, None, None] + inside[:, None]
        columns = corners[:, :, o, 0, None, None] + inside
        below = masks[clip, time, rows, columns]
        masks[clip, time, rows, columns] = np.where(drawn[:, o, None], np.uint8(o + 1), below)
    table = np.concatenate([ground[:, None], colours], 1)
    return table[clip, masks], masks
