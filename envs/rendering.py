"""Off-screen rendering: one path for training data and for evaluation.

What makes MuJoCo's default slow under software GL is the 4096-pixel shadow map and 4x multisampling. The `fast` path
switches both off, leaves out what the camera cannot see, draws at `supersample` times the size and averages boxes:
about 3 ms a 64x64 frame instead of 46 to 80.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import sys
import warnings
import weakref
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from playslot_rl.config import RenderConfig
from playslot_rl.envs.culling import FrustumCuller, Still, coarse, only_in_sight
from playslot_rl.envs.gl_contexts import kept_contexts
from playslot_rl.errors import RenderError

if TYPE_CHECKING:
    import mujoco

    from playslot_rl.envs.variation import Variation

CURE = "set MUJOCO_GL to egl, osmesa or glfw and install that library (Debian/Ubuntu: apt-get install libegl1 libgl1)"


@dataclass(frozen=True)
class Camera:
    """A free camera: metres from the point looked at, degrees about the vertical and over the horizon (under it:
    negative)."""

    distance: float
    azimuth: float
    elevation: float
    lookat: tuple[float, float, float]


def import_mujoco() -> Any:
    """Import mujoco with a GL backend that works without a display.

    MuJoCo reads `MUJOCO_GL` once, when it is first imported, and torchrl.envs imports it too. On Linux it is `egl`
    where it is not set, so that every machine and process draws by the same path; where mujoco was imported before
    that, its choice of context is replaced. A RenderError where that backend does not work.
    """
    linux = sys.platform.startswith("linux")
    imported_before = "mujoco" in sys.modules
    if linux:
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import mujoco

        if linux and imported_before and os.environ["MUJOCO_GL"] == "egl":
            from mujoco import gl_context
            from mujoco.egl import GLContext

            gl_context.GLContext = GLContext
    except Exception as error:  # PyOpenGL raises AttributeError, ImportError or RuntimeError, by platform
        raise RenderError(_message(error)) from error
    return mujoco


def _make_renderer(mj: Any, model: mujoco.MjModel, side: int) -> Any:
    class QuietRenderer(mj.Renderer):
        """A renderer whose destructor also works where its constructor failed (no traceback after our error)."""

        _gl_context: Any = None
        _mjr_context: Any = None

        def close(self) -> None:
            """What was uploaded lies in the context, which the next renderer may get: it goes first."""
            if self._gl_context is not None and self._mjr_context is not None:
                with contextlib.suppress(RuntimeError):  # another thread draws in it: freed, with all that is in it
                    self._gl_context.make_current()
                    self._mjr_context.free()
                    self._mjr_context = None
            super().close()

    try:
        with warnings.catch_warnings(), kept_contexts():
            warnings.simplefilter("ignore")  # GLFW warns, then fails
            return QuietRenderer(model, height=side, width=side)
    except RenderError:
        raise
    except Exception as error:  # each GL backend raises its own types
        raise RenderError(_message(error)) from error


def _message(error: BaseException) -> str:
    backend = os.environ.get("MUJOCO_GL", "")
    reason = " ".join(str(error).split()) or type(error).__name__
    return f"no GL backend: got MUJOCO_GL={backend!r} ({reason}), expected one that can draw off-screen; {CURE}"


def box_mean(frame: npt.NDArray[np.uint8], factor: int) -> npt.NDArray[np.uint8]:
    """Average boxes of `factor` x `factor` pixels: uint8 (H * factor, W * factor, 3) to (H, W, 3).

    Integer arithmetic, rounded to nearest, so exact on every machine; sums of strided slices, because a reduction over
    two axes of a reshaped array is ten times slower.
    """
    wide = frame.astype(np.uint16)
    tall = sum(wide[i::factor] for i in range(1, factor)) + wide[0::factor]
    total = sum(tall[:, i::factor] for i in range(1, factor)) + tall[:, 0::factor]
    mean: npt.NDArray[np.uint8] = ((total + factor**2 // 2) // factor**2).astype(np.uint8)
    return mean


def box_sized(picture: npt.NDArray[np.uint8], size: int) -> npt.NDArray[np.uint8]:
    """A picture (H, W, 3) of any size by area averaging: uint8 (size, size, 3)."""
    if picture.shape[:2] == (size, size):
        return picture.copy()
    from PIL import Image

    return np.asarray(Image.fromarray(picture).resize((size, size), Image.Resampling.BOX)).copy()


class FrameRenderer:
    """Draws the scene of one MuJoCo model from a viewpoint, or a camera of the model, by name or number; of one that is
    `at_rest` in the world, and of `still` parts, which never move, `fast` draws only what it can see, and no details of
    meshes under `cell` metres. A RenderError without a GL backend.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        camera: Camera | str | int | mujoco.MjvCamera,
        size: int,
        config: RenderConfig,
        still: Still | None = None,
        at_rest: bool = True,
        cell: float = 0.0,
    ) -> None:
        mj = import_mujoco()
        fast = config.quality == "fast"
        self.size = size
        self._factor = config.supersample if fast else 1
        side = size * self._factor
        model.vis.global_.offwidth = model.vis.global_.offheight = side
        if fast:
            model.vis.quality.offsamples = 0
            model.vis.quality.shadowsize = 0  # a map of 4096x4096 is made even where no shadow is drawn: 0.1 s, 64 MB
        with contextlib.ExitStack() as stack:
            if fast and still is not None and isinstance(camera, str):
                stack.enter_context(only_in_sight(model, still, model.camera(camera).pos))
            if fast and cell:
                stack.enter_context(coarse(model, cell))
            self._renderer = _make_renderer(mj, model, side)
        self._finalizer = weakref.finalize(self, self._renderer.close)
        # Handlers at exit run last in, first out: ours must precede EGL's own, registered with its first context, or
        # closing prints tracebacks. `finalize` may have registered its handler before both.
        self._finalizer.atexit = False
        atexit.register(self._finalizer)
        if fast:
            for flag in (mj.mjtRndFlag.mjRND_SHADOW, mj.mjtRndFlag.mjRND_REFLECTION):
                self._renderer.scene.flags[flag] = 0
        self._variation: Variation | None = None
        self._model, self._number = model, model.camera(camera).id if isinstance(camera, str | int) else -1
        self._camera: Any = camera
        if isinstance(camera, Camera):
            self._camera = view = mj.MjvCamera()
            view.type = mj.mjtCamera.mjCAMERA_FREE
            view.distance, view.azimuth, view.elevation = camera.distance, camera.azimuth, camera.elevation
            view.lookat[:] = camera.lookat
        self._culler: FrustumCuller | None = None
        if fast and at_rest:
            data = mj.MjData(model)
            mj.mj_forward(model, data)
            self._renderer.update_scene(data, self._camera)
            self._culler = FrustumCuller(model, self._renderer.scene)

    def __call__(self, data: mujoco.MjData) -> npt.NDArray[np.uint8]:
        """Draw one frame: uint8 [0, 255] of shape (H, W, 3)."""
        if self._variation is not None:
            return self._varied(data, self._variation)
        if self._culler is None:
            self._renderer.update_scene(data, self._camera)
        else:
            self._culler.hide(data)
            try:
                self._renderer.update_scene(data, self._camera)
            finally:
                self._culler.show()
        frame: npt.NDArray[np.uint8] = self._renderer.render()
        if self._factor == 1:
            return frame.copy()
        return box_mean(frame, self._factor)

    def vary(self, variation: Variation) -> None:
        """Draw with a variation from now on."""
        self._variation = variation

    @property
    def side(self) -> int:
        """Of a frame before boxes are averaged."""
        return self.size * self._factor

    def _varied(self, data: mujoco.MjData, variation: Variation) -> npt.NDArray[np.uint8]:
        mj = import_mujoco()
        with variation.shaken(data, self._camera, self._number):
            frame: npt.NDArray[np.uint8] = self._drawn(data).copy()
            if variation.paints:
                frame = variation.painted(frame, self._segmented(data), int(mj.mjtObj.mjOBJ_GEOM))
        return frame if self._factor == 1 else box_mean(frame, self._factor)

    def _drawn(self, data: mujoco.MjData) -> npt.NDArray[Any]:
        """The scene as it is, and what a variation puts into it."""
        self._renderer.update_scene(data, self._camera)
        if self._variation is not None:
            self._variation.add(import_mujoco(), self._renderer.scene)
        found: npt.NDArray[Any] = self._renderer.render()
        return found

    def _segmented(self, data: mujoco.MjData) -> npt.NDArray[np.int32]:
        """The part at each pixel that is drawn: its number and `mjtObj` type, -1 where none."""
        self._renderer.enable_segmentation_rendering()
        try:
            return self._drawn(data)
        finally:
            self._renderer.disable_segmentation_rendering()

    def parts(self, data: mujoco.MjData) -> npt.NDArray[np.int32]:
        """The part at the centre of each pixel: int32 (H, W, 2), its number and `mjtObj` type; -1 where none."""
        with contextlib.ExitStack() as stack:
            if self._variation is not None:
                stack.enter_context(self._variation.shaken(data, self._camera, self._number))
            found = self._segmented(data)
        middle = self._factor // 2
        return found[middle :: self._factor, middle :: self._factor].copy()

    def close(self) -> None:
        """Free the GL context; safe to call twice."""
        self._finalizer()
        atexit.unregister(self._finalizer)


def check_rendering() -> npt.NDArray[np.uint8]:
    """Draw a red ball, uint8 (64, 64, 3); a RenderError where there is no working GL backend, or nothing is drawn."""
    mj = import_mujoco()
    ball = "<light pos='0 0 3'/><geom type='sphere' size='.3' rgba='1 0 0 1'/>"
    model = mj.MjModel.from_xml_string(f"<mujoco><worldbody>{ball}</worldbody></mujoco>")
    data = mj.MjData(model)
    mj.mj_forward(model, data)
    renderer = FrameRenderer(model, Camera(2.0, 90.0, -20.0, (0.0, 0.0, 0.0)), 64, RenderConfig())
    try:
        frame = renderer(data)
    finally:
        renderer.close()
    if frame.max() <= 60:
        raise RenderError(_message(ValueError(f"an empty frame, brightest value {frame.max()}")))
    return frame
