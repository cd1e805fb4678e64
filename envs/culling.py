"""View-frustum culling: geoms outside the camera's pyramid are not handed to the GPU, nor to its software stand-in.

MuJoCo draws every visible geom of a scene, in view or not, and under software GL the vertices of an arm's base, behind
the camera, cost a third of a frame. A geom is left out if its bounding box (centre x, half axes h_k) lies outside
one of the pyramid's planes through the camera's position c, with inward unit normal n:
n . (x - c) < -sum_k |n . h_k|. Without shadows and reflections such a geom cannot change a pixel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import mujoco

HIDDEN_GROUP = 5
"""A geom group that MuJoCo's default visualisation options do not draw."""
SLACK: Final = 1e-4
"""Metres by which boxes are taken to be larger: the scene is drawn in single precision."""


class FrustumCuller:
    """Hides the geoms of a model that a camera fixed in the world cannot see.

    Args:
        model: the model.
        scene: a scene updated with the camera to be used; frames are square.
    """

    def __init__(self, model: mujoco.MjModel, scene: mujoco.MjvScene) -> None:
        self._model = model
        self._groups = model.geom_group.copy()
        self._centres = model.geom_aabb[:, :3].copy()
        # Planes are infinite, which MuJoCo says by the radius 0.
        self._halves = np.where(model.geom_rbound[:, None] > 0.0, model.geom_aabb[:, 3:] + SLACK, np.inf)
        # A scene holds a camera for each eye; a frame that is not stereo is drawn from halfway between.
        left, camera = scene.camera
        self._position = (np.asarray(left.pos, np.float64) + np.asarray(camera.pos, np.float64)) / 2
        forward, up = np.asarray(camera.forward, np.float64), np.asarray(camera.up, np.float64)
        right = np.cross(forward, up)
        slope = camera.frustum_top / camera.frustum_near
        sides = [slope * forward + sign * axis for axis in (right, up) for sign in (1.0, -1.0)]
        self._normals = np.stack([forward, *(side / np.linalg.norm(side) for side in sides)])

    def unseen(self, data: mujoco.MjData) -> npt.NDArray[np.bool_]:
        """Which geoms are out of view: bool (geoms,)."""
        axes = data.geom_xmat.reshape(-1, 3, 3)
        centres = data.geom_xpos + (axes @ self._centres[:, :, None])[..., 0]
        with np.errstate(invalid="ignore"):  # a plane's 0 * inf is nan, which nothing is less than
            reach = (np.abs(self._normals @ axes) @ self._halves[:, :, None])[..., 0]
        outside: npt.NDArray[np.bool_] = ((centres - self._position) @ self._normals.T < -reach).any(axis=1)
        return outside

    def hide(self, data: mujoco.MjData) -> None:
        """Move the geoms that are out of view to a group that is not drawn."""
        self._model.geom_group[:] = np.where(self.unseen(data), HIDDEN_GROUP, self._groups)

    def show(self) -> None:
        """Undo `hide`."""
        self._model.geom_group[:] = self._groups
