"""The online loop on a toy: what is played and learned when, restarts, faults."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from online_toy import STEPS, ToyLearner, ToyPool, ToyTask, interrupt, same, toy_online, train, weights
from PIL import Image
from tensordict import TensorDict
from torch import Tensor

from playslot_rl import keys
from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.errors import CheckpointError, TrainingError
from playslot_rl.methods.online import loop
from playslot_rl.methods.online.acting import PlayedEpisodes, play
from playslot_rl.methods.online.players import Round, play_round
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.visualization.charts import draw_curve


@pytest.fixture(autouse=True)
def _toy_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "TaskPool", ToyPool)


def test_an_action_is_stored_with_the_frame_that_it_led_to() -> None:
    pool: Any = ToyPool(EnvConfig(max_steps=STEPS), RenderConfig())
    learner = ToyLearner()
    learner.net.eval()
    played = play(pool, [5, 6], learner, torch.device("cpu"), torch.Generator().manual_seed(0), explore=True)
    frames = played.frames
    assert frames.batch_size == (2, STEPS + 1)
    assert (frames[keys.ACTION][:, 0] == 0).all()
    assert (frames[keys.REWARD][:, 0] == 0).all()
    moved = 0.5 * frames[keys.ACTION][:, 1:, 0].clamp(-1, 1).double()
    place = torch.tensor([[float(np.random.default_rng(s).uniform(-0.5, 0.5))] for s in (5, 6)]).double()
    expected = place + moved.cumsum(1)
    assert torch.allclose(frames[keys.REWARD][:, 1:, 0].double(), expected, atol=1e-5)
    shown = frames[keys.PIXELS][:, 1:, 0, 0, 0].double()
    assert ((shown - (128 + 40 * expected).clamp(0, 255)).abs() <= 1).all()
    assert np.allclose(played.returns, expected.sum(1), atol=1e-4)
    assert played.successes == tuple((expected > 1).any(1).tolist())
    assert frames[keys.IS_FIRST].squeeze(-1).sum(1).tolist() == [1, 1]
    assert frames[keys.IS_LAST][:, -1].all()


def test_random_actions_are_a_function_of_the_episode_alone() -> None:
    pool: Any = ToyPool(EnvConfig(max_steps=STEPS), RenderConfig())
    device, generator = torch.device("cpu"), torch.Generator()
    pair = play(pool, [5, 6], None, device, generator, random=True)
    alone = play(pool, [6], None, device, generator, random=True)
    assert torch.equal(pair.frames[1][keys.ACTION], alone.frames[0][keys.ACTION])
    assert pair.frames[keys.ACTION].abs().max() <= 1


def test_updates_keep_their_ratio_to_steps_and_wait_for_the_random_start(tmp_path: Path) -> None:
    learner, result = train(tmp_path)
    assert result.state.step == 64
    assert result.state.episodes == 64 // STEPS
    # The first call gives one update, then one for two steps after it.
    assert result.state.updates == 1 + (64 - 8) // 2
    assert len(learner.batches) == result.state.updates
    rows = [json.loads(line) for line in (tmp_path / "toy" / "metrics.jsonl").read_text().splitlines()]
    assert min(row["step"] for row in rows if row["split"] == "train") == 8


@pytest.mark.parametrize("prefill", [8, 12, 16])
def test_rounds_are_random_until_the_first_update_and_no_longer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, prefill: int
) -> None:
    order: list[str] = []
    update = ToyLearner.update

    def played(pool: Any, learner: Any, device: Any, wanted: Round) -> PlayedEpisodes:
        order.append("random" if wanted.random else "own")
        return play_round(pool, learner, device, wanted)

    def learned(self: ToyLearner, batch: TensorDict, generators: StepGenerators) -> Mapping[str, Tensor]:
        order.append("update")
        return update(self, batch, generators)

    monkeypatch.setattr(loop, "play_round", played)
    monkeypatch.setattr(ToyLearner, "update", learned)
    train(tmp_path, steps=24, prefill=prefill)
    first = order.index("update")
    assert set(order[:first]) == {"random"}
    assert "random" not in order[first:]


def test_a_replay_on_the_disk_lies_in_the_stage_s_folder_while_it_trains_and_draws_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: list[int] = []
    ring, original = tmp_path / "disk" / "toy" / "ring", ToyLearner.update

    def watched(self: ToyLearner, batch: TensorDict, generators: StepGenerators) -> Mapping[str, Tensor]:
        sizes.append(sum(path.stat().st_size for path in ring.rglob("*")))
        return original(self, batch, generators)

    here, _ = train(tmp_path / "here")
    ring.mkdir(parents=True)
    (ring / "pixels.memmap").write_bytes(b"of a kill")
    with monkeypatch.context() as patch:
        patch.setattr(ToyLearner, "update", watched)
        there, _ = train(tmp_path / "disk", replay_on_disk=True)
    assert min(sizes) > 40 * 3 * 8 * 8  # of all the frames that it may hold
    assert same(weights(here), weights(there))
    assert not ring.exists()


def test_the_curve_has_a_row_for_each_interval_and_the_random_policy(tmp_path: Path) -> None:
    _, result = train(tmp_path)
    curve = json.loads((tmp_path / "toy" / "curve.json").read_text())
    assert [row["env_steps"] for row in curve["rows"]] == [16, 32, 48, 64]
    assert curve["first_seed"] == 4_000_000_000
    assert curve["random"] == result.state.random
    for row in curve["rows"]:
        assert {"updates", "seconds", "return_mean", "return_error", "success_rate", "ci95"} <= row.keys()


def test_a_task_without_success_has_none_on_its_curve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ToyTask, "solves", False, raising=False)
    train(tmp_path, steps=16)
    curve = json.loads((tmp_path / "toy" / "curve.json").read_text())
    for row in (curve["random"], *curve["rows"]):
        assert (row["success_rate"], row["ci95"]) == (None, None)
        assert row["return_mean"] != 0
    assert "success" not in (tmp_path / "toy" / "metrics.jsonl").read_text()
    draw_curve(tmp_path / "toy", "dreamer")
    height, width = np.asarray(Image.open(tmp_path / "toy" / "curve_light.png")).shape[:2]
    assert width < 1.5 * height  # one panel


def test_a_backend_sees_steps_that_never_go_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[int, str]] = []

    class Backend:
        def log(self, values: Mapping[str, float], step: int) -> None:
            seen.extend((step, name) for name in values)

        def close(self) -> None:
            pass

    monkeypatch.setattr("playslot_rl.training.logging.open_logger", lambda *_: Backend())
    train(tmp_path, steps=32)
    steps = [step for step, _ in seen]
    assert steps == sorted(steps)
    assert {name for _, name in seen} >= {"toy/train/loss", "toy/validation/return_mean"}


@pytest.mark.integration
@pytest.mark.parametrize("at, resumed", [(0, 0), (13, 32), (22, 48)])
def test_a_run_that_was_interrupted_ends_with_the_weights_of_one_that_was_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: int, resumed: int
) -> None:
    whole, one = train(tmp_path / "whole")
    interrupt(monkeypatch, at, tmp_path / "broken", "toy interrupted; the same command carries on from")
    broken, other = train(tmp_path / "broken")
    assert same(weights(whole), weights(broken))
    assert other.resumed_from == resumed
    strip = [{k: v for k, v in row.items() if k != "seconds"} for row in one.state.curve]
    assert strip == [{k: v for k, v in row.items() if k != "seconds"} for row in other.state.curve]
    kept = [
        [(row["step"], row["split"], row.get("loss")) for row in map(json.loads, path.read_text().splitlines())]
        for path in (tmp_path / "whole" / "toy" / "metrics.jsonl", tmp_path / "broken" / "toy" / "metrics.jsonl")
    ]
    assert kept[0] == kept[1]


@pytest.mark.integration
def test_a_resumed_run_whose_ring_had_turned_draws_the_same_sequences(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, _ = train(tmp_path / "whole", steps=96, capacity=15, sequence=4)
    original = ToyLearner.update

    def pressed(self: ToyLearner, batch: TensorDict, generators: StepGenerators) -> Mapping[str, Tensor]:
        if generators.step == 38:
            raise KeyboardInterrupt
        return original(self, batch, generators)

    with monkeypatch.context() as patch:
        patch.setattr(ToyLearner, "update", pressed)
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path / "two", steps=96, capacity=15, sequence=4)
    second, result = train(tmp_path / "two", steps=96, capacity=15, sequence=4)
    assert (result.resumed_from, result.state.step) == (80, 96)
    assert same(weights(whole), weights(second))
    # 15 frames are 3 episodes: older files are gone.
    assert sorted(path.stem for path in (tmp_path / "two" / "toy" / "replay").iterdir()) == ["00000016", "00000020"]


def test_a_finished_run_does_nothing_more(tmp_path: Path) -> None:
    first, _ = train(tmp_path)
    again, result = train(tmp_path)
    assert result.resumed_from == result.state.step == 64
    assert not again.batches
    assert same(weights(first), weights(again))


def test_a_budget_of_minutes_ends_the_run_with_a_checkpoint_and_a_point(tmp_path: Path) -> None:
    _, result = train(tmp_path, minutes=1e-9)
    assert result.state.step == 8
    assert [row["env_steps"] for row in result.state.curve] == [8]
    assert (tmp_path / "toy" / "checkpoints" / "step_00000008" / "state.json").is_file()


def test_a_loss_that_is_not_finite_stops_with_the_last_good_checkpoint(tmp_path: Path) -> None:
    with pytest.raises(
        TrainingError, match=r"toy: loss is nan at update 15, .* last good checkpoint is .*step_00000032"
    ):
        train(tmp_path, ToyLearner(nan_at=14))
    assert sorted(path.name for path in (tmp_path / "toy" / "checkpoints").iterdir()) == [
        "step_00000016",
        "step_00000032",
    ]


def test_a_run_begun_with_other_values_is_refused(tmp_path: Path) -> None:
    train(tmp_path)
    with pytest.raises(CheckpointError, match=r"baselines\.dreamer\.batch_size: got 5, expected 3"):
        train(tmp_path, batch_size=5)


def test_a_run_from_before_rewards_were_scaled_had_a_scale_of_one(tmp_path: Path) -> None:
    train(tmp_path, minutes=1e-9)
    state = next(iter(sorted((tmp_path / "toy" / "checkpoints").glob("step_*")))) / "state.json"
    stored = json.loads(state.read_text())
    assert stored["identity"]["toy"].pop("reward_scale") == 1.0
    state.write_text(json.dumps(stored))
    with pytest.raises(CheckpointError, match=r"baselines\.dreamer\.reward_scale: got 2\.0, expected 1\.0"):
        train(tmp_path, reward_scale=2.0)
    _, result = train(tmp_path)
    assert (result.resumed_from, result.state.step) == (8, 64)


def test_a_missing_file_of_the_journal_is_named(tmp_path: Path) -> None:
    train(tmp_path, minutes=1e-9)
    shutil.rmtree(tmp_path / "toy" / "replay")
    with pytest.raises(CheckpointError, match="replay: got episodes up to 0, expected 2"):
        train(tmp_path)


def test_values_out_of_range_are_refused() -> None:
    for change, message in (
        ({"update_ratio": 0.0}, "update_ratio"),
        ({"sequence": 1}, "sequence"),
        ({"reward_scale": 0.0}, "reward_scale"),
        ({"prefill": 100}, "prefill"),
    ):
        with pytest.raises(ValueError, match=message):
            toy_online(**change)
