"""What changes in the picture and not in the task: `env.variation.*`, drawn anew for each episode.

Everything is a function of the episode's seed, `env.variation.seed` and the agent step, and happens while a frame is
drawn: the simulation never sees it. Background and texture are painted by MuJoCo's segmentation before boxes are
averaged, so that their edges are as smooth as any.

Shapes: R = side of the frame as it is drawn, `supersample` times `image_size`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.config.env import VariationConfig

if TYPE_CHECKING:
    import mujoco

Layer = npt.NDArray[np.uint8]

STREAM: Final = 5
"""Spawn key of the variation's random numbers; an episode's others are 0 to 4 of its seed."""
FALLOFF: Final = 1.6  # amplitude of a pattern's frequency f is f ** -FALLOFF, as in pictures of the world
DRIFT: Final = 0.03  # of the frame's side that a layer of the background moves in an agent step, at most
TURN: Final = 4.0  # degrees about the point looked at that the camera shakes by, at most
SIZE: Final = 0.09  # half side of the moving object, in units of its distance from the camera
NEARER: Final = 0.6  # its distance, of that of the point looked at
DISTRACTOR: Final = 1 << 20
"""Number of the moving object where parts are numbered: no geom has it."""
PLANE: Final = 0
"""MuJoCo's `mjGEOM_PLANE`."""
COLOURED: Final = ("geom_rgba", "mat_rgba")
LIT: Final = ("light_diffuse", "light_ambient")


def pattern(rng: np.random.Generator, side: int) -> Layer:
    """A cloudy picture in colours that goes on where it ends: uint8 (R, R, 3)."""
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None]) * side
    scale = np.where(frequency > 0, np.maximum(frequency, 1.0) ** -FALLOFF, 0.0)
    shape = (*scale.shape, 3)
    waves = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) * scale[..., None]
    clouds = np.fft.irfft2(waves, (side, side), axes=(0, 1))
    clouds /= np.abs(clouds).max(axis=(0, 1))
    middle = rng.uniform(70, 185, 3)
    return np.clip(middle + 110 * clouds, 0, 255).astype(np.uint8)


class Wobble:
    """Smooth paths in [-1, 1] of numbers over time: sums of slow waves."""

    def __init__(self, rng: np.random.Generator, count: int) -> None:
        self._rates = rng.uniform(0.15, 0.6, (3, count))
        self._phases = rng.uniform(0, 2 * np.pi, (3, count))

    def __call__(self, step: int) -> npt.NDArray[np.float64]:
        found: npt.NDArray[np.float64] = np.sin(self._rates * step + self._phases).mean(axis=0)
        return found


