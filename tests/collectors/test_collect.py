"""Collections: what they hold, and what they refuse."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_sets import STEPS, config, small, spec_of

from playslot_rl import keys
from playslot_rl.collectors import collect
from playslot_rl.collectors.collection import begun_episodes
from playslot_rl.collectors.journal import CollectionSpec, Journal, journal_path
from playslot_rl.config import ExperimentConfig, from_dict
from playslot_rl.errors import ConfigError, DataError, OutputError

pytestmark = pytest.mark.integration


def load(root: Path) -> Any:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("anything/at_all", root=root)


def frames_of(root: Path) -> np.ndarray:
    dataset = load(root)
    return np.stack([dataset[i][keys.FEATURE_IMAGE].numpy() for i in range(len(dataset))])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two random episodes, with a copy of the journal they came from beside them."""
    folder = tmp_path_factory.mktemp("made")
    out = folder / "data"
    from playslot_rl.collectors.episodes import record

    spec = spec_of(2)
    journal = Journal(journal_path(out), spec)
    for episode in record(spec, [0, 1]):
        journal.add(episode)
    shutil.copytree(journal.folder, folder / "journal_copy")
    return small(out)


def restore(made: Path, out: Path) -> None:
    """A complete journal that has not been exported."""
    shutil.copytree(made.parent / "journal_copy", journal_path(out))


def test_data_set_opens_in_lerobot_with_the_recorded_frames(made: Path) -> None:
    dataset = load(made)
    journal = Journal(made.parent / "journal_copy", spec_of(2))
    assert (dataset.num_episodes, len(dataset), dataset.fps) == (2, 2 * (STEPS + 1), 16)
    for e in range(2):
        episode = journal.read(e)
        items = [dataset[e * (STEPS + 1) + t] for t in range(STEPS + 1)]
        images = np.stack([np.rint(i[keys.FEATURE_IMAGE].numpy() * 255).transpose(1, 2, 0) for i in items])
        np.testing.assert_array_equal(images, episode.frames)
        np.testing.assert_array_equal(np.stack([i[keys.FEATURE_ACTION] for i in items[:-1]]), episode.actions)
        assert not items[-1][keys.FEATURE_ACTION].any()
        assert [bool(i[keys.FEATURE_LAST]) for i in items] == [False] * STEPS + [True]
        assert [bool(i[keys.FEATURE_DONE]) for i in items] == [False] * (STEPS - 1) + [True, True]
        assert {int(i[keys.FEATURE_SEED]) for i in items} == {e}


def test_record_names_seeds_success_and_versions(made: Path) -> None:
    record = json.loads((made / "meta" / "playslot.json").read_text())
    assert [e["seed"] for e in record["episodes"]] == [0, 1]
    assert record["success_rate"] == 0.0
    assert record["versions"]["mujoco"] == "3.3.0"
    assert record["spec"]["env"]["max_steps"] == STEPS


def test_recorded_episode_is_the_environments_own(made: Path) -> None:
    from playslot_rl.envs import make_env

    journal = Journal(made.parent / "journal_copy", spec_of(2))
    episode = journal.read(1)
    env = make_env(journal.spec.env, journal.spec.render)
    frames = [env.reset(seed=1)[0]["pixels"]] + [env.step(a)[0]["pixels"] for a in episode.actions]
    np.testing.assert_array_equal(np.stack(frames), episode.frames)
    env.close()


