"""Every simulated task says which object each pixel shows, and slots are scored against that."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from playslot_rl.config.compose import compose
from playslot_rl.envs import make_env
from playslot_rl.evaluation.held_out import first_seed
from playslot_rl.evaluation.objects import (
    SLOTS_RESULT,
    evaluate_slots,
    score_slots,
    segmented_episode,
    segmented_episodes,
    slots_per_object,
    validation_scores,
)
from playslot_rl.modules.savi import SAVi
from playslot_rl.runs import Run
from playslot_rl.seeds.episodes import episode_seed

OBJECTS = {
    "button_press": {1: "arm", 2: "box"},
    "block_push": {1: "arm", 2: "goal", 3: "cube", 4: "cube", 5: "cube", 6: "cube"},
    "block_push_easy": {1: "arm", 2: "goal", 3: "cube"},
    "block_reach": {1: "arm", 3: "sphere", 4: "sphere", 5: "sphere", 6: "sphere"},
    "block_pick": {1: "arm", 2: "goal", 3: "cube"},
}


@pytest.mark.integration
@pytest.mark.parametrize("name", sorted(OBJECTS))
def test_pixels_are_told_apart_in_every_task(name: str) -> None:
    config = compose([f"env={name}", "preset=compact"])
    env = make_env(config.env, config.render).unwrapped
    try:
        frames, labels = segmented_episode(env, 3, 2)
        plain = [env.reset(seed=3)[0]["pixels"]]
        plain += [env.step(env.expert_action())[0]["pixels"] for _ in range(2)]
    finally:
        env.close()
    assert labels.shape == frames.shape[:3] == (3, 64, 64)
    assert set(np.unique(labels)) - {0} >= set(OBJECTS[name])
    assert (labels == 0).mean() > 0.5, "the ground is most of the picture"
    assert np.array_equal(frames, np.stack(plain)), "segmenting changes no frame"


def test_the_arm_is_where_the_picture_changes() -> None:
    config = compose(["env=button_press", "preset=compact"])
    env = make_env(config.env, config.render).unwrapped
    try:
        frames, labels = segmented_episode(env, 0, 6)
    finally:
        env.close()
    change = np.abs(frames[1:].astype(int) - frames[:-1]).sum(-1)
    arm = (labels[1:] == 1) | (labels[:-1] == 1)
    assert change[arm].mean() > 10 * change[~arm].mean()


def test_slots_per_object_counts_those_with_a_share() -> None:
    truth = np.array([[1] * 20 + [2] * 10 + [0] * 5])
    found = np.array([[0] * 10 + [1] * 9 + [2] + [3] * 10 + [0] * 5])
    assert slots_per_object(truth, found, 4) == 1.5


@pytest.mark.integration
def test_a_shipped_models_slots_are_scored_and_written(tmp_path: Path) -> None:
    config = compose(["env=block_push_easy", "preset=compact", "episodes=1"])
    assert Run.open("pretrained/block_push_easy").load_savi().config.n_slots == 5
    result = evaluate_slots(Run.open("pretrained/block_push_easy"), tmp_path, config, torch.device("cpu"))
    assert json.loads((tmp_path / SLOTS_RESULT).read_text()) == result
    assert result["foreground_ari"] > 0.4
    assert result["psnr"] > 22


@pytest.mark.integration
@pytest.mark.parametrize("name", [*sorted(OBJECTS), "grid_shapes"])
def test_stage_one_is_told_of_every_tasks_segmentation_and_never_of_an_evaluations(name: str) -> None:
    config = compose([f"env={name}", "preset=smoke", "slots.segmented_episodes=2", "env.max_steps=2"])
    scores, savi = validation_scores(config), SAVi(config.model.savi, config.env.image_size)
    assert scores is not None
    found = scores(savi)
    seeds = [episode_seed("development", 0, i) for i in range(2)]
    again = score_slots(savi, segmented_episodes(config, seeds), seeds)
    assert found == {key: again[key] for key in ("foreground_ari", "slots_per_object")}
    assert not set(seeds) & {first_seed(config, 0) + i for i in range(10_000)}


def test_recorded_videos_have_no_segmentation() -> None:
    assert validation_scores(compose(["env=video", "preset=compact"])) is None
    assert validation_scores(compose(["env=button_press", "preset=compact", "slots.segmented_episodes=0"])) is None


def test_a_machine_that_cannot_draw_trains_without(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no EGL display\nand more")

    monkeypatch.setattr("playslot_rl.evaluation.objects.make_env", fail)
    assert validation_scores(compose(["env=button_press", "preset=compact"])) is None
    assert capsys.readouterr().out == (
        "slots: warning: no FG-ARI while training, since button_press cannot be drawn here (no EGL display)\n"
    )
