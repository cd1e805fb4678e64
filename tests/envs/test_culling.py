"""What is left out of a frame cannot be seen in it."""

import mujoco
import numpy as np
import pytest

from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.envs.culling import FrustumCuller
from playslot_rl.envs.metaworld import MetaWorldEnv
from playslot_rl.envs.rendering import Camera, FrameRenderer

pytestmark = pytest.mark.integration

SCENE = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="plane" type="plane" size="1 1 .1"/>
    <geom name="ahead" type="sphere" size=".1" pos="0 0 .3"/>
    <geom name="behind" type="sphere" size=".1" pos="4 0 .3"/>
    <geom name="beside" type="sphere" size=".1" pos="0 3 .3"/>
    <geom name="edge" type="sphere" size=".2" pos="0 0.93 .3"/>
  </worldbody>
</mujoco>
"""
NAMES = ("plane", "ahead", "behind", "beside", "edge")


def test_geoms_behind_and_beside_the_camera_are_unseen_and_one_across_the_edge_is_seen() -> None:
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = FrameRenderer(model, Camera(2.0, 180.0, 0.0, (0.0, 0.0, 0.3)), 64, RenderConfig())
    try:
        culler = renderer._culler
        assert culler is not None
        unseen = dict(zip(NAMES, culler.unseen(data), strict=True))
        before = model.geom_group.copy()
        renderer(data)
    finally:
        renderer.close()
    assert unseen == {"plane": False, "ahead": False, "behind": True, "beside": True, "edge": False}
    np.testing.assert_array_equal(model.geom_group, before)


def test_frames_of_button_press_are_the_same_with_and_without_culling(monkeypatch: pytest.MonkeyPatch) -> None:
    env = MetaWorldEnv(EnvConfig(warmup_steps=3))
    hidden = []
    try:
        for seed in range(4):
            env.reset(seed=seed)
            for action in np.random.default_rng(seed).uniform(-1, 1, (3, 4)).astype(np.float32):
                culled = env.step(action)[0]["pixels"]
                culler = env._renderer._culler
                assert culler is not None
                hidden.append(culler.unseen(env._simulation.data).sum())
                with monkeypatch.context() as patch:
                    patch.setattr(FrustumCuller, "hide", lambda self, data: None)
                    np.testing.assert_array_equal(env.draw(), culled)
    finally:
        env.close()
    assert min(hidden) > 3
