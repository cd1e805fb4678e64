"""The configuration: every shipped YAML loads, every mistake is one line that names the choices."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from playslot_rl.config import (
    ExperimentConfig,
    ModelConfig,
    SAViConfig,
    SlotsStageConfig,
    fingerprint,
    from_dict,
    to_dict,
)
from playslot_rl.config.baselines import baselines_of
from playslot_rl.config.compose import choices, compose, compose_each
from playslot_rl.config.plain import flatten
from playslot_rl.config.roles import UNSAID, Checked, keys_of, naming, without
from playslot_rl.errors import ConfigError
from playslot_rl.methods.dreamer.method import DreamerConfig

AS_COMPACT = ("resnet_oracle", "caddy_policy", "caddy_oracle")
"""Trained on labels, or on the latents of a model: at `gpu` as at `compact`."""
PRESETS = ["compact", "compact_gpu", "gpu", "paper", "smoke"]
ENVS = [
    "block_pick", "block_push", "block_push_easy", "block_reach", "button_press", "dmc_ball_in_cup_catch",
    "dmc_cartpole_balance", "grid_shapes", "gym", "metaworld", "ogbench", "sketchy", "video",
]  # fmt: skip


def store(config: ExperimentConfig, run: Path) -> Path:
    run.mkdir(parents=True)
    (run / "config.json").write_text(json.dumps(to_dict(config)))
    return run


def test_the_groups_are_the_shipped_ones() -> None:
    assert choices("preset") == PRESETS
    assert choices("env") == ENVS


@pytest.mark.integration
def test_every_shipped_yaml_loads_and_survives_json() -> None:
    for preset, env in itertools.product(PRESETS, ENVS):
        config = compose([f"preset={preset}", f"env={env}"])
        assert (config.preset, config.env.name) == (preset, env)
        assert from_dict(ExperimentConfig, json.loads(json.dumps(to_dict(config)))) == config


def test_the_default_is_compact_button_press() -> None:
    assert compose() == compose(["preset=compact", "env=button_press"])


def test_the_paper_preset_has_the_papers_sizes_and_schedule() -> None:
    config = compose(["preset=paper"])
    assert config.model == ModelConfig()
    assert config.slots.batch_size == config.dynamics.batch_size == config.behaviour.batch_size == 64
    assert (config.slots.optim.lr, config.slots.optim.warmup_steps, config.slots.optim.grad_clip) == (1e-4, 4000, 0.05)
    assert (config.dynamics.optim.lr, config.dynamics.seed_frames, config.dynamics.predicted_frames) == (2e-4, 6, 8)
    assert (config.behaviour.optim.lr, config.behaviour.optim.schedule) == (2e-4, "constant")
    assert config.behaviour.decoder_inputs == "inverse_dynamics"
    assert not config.behaviour.imagined


@pytest.mark.parametrize("env", ["button_press", "block_push", "grid_shapes"])
def test_the_preset_for_a_gpu_sees_as_many_clips_in_larger_batches(env: str) -> None:
    small, large = (compose([f"env={env}", f"preset={preset}"]) for preset in ("compact", "compact_gpu"))
    assert (large.slots.batch_size, large.dynamics.batch_size) == (64, 128)
    for one, other in ((small.slots, large.slots), (small.dynamics, large.dynamics)):
        assert other.steps * other.batch_size == one.steps * one.batch_size
        assert other.optim == dataclasses.replace(
            one.optim, lr=2 * one.optim.lr, warmup_steps=one.optim.warmup_steps // 4
        )
        for every in ("checkpoint_every", "validate_every", "log_every"):
            assert getattr(other, every) == getattr(one, every) // 4
    assert large.dynamics.teacher_steps == small.dynamics.teacher_steps // 4
    assert (large.behaviour, large.model, large.baselines) == (small.behaviour, small.model, small.baselines)
    typed = compose([f"env={env}", "preset=compact_gpu", "slots.steps=7", "dynamics.optim.lr=3"])
    assert (typed.slots.steps, typed.dynamics.optim.lr, typed.slots.batch_size) == (7, 3, 64)


@pytest.mark.parametrize("env", ENVS)
def test_the_preset_of_an_hour_is_compact_of_the_task_made_wider_and_trained_longer(env: str) -> None:
    typed = [f"env={env}", *(["env.task=bin-picking"] if env == "metaworld" else [])]
    small, large = (compose([*typed, f"preset={preset}"]) for preset in ("compact", "gpu"))
    assert large.env == small.env
    assert large.behaviour == small.behaviour  # what a task was found to want
    assert large.dynamics.predicted_frames == small.dynamics.predicted_frames
    for key in ("n_slots", "decoder_position", "transition_start", "initial"):
        assert getattr(large.model.savi, key) == getattr(small.model.savi, key)
    assert large.model.predictor.context == small.model.predictor.context
    assert large.model.savi.slot_dim == 2 * small.model.savi.slot_dim
    assert large.slots.steps * large.slots.batch_size >= 10 * small.slots.steps * small.slots.batch_size
    assert large.slots.start_from == ""  # what ships has other sizes
    assert bool(large.slots.zoom_steps) == bool(small.slots.start_from)
    assert large.data.drawn == (env == "grid_shapes")
    for name, rival in baselines_of(large).items():
        assert dataclasses.asdict(rival) != dataclasses.asdict(getattr(small.baselines, name)) or name in AS_COMPACT


def test_a_run_from_before_compiling_was_left_open_keeps_what_it_says(tmp_path: Path) -> None:
    stored = to_dict(compose(["preset=smoke"]))
    assert stored["slots"]["compile"] is None
    for said in (False, True):
        stored["slots"]["compile"] = said
        run = tmp_path / str(said)
        run.mkdir()
        (run / "config.json").write_text(json.dumps(stored))
        assert compose([f"run={run}"], "train-dynamics").slots.compile is said
        assert compose([f"run={run}", "slots.compile=null"], "train-dynamics").slots.compile is None


def test_a_command_line_value_beats_the_preset() -> None:
    config = compose(["slots.optim.lr=5e-4", "preset=smoke", "env.max_steps=9", "model.savi.encoder_channels=[4,4,4]"])
    assert config.slots.optim.lr == 5e-4
    assert config.env.max_steps == 9
    assert config.model.savi.encoder_channels == (4, 4, 4)
    assert config.slots.steps == compose(["preset=smoke"]).slots.steps


def test_a_task_changes_any_preset_and_a_command_line_value_beats_the_task() -> None:
    for preset in PRESETS:
        latents = compose([f"preset={preset}", "env=grid_shapes"]).model.inverse_dynamics
        assert (latents.variant, latents.n_prototypes, latents.latent_dim) == ("multi", 5, 8)
        assert latents.dim == compose([f"preset={preset}"]).model.inverse_dynamics.dim
    config = compose(["model.savi.n_slots=7", "env=grid_shapes", "model.inverse_dynamics.variant=single"])
    assert (config.model.savi.n_slots, config.model.inverse_dynamics.variant) == (7, "single")


def test_what_a_task_changes_names_a_task_and_a_preset() -> None:
    assert set(choices("env_model")) <= set(ENVS)
    assert set(choices("env_preset")) <= {f"{env}_{preset}" for env in ENVS for preset in PRESETS}


@pytest.mark.parametrize("twice", [("seed=1", "seed=2"), ("preset=paper", "preset=smoke"), ("out=a", "+out=a")])
def test_a_key_is_typed_once(twice: tuple[str, ...]) -> None:
    key = twice[0].partition("=")[0]
    with pytest.raises(ConfigError, match=f"^{key}: got it 2 times, expected it once"):
        compose(["episodes=3", *twice])
    with pytest.raises(ConfigError, match=r"^compare\.seeds: got it 2 times"):
        compose(["seeds=1", "compare.seeds=[2]"], "compare")
    with pytest.raises(ConfigError, match=r"^hydra\.launcher\.n_jobs: got it 2 times"):
        compose(["hydra.launcher=joblib", "hydra.launcher.n_jobs=1", "hydra.launcher.n_jobs=2"], "compare")


@pytest.mark.parametrize(
    "path",
    ["a b/c", "x,y", "k=v", "123", "it's", "(1) [2] {3}", "$HOME", "tail\\", "null-ish", "a/~", "true", "1e5", ""],
)
def test_text_reaches_the_config_as_typed(path: str) -> None:
    assert compose([f"data.root={path}"]).data.root == path


def test_a_folder_in_the_home_folder_may_be_written_with_a_tilde(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/someone")
    config = compose(["out=~/runs", "data.root=~/a,~/b"])
    assert config.out == "/home/someone/runs"
    assert config.data.root == "/home/someone/a,/home/someone/b"


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        (
            "preset=smol",
            "unknown preset 'smol': expected one of compact, compact_gpu, gpu, paper, smoke; did you mean preset=smoke",
        ),
        ("env=kitchen", "unknown env 'kitchen': expected one of .*button_press"),
        ("env.name=kitchen", "unknown env 'kitchen'"),
        ("sed=1", "unknown key sed: expected one of .*did you mean seed"),
        ("slots.lr=1", "unknown key slots.lr: expected one of .*slots.optim"),
        ("slots.optm.lr=1", "did you mean slots.optim.lr"),
        ("reference=slot_bc", "did you mean compare.reference?"),
        ("seed=x", "seed: got 'x' .*expected int"),
        ("seed=-1", "seed: got -1, expected a non-negative integer"),
        ("env.image_size=50", "env.image_size: got 50, expected 32, 64 or 128"),
        ("protocol=dream", "protocol: got 'dream', expected one of simulation, imagination"),
        ("behaviour.labelled_demos=0", "behaviour.labelled_demos: got 0, expected at least 1"),
        ("behaviour.decoder_steps=0", "behaviour.decoder_steps: got 0, expected at least 1"),
        ("behaviour.decoder_lr=-1", "behaviour.decoder_lr: got -1.0, expected above 0"),
        ("behaviour.slot_noise=-1", "behaviour.slot_noise: got -1.0, expected 0"),
        ("model.action_decoder.state_heads=0", "model.action_decoder.state_heads: got 0, expected at least 1"),
        (
            "model.action_decoder.state_dim=10",
            "model.action_decoder.state_dim: got 10, expected a multiple",
        ),
        (
            "model.action_decoder.state_dropout=1.5",
            "model.action_decoder.state_dropout: got 1.5, expected 0",
        ),
        ("model.savi.encoder_channels=[]", r"model.savi.encoder_channels: got \(\), expected at least one width"),
        ("model.savi.decoder_channels=[]", r"model.savi.decoder_channels: got \(\), expected at least one width"),
        ("model.predictor.dim=33", "model.predictor.dim: got 33, expected an even number"),
        (
            "baselines.slotformer.predictor.dim=33",
            "baselines.slotformer.predictor.dim: got 33, expected an even number",
        ),
        ("baselines.dreamer.kernel=2", "baselines.dreamer.kernel: got 2, expected an odd number, 1 to 31"),
        ("baselines.dreamer.mults=[]", r"baselines.dreamer.mults: got \(\), expected at least one"),
        ("baselines.caddy.temperature=[1]", r"baselines.caddy.temperature: got \(1.0,\), expected two numbers"),
        ("slots.optim.lr=nan", r"optim.lr: got nan, expected a finite number, 0 or more \(of slots.optim\)"),
        ("minutes=1e308", "minutes: got 1e\\+308, expected above 0, 525600 at most"),
        ("slots=3", "slots: got 3, expected a group of keys"),
        ("model.savi.encoder_channels=[1,2", "cannot read the arguments"),
        ("seed=1,2", "cannot read the arguments"),
        ("smoke", "got the argument 'smoke', expected key=value"),
        ("~seed=1", "expected key=value"),
        ("=1", "expected key=value"),
    ],
)
def test_a_mistake_is_one_line_that_says_what_was_expected(argument: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        compose([argument])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("command", ["evaluate", "train-dynamics", "train-policy"])
def test_a_run_brings_its_config_and_only_typed_keys_change(tmp_path: Path, command: str) -> None:
    made = compose(["preset=smoke", "seed=3", "episodes=7", "workers=5", "out=elsewhere", "dynamics.steps=11"])
    run = store(made, tmp_path / "run, 1")
    config = compose([f"run={run}", "behaviour.steps=9"], command)
    assert config.out == config.run == str(run)
    assert (config.episodes, config.workers) == (None, 0)
    assert config.behaviour == dataclasses.replace(made.behaviour, steps=9)
    assert (config.preset, config.seed, config.dynamics, config.model) == ("smoke", 3, made.dynamics, made.model)


def test_a_task_of_several_is_seen_as_they_are_unless_it_has_nothing_small(tmp_path: Path) -> None:
    run = store(compose(["preset=smoke", "env=metaworld", "env.task=push+drawer-open"]), tmp_path / "run")
    named = {"push": "near", "push-v3": "near", "push-v3+drawer-open-v3": "near", "drawer-open": ""}
    for task, camera in named.items():
        assert compose([f"run={run}", f"env.task={task}"], "evaluate").env.camera == camera
    assert compose([f"run={run}", "env.task=drawer-open", "env.camera=corner"], "evaluate").env.camera == "corner"


def test_out_stays_apart_from_the_run_where_it_is_typed(tmp_path: Path) -> None:
    run = store(compose(["preset=smoke"]), tmp_path / "run")
    assert compose([f"run={run}", "out=other"], "train-policy").out == "other"


def test_a_run_refuses_another_preset(tmp_path: Path) -> None:
    run = store(compose(["preset=smoke"]), tmp_path / "run")
    assert compose([f"run={run}", "preset=smoke"], "evaluate").preset == "smoke"
    with pytest.raises(ConfigError, match=r"got preset=paper with run=.* made with preset=smoke"):
        compose([f"run={run}", "preset=paper"], "evaluate")


def test_other_commands_do_not_read_the_run(tmp_path: Path) -> None:
    run = store(compose(["preset=smoke"]), tmp_path / "run")
    assert compose([f"run={run}"], "collect").preset == "compact"
    assert compose(["run=pretrained"], "train-policy").preset == "compact"


@pytest.mark.parametrize("content", [None, "{", '{"sed": 1}', "[]"])
def test_a_run_without_a_usable_config_is_refused(tmp_path: Path, content: str | None) -> None:
    if content is not None:
        (tmp_path / "config.json").write_text(content)
    with pytest.raises(ConfigError, match=r"config\.json"):
        compose([f"run={tmp_path}"], "evaluate")


def test_a_config_stored_before_the_collector_had_settings_loads(tmp_path: Path) -> None:
    stored = to_dict(ExperimentConfig())
    del stored["collector"]
    (tmp_path / "config.json").write_text(json.dumps(stored))
    assert compose([f"run={tmp_path}"], "evaluate").collector == ExperimentConfig().collector


@pytest.mark.parametrize(("typed", "port"), [("port=", 0), ("port=0", 0), ("port=8090", 8090)])
def test_an_empty_port_is_any_port(typed: str, port: int) -> None:
    assert compose(["run=pretrained", typed], "play").port == port


def test_equal_configs_have_equal_fingerprints() -> None:
    assert fingerprint(compose(["preset=smoke"])) == fingerprint(compose(["preset=smoke"]))
    assert fingerprint(compose(["preset=smoke"])) != fingerprint(compose(["preset=smoke", "seed=1"]))


def test_a_key_that_came_later_is_said_only_where_it_differs_from_its_default() -> None:
    @dataclasses.dataclass(frozen=True)
    class Own:
        size: int = 1
        later: str = dataclasses.field(default="", metadata=UNSAID)

    @dataclasses.dataclass(frozen=True)
    class Whole:
        own: Own = dataclasses.field(default_factory=Own)
        several: tuple[int, ...] = (1, 2)

    assert to_dict(Whole()) == {"own": {"size": 1}, "several": [1, 2]}
    named = Whole(Own(later="x"))
    assert to_dict(named)["own"] == {"size": 1, "later": "x"}
    assert from_dict(Own, to_dict(named)["own"]) == named.own


def test_the_full_encoder_takes_no_strides() -> None:
    with pytest.raises(ValueError, match=r"encoder_strides: got \(2, 2\), expected strides of 1 with .*encoder=full"):
        SAViConfig(encoder="full", encoder_channels=(8, 8), encoder_strides=(2, 2))
    assert SAViConfig(encoder="strided", encoder_channels=(8, 8), encoder_strides=(2, 1)).encoder == "strided"


def test_roles_say_what_each_key_counts_for() -> None:
    looking = {"checkpoint_every", "validate_every", "log_every"}
    assert keys_of(SlotsStageConfig, "free") == looking | {
        "compile", "execution", "optim.accumulate", "segmented_episodes"
    }  # fmt: skip
    assert keys_of(DreamerConfig, "free") == {
        "minutes", "replay_on_disk", "evaluate_every", "compile_train_step", "cudagraph"
    } | looking - {"validate_every"}  # fmt: skip
    call = {"out", "run", "episodes", "policy", "protocol", "workers", "collector", "device", "export"}
    call |= {"adopt", "minutes", "plan", "play", "port"}
    assert keys_of(ExperimentConfig, "call") == call
    machine = {
        "device",
        "threads",
        "workers",
        "logging",
        "collector",
        "adopt",
        "compare",
        "compare_video",
        "metrics",
        "minutes",
        "plan",
        "preset",
        "out",
        "run",
        "play",
        "port",
    }
    machine |= {key for key in keys_of(ExperimentConfig, "free") if key.endswith(".execution")}
    machine |= {"data.cache_limit", "data.device", "data.workers"}
    named = {"data.root", "data.demos", "data.cache", "behaviour.policy_from"}
    others = ("lapo", "lapo_slots", "laom", "clam", "autoencoder_bc", "inverse_bc", "caddy_policy", "caddy_oracle")
    named |= {f"baselines.{method}.world" for method in others}
    measures = {"data.held_out", "collect.validation_episodes"}
    assert keys_of(ExperimentConfig, "machine") == machine | named | measures
    weights = {"slots.start_from", "baselines.caddy.perceptual", "metrics.lpips_weights", "compare_video.test"}
    weights |= {"compare.runs", "compare.tasks"}
    assert keys_of(ExperimentConfig, "folder") == {"out", "run"} | weights | named


def test_a_config_without_a_role_keeps_all_other_keys() -> None:
    config = ExperimentConfig()
    left, whole = without(config, "machine"), to_dict(config)
    assert whole["data"].keys() - left["data"].keys() == {
        "root",
        "demos",
        "cache",
        "held_out",
        "workers",
        "cache_limit",
        "device",
    }
    assert {**whole["data"], **left["data"]} == whole["data"]
    assert to_dict(config) == whole
    fixed = without(config, "free")
    free = ("compile", "execution", "segmented_episodes")
    kept = {k: v for k, v in whole["slots"].items() if not k.endswith("_every") and k not in free}
    kept["optim"] = {k: v for k, v in kept["optim"].items() if k != "accumulate"}
    assert fixed["slots"] == kept
    assert "minutes" not in fixed["baselines"]["dreamer"]


def test_a_job_is_named_as_before_compiling_was_left_open() -> None:
    config = compose(["dynamics.compile=true"])
    named, whole = naming(config), without(config, "machine")
    assert (whole["slots"]["compile"], named["slots"]["compile"], named["dynamics"]["compile"]) == (None, False, True)
    assert "execution" not in named["slots"]
    changed = {key for key, value in flatten(whole).items() if flatten(named)[key] != value}
    assert changed == {key for key in flatten(whole) if key.endswith(".compile")} - {"dynamics.compile"}


def test_a_config_checks_its_values() -> None:
    with pytest.raises(ValueError, match="transition_heads: got 5, expected a divisor of slot_dim 128"):
        SAViConfig(transition_heads=5)
    with pytest.raises(ValueError, match=r"unknown key nslots.*did you mean n_slots"):
        from_dict(SAViConfig, {"nslots": 3})


def test_a_group_checks_its_ranges_under_its_own_name() -> None:
    def groups(config: object, prefix: str = "") -> Iterator[tuple[str, object]]:
        yield prefix, config
        for field in dataclasses.fields(config):  # type: ignore[arg-type]
            value = getattr(config, field.name)
            if dataclasses.is_dataclass(value):
                yield from groups(value, f"{prefix}{field.name}.")

    checked = {prefix: config for prefix, config in groups(compose()) if isinstance(config, Checked)}
    shared = {
        f"baselines.{method}.model."
        for method in ("autoencoder_bc", "inverse_bc", "lapo", "lapo_slots", "laom", "clam")
    } | {
        f"baselines.{method}.policy."
        for method in ("autoencoder_bc", "inverse_bc", "lapo", "laom", "clam", "caddy_policy", "caddy_oracle")
    }
    assert {prefix: config.group for prefix, config in checked.items()} == {
        prefix: "" if prefix in shared else "optim." if prefix.endswith(".optim.") else prefix for prefix in checked
    }
    assert {"", "env.", "env.grid.", "model.savi.", "dynamics.", "baselines.sold."} <= checked.keys()


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("env.max_steps=1", "env.max_steps: got 1, expected at least 2"),
        ("env.grid.change=1.5", "env.grid.change: got 1.5, expected a probability"),
        ("model.inverse_dynamics.decay=1.0", r"model.inverse_dynamics.decay: got 1.0, expected a number in \(0, 1\)"),
        ("behaviour.steps=0", "behaviour.steps: got 0, expected at least 1"),
        ("baselines.dreamer.sequence=1", r"baselines.dreamer.sequence: got 1, expected 0 \(whole episodes\), or"),
        ("baselines.caddy_policy.shift=17", "baselines.caddy_policy.shift: got 17, expected 0 to 16 pixels"),
        ("baselines.caddy_oracle.policy.steps=0", "steps: got 0, expected at least 1"),
        ("baselines.sold.savi_steps=-1", "baselines.sold.savi_steps: got -1, expected 0 or more"),
        ("compare.seeds=[0,-1]", "compare.seeds: got -1, expected a non-negative integer"),
    ],
)
def test_a_value_outside_its_range_is_refused_by_its_full_name(argument: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{message}"):
        compose([argument])


def test_collect_records_episodes_as_long_as_is_typed() -> None:
    """Elsewhere `env.max_steps` is of evaluation."""
    for env in ("env=metaworld", "env=ogbench", "env=button_press"):
        (config,) = compose_each([env, "env.max_steps=7", "collect.random_steps=9"], "collect")
        assert (config.collect.random_steps, config.collect.expert_steps) == (9, 7)
        assert compose([env, "env.max_steps=7"], "pipeline").collect.expert_steps > 7
