"""Which jobs there are, what each is told, and what is refused before anything is computed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from playslot_rl.config import CompareConfig, EnvConfig, ExperimentConfig, from_dict
from playslot_rl.config.compare import LAUNCHERS
from playslot_rl.config.compose import compose
from playslot_rl.config.methods import METHODS
from playslot_rl.data.demonstrations import split_demonstrations
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.studies.launch import require_launcher
from playslot_rl.studies.study import absolute_roots
from playslot_rl.studies.success import jobs, measure
from playslot_rl.studies.success.jobs import (
    SuccessJob,
    check_demos,
    latent_models,
    success_config,
    success_jobs,
    success_record,
)
from playslot_rl.studies.success.measure import check_success

OUT = Path("out")


def compared(*typed: str) -> ExperimentConfig:
    return compose(["preset=compact", *typed], "compare")


def test_offline_methods_have_a_job_for_each_number_and_seed_and_online_ones_for_each_seed() -> None:
    names = [job.name for job in success_jobs(compared("methods=playslot,lapo,sold", "demos=50,10", "seeds=0,4"), OUT)]
    assert names == [
        "playslot-d10-s0", "lapo-d10-s0", "playslot-d50-s0", "lapo-d50-s0",
        "playslot-d10-s4", "lapo-d10-s4", "playslot-d50-s4", "lapo-d50-s4",
        "sold-s0", "sold-s4",
    ]  # fmt: skip


def test_methods_that_act_may_have_fewer_seeds() -> None:
    typed = ("methods=slot_oracle,sold", "demos=10", "seeds=0,1", "compare.online_seeds=[1]")
    assert [job.name for job in success_jobs(compared(*typed), OUT)] == [
        "slot_oracle-d10-s0",
        "slot_oracle-d10-s1",
        "sold-s1",
    ]
    with pytest.raises(ConfigError, match=r"online_seeds: got .*, expected some of seeds"):
        compared("seeds=0,1", "compare.online_seeds=[2]")


def test_a_job_has_its_own_folder_and_playslot_both_protocols() -> None:
    job = SuccessJob("playslot", 10, 0, OUT)
    assert (job.run, job.file) == (OUT / "runs" / "playslot-d10-s0", OUT / "jobs" / "playslot-d10-s0.json")
    assert (job.stage, job.protocols) == ("policy", ("simulation", "imagination"))
    assert (SuccessJob("lapo", 10, 0, OUT).stage, SuccessJob("lapo", 10, 0, OUT).protocols) == ("lapo", ("simulation",))


@pytest.mark.parametrize(("demos", "labels"), [(10, 10), (50, 50), (150, 50)])
def test_labels_are_the_presets_or_all_there_are(demos: int, labels: int) -> None:
    own = success_config(compared(), SuccessJob("playslot", demos, 2, OUT), "pretrained")
    assert (own.behaviour.labelled_demos, own.demos, own.seed, own.run) == (labels, demos, 2, "pretrained")
    assert not own.behaviour.oracle
    assert not own.evaluation.references


def test_only_methods_on_slots_get_the_world_model() -> None:
    config = compared()
    assert success_config(config, SuccessJob("resnet_oracle", 10, 0, OUT), "world").run == ""
    assert success_config(config, SuccessJob("sold", None, 0, OUT), "world").run == str(Path("world").resolve())


@pytest.mark.parametrize(
    ("method", "folder"),
    [
        ("lapo", "lapo_world"),
        ("lapo_slots", "lapo_slots_world"),
        ("caddy_policy", "caddy_world"),
        ("caddy_oracle", "caddy_world"),
    ],
)
def test_a_model_of_videos_is_made_once_for_all_jobs_that_build_on_it(method: str, folder: str) -> None:
    config = compared(f"methods=slot_oracle,{method}")
    model = METHODS[method].model
    assert model is not None
    assert latent_models(config) == {model.name: method}
    for demos, seed in ((10, 0), (50, 4)):
        own = success_config(config, SuccessJob(method, demos, seed, OUT), "world").baselines
        assert getattr(own, method).world == str((OUT / folder).resolve())
    others = success_config(config, SuccessJob("slot_oracle", 10, 0, OUT), "world").baselines
    assert getattr(others, method).world == ""


def test_caddys_policy_and_oracle_share_one_model() -> None:
    assert latent_models(compared("methods=caddy_policy,caddy_oracle,lapo")).keys() == {"caddy", "lapo_model"}


def test_a_jobs_name_for_its_content_ignores_the_machine_and_nothing_else() -> None:
    config, job = compared(), SuccessJob("playslot", 10, 0, OUT)
    own = success_config(config, job, "pretrained")
    name = success_record(job, own, {"slots": "a"})["fingerprint"]
    assert success_record(job, replace(own, device="cpu", threads=1, workers=3), {"slots": "a"})["fingerprint"] == name
    changed = replace(own, behaviour=replace(own.behaviour, steps=7))
    others = [
        success_record(job, changed, {"slots": "a"}),
        success_record(job, own, {"slots": "b"}),
        success_record(job, replace(own, episodes=3), {"slots": "a"}),
        success_record(job, replace(own, compare=CompareConfig(evaluation_seed=1)), {"slots": "a"}),
    ]
    assert name not in {other["fingerprint"] for other in others}
    record = success_record(job, own, {"slots": "a"})
    assert from_dict(ExperimentConfig, record["config"]) == own


def test_a_methods_settings_are_those_of_its_own_jobs_only() -> None:
    def names(*typed: str) -> list[str]:
        config = compared("methods=playslot,lapo,dreamer", "demos=10", "seeds=0", *typed)
        return [
            success_record(job, success_config(config, job, ""), {})["fingerprint"] for job in success_jobs(config, OUT)
        ]

    playslot, lapo, dreamer = names()
    assert names("baselines.dreamer.minutes=5")[:2] == [playslot, lapo]
    assert names("baselines.dreamer.minutes=5")[2] != dreamer
    assert names("baselines.lapo.groups=2")[::2] == [playslot, dreamer]
    assert names("baselines.lapo.groups=2")[1] != lapo


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        (["env=grid_shapes"], "env=grid_shapes: got an environment without a simulator"),
        (["env=block_reach", "env.blocks.reward=sparse", "methods=dreamer"], "got sparse with method=dreamer"),
        (["baselines.resnet_oracle.weights=none.pt"], "weights: got none.pt, expected a file, auto"),
    ],
)
def test_what_cannot_be_compared_is_refused(typed: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check_success(compared(*typed))


def test_a_launcher_that_is_not_installed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LAUNCHERS, "ray", "a_module_that_is_not_installed")
    require_launcher("")
    with pytest.raises(ConfigError, match="got ray, expected an installed launcher: install it by"):
        require_launcher("ray")


def test_a_sparse_reward_is_no_hindrance_to_methods_that_do_not_act() -> None:
    check_success(compared("env=block_reach", "env.blocks.reward=sparse", "methods=resnet_oracle,lapo"))


def test_the_shipped_world_model_of_another_task_is_refused() -> None:
    check_success(compared("run=pretrained"))
    with pytest.raises(CheckpointError, match="got a world model of env=button_press, expected env=block_reach"):
        check_success(compared("run=pretrained", "env=block_reach"))


@pytest.mark.parametrize(
    ("trained", "its", "another", "message"),
    [
        (
            EnvConfig("metaworld", task="reach+push", camera="near"), "env.task=push", "env.task=door-open",
            r"got a world model of env=metaworld env\.task=reach\+push, expected .* env\.task=door-open",
        ),
        (
            EnvConfig("gym", id="FetchReach-v4"), "env.id=FetchReach-v4", "env.id=FetchPush-v4",
            r"model of env=gym env\.id=FetchReach-v4, expected .*=FetchPush-v4",
        ),
    ],
)  # fmt: skip
def test_a_world_model_is_of_its_tasks_alone(
    trained: EnvConfig, its: str, another: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = SimpleNamespace(group=lambda *_: trained)
    monkeypatch.setattr(measure.Run, "open", lambda _: SimpleNamespace(stage=lambda _: checkpoint))
    monkeypatch.setattr(measure, "require_config", lambda *_: None)
    given = [f"env={trained.name}", "run=trained", "methods=playslot", "data.demos=demos"]
    check_success(compared(*given, its))
    with pytest.raises(CheckpointError, match=message):
        check_success(compared(*given, another))


def test_too_few_demonstrations_are_refused() -> None:
    check_demos(compared("demos=10,20"), 20, "data.demos=x")
    with pytest.raises(ConfigError, match=r"demos: got 20, expected at most the 19 demonstrations of data\.demos=x"):
        check_demos(compared("demos=10,20"), 19, "data.demos=x")


def test_roots_are_absolute_but_for_addresses_and_weights_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert absolute_roots("a:2,hf://datasets/u/n@main") == f"{tmp_path / 'a'}:2,hf://datasets/u/n@main:1"


SETS = {
    "as it is": (160, ()),
    "held out by hand": (160, ("data.held_out=10",)),
    "all of both": (160, ("data.held_out=10", "collect.validation_episodes=10")),
    "fewer held out than measured": (160, ("data.held_out=4",)),
    "a preset's own": (5_000, ("env=block_push", "data.held_out=200")),
    "twenty episodes": (20, ("data.held_out=10",)),
    "recorded": (160, ("data.demos=out/data/expert", "data.held_out=10", "out=out")),
    "few recorded": (15, ("data.demos=out/data/expert", "data.held_out=10", "out=out")),
}


def demonstrations(episodes: int) -> EpisodeFrames:
    frames, one = np.zeros((2 * episodes, 4, 4, 3), np.uint8), np.arange(episodes)
    return EpisodeFrames(frames, 2 * one, np.full(episodes, 2), None, one, "f", 10.0, "", "c")


def built_on(episodes: int, typed: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    monkeypatch.setattr(jobs, "open_videos", lambda *_: demonstrations(episodes))
    where = () if any(pair.startswith("data.demos=") for pair in typed) else ("data.demos=expert",)
    config = compared("methods=resnet_oracle", "demos=5", *where, *typed)
    return jobs.Shared(config).parents(SuccessJob("resnet_oracle", 5, 0, OUT))


@pytest.mark.parametrize("name", SETS)
def test_jobs_of_the_presets_draw_are_the_jobs_they_were(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    episodes, typed = SETS[name]
    assert built_on(episodes, typed, monkeypatch).keys() == {"demos"}


@pytest.mark.parametrize(
    ("episodes", "typed"),
    [
        (160, ("data.held_out=30",)),
        (160, ("collect.validation_episodes=30",)),
        (160, ("collect.validation_episodes=4",)),
        (15, ("data.held_out=10",)),
    ],
)
def test_jobs_of_another_draw_are_other_jobs(
    episodes: int, typed: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They learn from other demonstrations of the same seed, so that none is taken for the other's."""
    usual, other = (compared("data.demos=expert", *more) for more in ((), typed))
    draws = [
        split_demonstrations(demonstrations(episodes), 3, c.data.held_out, c.collect.validation_episodes, 0).trained
        for c in (usual, other)
    ]
    assert draws[0].fingerprint != draws[1].fingerprint
    prints = [built_on(episodes, more, monkeypatch) for more in ((), typed)]
    assert prints[0] != prints[1]
    job = SuccessJob("resnet_oracle", 5, 0, OUT)
    first, second = (success_record(job, success_config(usual, job, ""), one)["fingerprint"] for one in prints)
    assert first != second


def test_equal_draws_by_other_keys_are_one_job(monkeypatch: pytest.MonkeyPatch) -> None:
    two = [built_on(160, (f"{key}=30",), monkeypatch) for key in ("data.held_out", "collect.validation_episodes")]
    assert two[0] == two[1]


def test_demonstrations_of_several_sets_are_counted_together(monkeypatch: pytest.MonkeyPatch) -> None:
    held = {"a": 3, "b": 4}
    monkeypatch.setattr(jobs, "open_files", lambda root: SimpleNamespace(episodes=range(held[root])))
    monkeypatch.setattr(jobs, "open_videos", lambda *_: demonstrations(7))
    monkeypatch.setattr(EpisodeFrames, "require_actions", lambda *_: None)
    config = compared("methods=playslot", "data.demos=a,b", "demos=7", "data.held_out=0")
    jobs.check_data(config)
    with pytest.raises(ConfigError, match=r"demos: got 8, expected at most the 7 demonstrations of data\.demos=a,b"):
        jobs.check_data(replace(config, compare=replace(config.compare, demos=(8,))))
    job = SuccessJob("playslot", 5, 0, OUT)
    assert success_config(config, job, "").data.demos == absolute_roots("a,b") != "a,b"
