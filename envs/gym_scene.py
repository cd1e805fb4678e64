"""MuJoCo's scene of a registered Gymnasium environment, and the camera that looks at it: `env.camera`."""

from __future__ import annotations

from typing import Any, Final

import gymnasium as gym
import numpy as np

from playslot_rl.config.plain import nearest
from playslot_rl.envs.rendering import Camera, import_mujoco
from playslot_rl.errors import ConfigError

NUMBERS: Final = "distance,azimuth,elevation,x,y,z"


class Scene:
    """An environment's model and data as they are now, since some make them anew in `reset`; None where it has none."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self.core: Any = env.unwrapped
        self.close = env.close

    @property
    def model(self) -> Any:
        """MuJoCo's."""
        return getattr(self.core, "model", None)

    @property
    def data(self) -> Any:
        """MuJoCo's."""
        return getattr(self.core, "data", None)


def view(env: Any, model: Any, camera: str) -> tuple[Any, bool]:
    """What a `FrameRenderer` looks through, and whether it is at rest: a camera of the model by its name, or number
    where it has none, a free one by its numbers, or with no words the one that the environment itself draws with.
    """
    mj = import_mujoco()
    names: list[str] = [model.camera(i).name for i in range(model.ncam)]
    if not camera:
        holders = (env, *vars(env).values())
        own = next((h.mujoco_renderer for h in holders if hasattr(h, "mujoco_renderer")), None)
        number = getattr(own, "camera_id", -1)
        if number is None or number < 0:
            return _free(mj, model, env, getattr(own, "default_cam_config", None) or {}), True
    elif camera in names:
        number = names.index(camera)
    else:
        return _typed(camera, names), True
    fixed = model.cam_mode[number] == mj.mjtCamLight.mjCAMLIGHT_FIXED
    return names[number] or int(number), bool(fixed and model.cam_bodyid[number] == 0)


def distance_seen(model: Any, camera: Any) -> float:
    """Metres from what is seen to where it is seen from: a free camera's own, else about so many."""
    return float(getattr(camera, "distance", model.stat.extent / 2))


def _typed(camera: str, names: list[str]) -> Camera:
    """A free camera by its numbers; a ConfigError where these are none."""
    try:
        distance, azimuth, elevation, x, y, z = numbers = [float(part) for part in camera.split(",")]
        if not np.isfinite(numbers).all() or distance <= 0:
            raise ValueError
    except ValueError:
        hint = nearest(camera, names, "env.camera=")
        known = ", ".join(filter(None, names)) or "no names"
        raise ConfigError(
            f"env.camera: got {camera!r}, expected {NUMBERS} (finite, distance above 0) or one of {known}{hint}"
        ) from None
    return Camera(distance, azimuth, elevation, (x, y, z))


def _free(mj: Any, model: Any, env: Any, settings: dict[str, Any]) -> Any:
    """Gymnasium's free camera: it looks at the middle of the geoms from as far as the scene is wide, or as it says."""
    view = mj.MjvCamera()
    view.lookat[:] = np.median(env.data.geom_xpos, axis=0)
    view.distance = model.stat.extent
    for name, value in settings.items():
        if isinstance(value, np.ndarray):
            getattr(view, name)[:] = value
        else:
            setattr(view, name, value)
    view.type, view.fixedcamid = mj.mjtCamera.mjCAMERA_FREE, -1
    return view