class Variation:
    """One environment's variation of a MuJoCo model.

    Args:
        things: names of root bodies that the task is about, with the robot: never painted over. None where nobody
            knows: then planes and sky alone are painted, and nothing takes other colours.
        coloured: names of those among them that may take other colours: the robot.
        distance: metres to the point looked at.
    """

    def __init__(
        self,
        config: VariationConfig,
        model: mujoco.MjModel,
        things: Collection[str] | None,
        coloured: Collection[str],
        distance: float,
    ) -> None:
        self.config, self._model, self._distance = config, model, distance
        self.step = 0
        roots = [model.body(int(root)).name for root in model.body_rootid[model.geom_bodyid]]
        bodies = [model.body(int(body)).name for body in model.geom_bodyid]
        table = np.array(["table" in name.lower() for name in bodies])
        thing = model.geom_type != PLANE if things is None else np.array([name in things for name in roots])
        rest = model.body_weldid[model.geom_bodyid] == 0
        self._kinds = np.where(thing | ~(rest | table), 0, np.where(table, 2, 1)).astype(np.uint8)
        """Of each geom: 0 is left alone, 1 is background, 2 is a table."""
        self._plain = np.array([name in coloured for name in roots]) | ((self._kinds > 0) & (things is not None))
        self._base = {name: getattr(model, name).copy() for name in (*COLOURED, *LIT)}
        self._headlight = (model.vis.headlight.diffuse.copy(), model.vis.headlight.ambient.copy())

    def begin(self, episode: int, side: int) -> None:
        """Draw what the episode of a seed looks like."""
        sequence = np.random.SeedSequence([self.config.seed, episode], spawn_key=(STREAM,))
        scene, layers, camera, light, colours, moving = (np.random.default_rng(s) for s in sequence.spawn(6))
        self.step = 0
        if self.config.background:
            self._layers = [pattern(layers, side), pattern(layers, side)]
            self._drift = layers.uniform(-DRIFT, DRIFT, (2, 2)) * side
        if self.config.textures:
            ground = pattern(scene, side).astype(np.uint16)
            self._texture = (128 + ground // 2).astype(np.uint16)
        self._shake, self._light = Wobble(camera, 3), Wobble(light, 4)
        self._gain = light.uniform(-1, 1, 3)
        self._colour(colours)
        self._path, self._shape = Wobble(moving, 2), int(moving.integers(2))
        self._paint = np.append(moving.uniform(0.1, 1.0, 3), 1.0).astype(np.float32)

    def _colour(self, rng: np.random.Generator) -> None:
        strength = self.config.colours
        if not strength:
            return
        for name in COLOURED:
            values = self._base[name].copy()
            mixed = rng.uniform(0.1, 0.95, (len(values), 3))
            chosen = self._plain if name == "geom_rgba" else self._materials()
            values[chosen, :3] = ((1 - strength) * values[:, :3] + strength * mixed)[chosen]
            getattr(self._model, name)[:, :3][chosen] = values[chosen, :3]

    def _materials(self) -> npt.NDArray[np.bool_]:
        """Materials that only coloured geoms have."""
        used = self._model.geom_matid
        chosen = np.zeros(self._model.nmat, np.bool_)
        chosen[used[self._plain & (used >= 0)]] = True
        chosen[used[~self._plain & (used >= 0)]] = False
        return chosen

    @contextlib.contextmanager
    def shaken(self, data: mujoco.MjData, camera: Any, number: int) -> Iterator[None]:
        """While a frame is drawn, its camera (`number` of a camera of the model, else a free one) stands aside and the
        light is another."""
        yaw, pitch, roll = TURN * self.config.shake * self._shake(self.step)
        with contextlib.ExitStack() as undo:
            if self.config.light:
                self._lit(undo)
            if self.config.shake and number < 0:
                undo.callback(setattr, camera, "azimuth", camera.azimuth)
                undo.callback(setattr, camera, "elevation", camera.elevation)
                camera.azimuth, camera.elevation = camera.azimuth + yaw, camera.elevation + pitch
            elif self.config.shake:
                place, axes = data.cam_xpos[number].copy(), data.cam_xmat[number].copy()
                undo.callback(data.cam_xpos[number].__setitem__, slice(None), place)
                undo.callback(data.cam_xmat[number].__setitem__, slice(None), axes)
                turned = axes.reshape(3, 3) @ _rotation(*np.deg2rad([pitch, yaw, roll]))
                ahead = -axes.reshape(3, 3)[:, 2] * self._distance
                data.cam_xmat[number] = turned.ravel()
                data.cam_xpos[number] = place + ahead + turned[:, 2] * self._distance
            yield

    def _lit(self, undo: contextlib.ExitStack) -> None:
        head, model = self._model.vis.headlight, self._model
        gain = 1 + self.config.light * np.clip(0.45 * self._gain + 0.35 * self._light(self.step)[:3], -0.8, 0.8)
        for name in LIT:
            undo.callback(getattr(model, name).__setitem__, slice(None), self._base[name])
            getattr(model, name)[:] = self._base[name] * gain
        for name, base in zip(("diffuse", "ambient"), self._headlight, strict=True):
            undo.callback(getattr(head, name).__setitem__, slice(None), base)
            getattr(head, name)[:] = base * gain

    def add(self, mj: Any, scene: mujoco.MjvScene) -> None:
        """Put the moving object into a scene that is about to be drawn."""
        if not self.config.object or scene.ngeom >= scene.maxgeom:
            return
        left, right = scene.camera
        eye = (np.asarray(left.pos, np.float64) + np.asarray(right.pos, np.float64)) / 2
        forward, up = np.asarray(left.forward, np.float64), np.asarray(left.up, np.float64)
        away = NEARER * self._distance
        reach = away * left.frustum_top / left.frustum_near
        across, high = 1.2 * reach * self._path(self.step)
        place = eye + away * forward + across * np.cross(forward, up) + high * up
        kind = (mj.mjtGeom.mjGEOM_SPHERE, mj.mjtGeom.mjGEOM_BOX)[self._shape]
        geom = scene.geoms[scene.ngeom]
        size = np.full(3, SIZE * away)
        mj.mjv_initGeom(geom, kind, size, place, np.eye(3).ravel(), self._paint)
        geom.category, geom.objtype, geom.objid = mj.mjtCatBit.mjCAT_DECOR, mj.mjtObj.mjOBJ_UNKNOWN, DISTRACTOR
        geom.segid = scene.ngeom
        scene.ngeom += 1

    @property
    def paints(self) -> bool:
        """Whether a frame has to be segmented."""
        return self.config.background or self.config.textures

    def painted(self, frame: Layer, parts: npt.NDArray[np.int32], geom: int) -> Layer:
        """A frame (R, R, 3) with another background and table, of whose pixels the parts are known: number and kind
        (R, R, 2); kind `geom` is a geom's, -1 nothing's."""
        number, kind = parts[..., 0], parts[..., 1]
        of = np.where(kind == geom, self._kinds[np.clip(number, 0, len(self._kinds) - 1)], 0)
        frame = frame.copy()
        if self.config.background:
            behind = (of == 1) | (kind == -1)
            frame[behind] = self._video()[behind]
        if self.config.textures:
            table = of == 2
            frame[table] = np.minimum(frame[table] * self._texture[table] // 200, 255).astype(np.uint8)
        return frame

    def _video(self) -> Layer:
        """The background now: two layers that drift over each other, (R, R, 3)."""
        first, second = (
            np.roll(layer, (round(y * self.step), round(x * self.step)), (0, 1))
            for layer, (y, x) in zip(self._layers, self._drift, strict=True)
        )
        return first // 2 + second // 2


def _rotation(x: float, y: float, z: float) -> npt.NDArray[np.float64]:
    """About the axes of a camera, one after the other, radians: (3, 3)."""
    turned = np.eye(3)
    for axis, angle in enumerate((x, y, z)):
        one, c, s = np.eye(3), np.cos(angle), np.sin(angle)
        i, j = (k for k in range(3) if k != axis)
        one[i, i] = one[j, j] = c
        one[i, j], one[j, i] = -s, s
        turned = turned @ one
    return turned