def test_finished_collection_is_skipped_and_its_journal_removed(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (made / "meta" / "info.json").stat().st_mtime_ns
    restore(made, made)
    small(made, logging={"progress": True})
    assert "nothing to do" in capsys.readouterr().err
    assert (made / "meta" / "info.json").stat().st_mtime_ns == before
    assert not journal_path(made).exists()


def test_only_missing_episodes_are_recorded(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from playslot_rl.collectors import recording

    out = tmp_path / "data"
    restore(made, out)
    next(journal_path(out).glob("episode_000001*")).unlink()
    asked: list[list[int]] = []
    original = recording.record

    def spy(spec: CollectionSpec, indices: list[int]) -> Any:
        asked.append(list(indices))
        return original(spec, indices)

    monkeypatch.setattr(recording, "record", spy)
    small(out)
    assert asked == [[1]]
    np.testing.assert_array_equal(frames_of(out), frames_of(made))


def test_expert_succeeds_and_noise_changes_its_actions(tmp_path: Path) -> None:
    clean = collect(config(), "expert", 1, 20, tmp_path / "clean", seed=0, workers=1)
    noisy = collect(config(collect={"noise": 0.3}), "expert", 1, 20, tmp_path / "noisy", seed=0, workers=1)
    record = json.loads((clean / "meta" / "playslot.json").read_text())
    assert record["success_rate"] == 1.0
    assert 5 < record["episodes"][0]["steps_to_success"] <= 20
    assert record["episodes"][0]["seed"] == 500_000
    assert not np.allclose(load(clean)[0][keys.FEATURE_ACTION], load(noisy)[0][keys.FEATURE_ACTION])


def test_episodes_that_start_solved_are_redrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    from playslot_rl.collectors.episodes import SeededView
    from playslot_rl.envs import make_env

    spec = spec_of(1)
    env = make_env(spec.env, spec.render)
    original = type(env.unwrapped).reset

    def reset(self: Any, *, seed: int | None = None, options: Any = None) -> Any:
        observation, _ = original(self, seed=seed, options=options)
        return observation, {"success": seed == 0}

    monkeypatch.setattr(type(env.unwrapped), "reset", reset)
    observation, _ = SeededView(env, [(0, 0)]).reset()
    assert (int(observation["episode_seed"][0]), int(observation["redrawn"][0])) == (10**12, 1)
    env.close()


@pytest.mark.parametrize("shown", [np.zeros(3, np.float32), np.full(4, np.nan, np.float32)])
def test_an_experts_action_that_is_none_is_one_line(monkeypatch: pytest.MonkeyPatch, shown: Any) -> None:
    from playslot_rl.collectors.episodes import SeededView
    from playslot_rl.envs import make_env

    spec = spec_of(1)
    env = make_env(spec.env, spec.render)
    monkeypatch.setattr(type(env.unwrapped), "expert_action", lambda _: shown)
    with pytest.raises(ConfigError, match=r"from the task's expert_action, expected \(4,\) finite numbers"):
        SeededView(env, [(0, 0)]).reset()
    env.close()


def test_any_seed_is_taken_and_its_data_are_whole(tmp_path: Path) -> None:
    from playslot_rl.evaluation.held_out import recorded_seeds

    seed = 2**32 - 1
    out = collect(config(), "random", 2, STEPS, tmp_path / "data", seed=seed, workers=1)
    spec = CollectionSpec.make(config(), "random", 2, STEPS, seed)
    assert recorded_seeds(out) == {spec.episode_seed(0), spec.episode_seed(1)}
    dataset = load(out)
    assert [int(dataset[i][keys.FEATURE_SEED]) for i in (0, STEPS + 1)] == [spec.episode_seed(0), spec.episode_seed(1)]
    assert small(tmp_path / "zero") != out
    assert (frames_of(out) != frames_of(tmp_path / "zero")).any()


def test_video_storage_keeps_colours(made: Path, tmp_path: Path) -> None:
    out = small(tmp_path / "video", collect={"storage": "video"})
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("anything/at_all", root=out, video_backend="pyav")
    stored = np.stack([dataset[i][keys.FEATURE_IMAGE].numpy() for i in range(len(dataset))])
    assert np.abs(stored - frames_of(made)).mean() * 255 < 2.0


# --- refusals -------------------------------------------------------------------------------------------------------


def test_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="something else"):
        small(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_other_settings_are_refused_by_name(made: Path, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="episodes: got 2, expected 3"):
        small(made, episodes=3)
    out = tmp_path / "data"
    restore(made, out)
    with pytest.raises(OutputError, match=r"env\.warmup_steps: got 1, expected 2"):
        small(out, env={"image_size": 32, "warmup_steps": 2})


def test_episodes_of_a_collection_are_known_from_its_data_set_and_from_its_journal(made: Path, tmp_path: Path) -> None:
    assert begun_episodes(made) == 2
    assert begun_episodes(tmp_path / "data") is None
    restore(made, tmp_path / "data")
    assert begun_episodes(tmp_path / "data") == 2


def test_foreign_journal_folder_is_refused(tmp_path: Path) -> None:
    journal_path(tmp_path / "data").mkdir()
    (journal_path(tmp_path / "data") / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="something else"):
        small(tmp_path / "data")


def test_damaged_data_set_is_refused(made: Path, tmp_path: Path) -> None:
    out = tmp_path / "data"
    shutil.copytree(made, out)
    (out / "meta" / "info.json").write_text('{"total_episodes": 1, "total_frames": 4}')
    with pytest.raises(DataError, match="delete it and collect again"):
        small(out)


def test_frame_that_was_stored_wrongly_is_noticed(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from playslot_rl.collectors.image_set import ImageSetWriter

    original = ImageSetWriter.add

    def swapped(self: Any, values: Any, frames: Any, images: list[bytes], *task: str) -> None:
        original(self, values, frames, [images[0], images[2], images[1], *images[3:]], *task)

    out = tmp_path / "data"
    restore(made, out)
    monkeypatch.setattr(ImageSetWriter, "add", swapped)
    with pytest.raises(OutputError, match="got another row 1 of episode 0 than was recorded"):
        small(out)
    assert not out.exists()


def test_damaged_journal_file_is_named(made: Path, tmp_path: Path) -> None:
    out = tmp_path / "data"
    restore(made, out)
    (journal_path(out) / "episode_000000.npz").write_bytes(b"PK torn")
    with pytest.raises(OutputError, match=r"episode_000000\.npz: got a damaged file"):
        small(out)
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("expret", 1, 3, 0), "did you mean policy=expert"),
        (("expert", 0, 3, 0), "episodes: got 0"),
        (("expert", 1, 1, 0), "steps: got 1"),
        (("expert", 1, 3, -1), "seed: got -1, expected 0 to 4294967295"),
        (("expert", 1, 3, 2**33), "seed: got 8589934592, expected 0 to 4294967295"),
    ],
)
def test_bad_requests_are_refused(arguments: tuple[str, int, int, int], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        CollectionSpec.make(config(), *arguments)


@pytest.mark.parametrize(
    "changes",
    [
        {"action_dim": 9},
        {"name": "block_push", "action_dim": 9},
        {"name": "grid_shapes", "action_dim": 9},
        {"name": "grid_shapes", "action_dim": 4, "grid": {"size": 100}},
    ],
)
def test_a_refused_request_leaves_nothing(changes: dict[str, Any], tmp_path: Path) -> None:
    wanted = from_dict(ExperimentConfig, {"env": changes, "logging": {"progress": False}})
    with pytest.raises(ConfigError, match=r"env\.(action_dim|grid.size): got (9|100), expected"):
        collect(wanted, "random", 1, 3, tmp_path / "data", seed=0, workers=1)
    assert list(tmp_path.iterdir()) == []


def test_a_request_refused_by_the_environment_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from playslot_rl.collectors import recording

    def refuse(*_: object) -> Any:
        raise ConfigError("env: got what only the simulator knows, expected another")

    monkeypatch.setattr(recording, "record_into", refuse)
    with pytest.raises(ConfigError, match="only the simulator knows"):
        small(tmp_path / "data")
    assert list(tmp_path.iterdir()) == []
