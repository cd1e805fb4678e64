"""View-frustum culling: geoms outside the camera's pyramid are not handed to the GPU, nor to its software stand-in.

MuJoCo draws every visible geom of a scene, in view or not, and under software GL the vertices of the arm's base, hidden
behind the camera, cost a third of a frame. A geom is left out if its bounding sphere (centre x, radius r) lies outside
one of the pyramid's planes through the camera's position c, with inward unit normal n: n . (x - c) < -r. Without
shadows and reflections such a geom cannot change a pixel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import mujoco

HIDDEN_GROUP = 5
"""A geom group that MuJoCo's default visualisation options do not draw."""


class FrustumCuller:
    """Hides the geoms of a model that a camera fixed in the world cannot see.

    Args:
        model: the model.
        scene: a scene updated with the camera to be used; frames are square.
    """

    def __init__(self, model: mujoco.MjModel, scene: mujoco.MjvScene) -> None:
        self._model = model
        self._groups = model.geom_group.copy()
        # MuJoCo gives planes, which are infinite, the radius 0.
        self._radii = np.where(model.geom_rbound > 0.0, model.geom_rbound, np.inf)[:, None]
        # A scene holds a camera for each eye; a frame that is not stereo is drawn from halfway between.
        left, camera = scene.camera
        self._position = (np.asarray(left.pos, np.float64) + np.asarray(camera.pos, np.float64)) / 2
        forward, up = np.asarray(camera.forward, np.float64), np.asarray(camera.up, np.float64)
        right = np.cross(forward, up)
        slope = camera.frustum_top / camera.frustum_near
        sides = [slope * forward + sign * axis for axis in (right, up) for sign in (1.0, -1.0)]
        self._normals = np.stack([forward, *(side / np.linalg.norm(side) for side in sides)])

    def unseen(self, centres: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        """Which geoms are out of view: bool (geoms,), from their centres in metres (geoms, 3)."""
        outside: npt.NDArray[np.bool_] = ((centres - self._position) @ self._normals.T < -self._radii).any(axis=1)
        return outside

    def hide(self, data: mujoco.MjData) -> None:
        """Move the geoms that are out of view to a group that is not drawn."""
        self._model.geom_group[:] = np.where(self.unseen(data.geom_xpos), HIDDEN_GROUP, self._groups)

    def show(self) -> None:
        """Undo `hide`."""
        self._model.geom_group[:] = self._groups
