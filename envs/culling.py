"""What a camera that is fixed in the world cannot see is not handed to the GPU, nor to its software stand-in.

MuJoCo draws every visible geom of a scene, in view or not, and under software GL the vertices of an arm's base, behind
the camera, cost a third of a frame. Without shadows and reflections nothing that is left out here can change a pixel:

- geoms outside the camera's pyramid. One is left out if its bounding box (centre x, half axes h_k) lies outside one of
  the pyramid's planes through the camera's position c, with inward unit normal n: n . (x - c) < -sum_k |n . h_k|;
- facets of parts that never move: most of a robot's base faces away or stands behind the table. Only what the GL
  context is given shrinks: the model, and with it the simulation, stay as they are.

`coarse` leaves out details that are finer than a pixel, which changes some by a few levels.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import mujoco

HIDDEN_GROUP = 5  # a geom group that MuJoCo's default visualisation options do not draw
SLACK: Final = 1e-4  # metres by which boxes are taken to be larger: the scene is drawn in single precision
GRAZING: Final = 0.02
"""Facets seen under a smaller sine are kept whichever way they face: joints give way by micrometres."""
SHRINK: Final = 0.002  # metres by which the screen is taken to be smaller

Vector = npt.NDArray[np.float64]


class FrustumCuller:
    """Hides the geoms of a model that a camera fixed in the world (the scene's; frames are square) cannot see."""

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
        self._model.geom_group[:] = self._groups


@dataclass(frozen=True)
class Still:
    """Parts at rest, as `data` has them: mesh geoms, each the only user of its mesh, and a box that may hide them."""

    data: mujoco.MjData
    geoms: tuple[str, ...]
    screen: str


def facing(corners: Vector, camera: Vector) -> npt.NDArray[np.bool_]:
    """Which facets show the camera (3,) their front: corners (F, 3, 3), counter-clockwise; bool (F,)."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    views = corners.mean(axis=1) - camera
    size = np.linalg.norm(normals, axis=1) * np.linalg.norm(views, axis=1)
    front: npt.NDArray[np.bool_] = (normals * views).sum(axis=1) < GRAZING * size
    return front


def screened(points: Vector, camera: Vector, half: Vector) -> npt.NDArray[np.bool_]:
    """Which points (P, 3) a box with half sides (3,) about the origin hides from the camera (3,): bool (P,).

    The shadow of a convex body is convex, so that a facet whose corners are all in it is hidden.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        planes = np.stack([-half - camera, half - camera])[:, None] / (points - camera)
    enter, leave = planes.min(axis=0).max(axis=1), planes.max(axis=0).min(axis=1)
    hidden: npt.NDArray[np.bool_] = (enter < leave) & (enter > 0.0) & (enter < 1.0)
    return hidden


def in_sight(model: mujoco.MjModel, still: Still, name: str, camera: Vector) -> npt.NDArray[np.bool_]:
    """Which facets of the mesh of geom `name` the camera at (3,) sees: bool (facets,)."""
    data, geom, box = still.data, model.geom(name).id, model.geom(still.screen).id
    mesh = model.geom_dataid[geom]
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    axes, place = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    vertices = model.mesh_vert[start : start + count].astype(np.float64) @ axes.T + place
    first, facets = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    faces = model.mesh_face[first : first + facets]
    box_axes, box_place = data.geom_xmat[box].reshape(3, 3), data.geom_xpos[box]
    hidden = screened((vertices - box_place) @ box_axes, (camera - box_place) @ box_axes, model.geom_size[box] - SHRINK)
    seen: npt.NDArray[np.bool_] = facing(vertices[faces], camera) & ~hidden[faces].all(axis=1)
    return seen


def _kept_first(model: mujoco.MjModel, mesh: int, kept: npt.NDArray[np.bool_]) -> None:
    """Leave a mesh only those of its facets: bool (facets,)."""
    rows = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + len(kept))
    order = np.argsort(~kept, kind="stable")
    for table in (model.mesh_face, model.mesh_facenormal, model.mesh_facetexcoord):
        table[rows] = table[rows][order]
    model.mesh_facenum[mesh] = kept.sum()


@contextlib.contextmanager
def _meshes_lent(model: mujoco.MjModel) -> Iterator[None]:
    tables: list[Any] = [model.mesh_face, model.mesh_facenormal, model.mesh_facetexcoord, model.mesh_facenum]
    before = [table.copy() for table in tables]
    try:
        yield
    finally:
        for table, kept in zip(tables, before, strict=True):
            table[:] = kept


@contextlib.contextmanager
def only_in_sight(model: mujoco.MjModel, still: Still, camera: Vector) -> Iterator[None]:
    """While a GL context is made of the model, its still parts have only the facets that the camera sees."""
    with _meshes_lent(model):
        for name in still.geoms:
            _kept_first(model, model.geom_dataid[model.geom(name).id], in_sight(model, still, name, camera))
        yield


@contextlib.contextmanager
def coarse(model: mujoco.MjModel, cell: float) -> Iterator[None]:
    """While a GL context is made of the model, the vertices of a mesh in one cube of side `cell`, metres, are one, and
    facets without an area are none."""
    with _meshes_lent(model):
        for mesh in range(model.nmesh):
            start, first = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
            vertices = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
            faces = model.mesh_face[first : first + model.mesh_facenum[mesh]]
            cells = np.floor(vertices / cell).astype(np.int64)
            _, chosen, of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
            faces[:] = chosen[of.ravel()][faces]
            a, b, c = faces.T
            _kept_first(model, mesh, (a != b) & (b != c) & (c != a))
        yield
