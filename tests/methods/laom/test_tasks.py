"""LAOM and CLAM over every task that has a simulator, and the sizes of every preset."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from stages import on_few_videos

from playslot_rl import keys
from playslot_rl.config import plugins
from playslot_rl.config.compose import compose
from playslot_rl.config.methods import METHODS
from playslot_rl.methods.clam.model import Forward, Inverse
from playslot_rl.methods.laom.model import LatentActions
from playslot_rl.methods.lapo.model import LAPOPolicy
from playslot_rl.recipes import train_baseline
from playslot_rl.runs import Run

TASKS = ("button_press", "block_push_easy", "block_push", "block_reach", "block_pick")
PRESETS = ("smoke", "compact", "compact_gpu", "gpu", "paper")


@pytest.fixture(autouse=True)
def _few_videos() -> Iterator[None]:
    with on_few_videos():
        yield


@pytest.mark.integration
@pytest.mark.parametrize("method", ["laom", "clam"])
@pytest.mark.parametrize("task", TASKS)
def test_it_is_trained_on_every_task_and_acts(task: str, method: str, tmp_path: Path) -> None:
    typed = [
        "preset=smoke", f"env={task}", f"method={method}", "data.root=videos", "device=cpu", "logging.backend=none",
        f"out={tmp_path / 'run'}", "behaviour.trim_pixels=0", f"data.cache={tmp_path / 'cache'}",
    ]  # fmt: skip
    train_baseline.main(compose(typed))
    actor = plugins.call(METHODS[method].load.actor, Run(tmp_path / "run"), "cpu")
    frames = torch.randint(256, (2, 3, 64, 64), dtype=torch.uint8)
    action = actor(actor.reset([0, 1]).set(keys.PIXELS, frames))[keys.ACTION]
    assert action.shape == (2, 4)
    assert bool((action.abs() <= 1).all())


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("task", TASKS)
def test_the_sizes_of_every_preset_fit_together(task: str, preset: str) -> None:
    config = compose([f"env={task}", f"preset={preset}"])
    size, laom, clam = config.env.image_size, config.baselines.laom, config.baselines.clam
    with torch.device("meta"):
        frames = torch.empty(2, 3, 3, size, size)
        model = LatentActions(laom, size, config.env.action_dim)
        z = model(frames[:, ::2])
        assert z.shape == LAPOPolicy(laom, size)(frames[:, 0]).shape == (2, laom.latent_dim)
        assert model.change(model.features(frames[:, 0]), z).shape == (2, model.features.width)
        z = Inverse(clam, size)(frames)
        assert z.shape == LAPOPolicy(clam, size)(frames[:, 0]).shape == (2, clam.latent_dim)
        assert Forward(clam)(frames[:, :2], z).shape == frames[:, 0].shape
