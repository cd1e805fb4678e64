"""`playslot compare-video`: every method in one table, resumed, and refused in one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import contents, instead, playslot, refused, run_jobs_here, smoke

from playslot_rl.config.compare_video import title_of, video_methods
from playslot_rl.config.compose import compose
from playslot_rl.studies.launch import sweep_command
from playslot_rl.studies.video.jobs import VideoJob, in_steps, video_config

pytestmark = pytest.mark.integration

METHODS = ",".join(video_methods())


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A comparison of all methods on ButtonPress, from nothing."""
    out = tmp_path_factory.mktemp("video") / "out"
    with pytest.MonkeyPatch.context() as patch:
        run_jobs_here(patch)
        smoke("compare-video", "env=button_press", f"methods={METHODS}", f"out={out}")
    return out


def result(out: Path) -> dict[str, Any]:
    values: dict[str, Any] = json.loads((out / "video.json").read_text())
    return values


def test_every_method_has_its_row_for_each_number_of_seed_frames(finished: Path) -> None:
    found = result(finished)
    plain = {(row["title"], row["seed_frames"]) for row in found["summary"] if not row["row"]}
    references = {"last seed frame, repeated", "SAVi's reconstruction of the true frames"}
    assert plain == {(title, shown) for title in {*map(title_of, video_methods()), *references} for shown in (2, 1)}
    for row in found["summary"]:
        assert len(row["psnr_steps"]) == 3
        low, high = row["psnr_ci95"]
        assert low <= row["psnr"] <= high
        assert row["lpips"] is None


def test_what_puts_a_number_in_its_place_stands_beside_it(finished: Path) -> None:
    rows = {(row["method"], row["row"]) for row in result(finished)["summary"]}
    shuffled = {method for method, row in rows if row == "latents of another clip"}
    assert shuffled == {"svg", "caddy", "playslot", "playslot_m"}
    assert ("svg", "latents drawn from the prior") in rows
    assert ("caddy", "actions alone, v = 0") in rows


def test_what_a_model_was_told_of_the_future_is_a_column(finished: Path) -> None:
    told = {row["method"]: row["sees"] for row in result(finished)["summary"] if not row["row"]}
    assert {told[name] for name in ("slotformer", "ocvp_seq")} == {"nothing"}
    assert {told[name] for name in ("svg", "caddy", "playslot", "playslot_m")} == {"latents of the true future"}


def test_a_training_says_what_it_cost_and_whether_it_was_done(finished: Path) -> None:
    page = (finished / "video.md").read_text()
    assert "**After the preset's steps**, and SAVi's" in page
    assert "| training | parameters | steps | time | with SAVi's |" in page
    assert "Every job is of one kind of processor" in page
    for job in result(finished)["jobs"]:
        assert job["status"] == "done"
        assert job["parameters"] > 0
        rates = [trial["rate"] for trial in job["tried"]]
        assert rates == sorted(rates)
        assert {1.0, 3.0} < set(rates), "with two of them the best one is at an edge"
        assert job["at_edge"] == (job["rate"] in (rates[0], rates[-1]))
        assert ("at the edge of those tried" in page) >= job["at_edge"]
        assert job["rate"] == max(job["tried"], key=lambda trial: trial["psnr"])["rate"]
        assert job["validation_psnr"] is not None


def test_page_plot_and_sheets_are_there(finished: Path) -> None:
    page = (finished / "video.md").read_text()
    assert "| SVG-LP |" in page
    assert "LPIPS: not available, AlexNet's weights are not at hand" in page
    assert "| PSNR after 2, dB | SSIM after 2 | PSNR after 1, dB | SSIM after 1 | told of the true future |" in page
    for name in ("video.png", "video.svg", "frames_2.png", "frames_1.png"):
        assert (finished / name).stat().st_size > 1000


def test_all_models_predict_the_same_clips(finished: Path) -> None:
    references = json.loads((finished / "references.json").read_text())
    assert len(set(references["clips"])) == 2  # after two frames and after one
    shapes = set()
    for file in sorted(finished.glob("runs/*/video.npz")):
        with np.load(file) as stored:
            shapes.add(stored["frames_2"].shape)
        assert json.loads(file.with_suffix(".json").read_text())["clips"] == references["clips"]
    assert shapes == {(2, 3, 64, 64, 3)}


def test_the_same_command_trains_nothing_again_and_gives_the_same_numbers(finished: Path) -> None:
    before = result(finished)
    done = smoke("compare-video", "env=button_press", f"methods={METHODS}", f"out={finished}")
    assert done.out.count("done before, skipped") == len(video_methods())
    assert result(finished)["summary"] == before["summary"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            "compare_video.trial_steps=3",
            r"compare_video\.trial_steps: got 3, expected 2, .*/rate_1 was begun",
        ),
        ("compare_video.trained_frames=1", r"compare_video\.trained_frames: got 1, expected 2, with which "),
    ],
)
def test_other_trials_and_clips_are_refused_by_the_name_that_was_typed(
    finished: Path, change: str, message: str
) -> None:
    before = contents(finished / "trials")
    command = ("compare-video", "env=button_press", f"methods={METHODS}", f"out={finished}", "compare_video.shown=[1]")
    refused(*command, change, message=message)
    assert contents(finished / "trials") == before


@pytest.mark.usefixtures("started")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("baselines.svg.kl_weight=0.5", "baselines.svg.kl_weight: got 0.5, expected "),
        (
            "compare_video.rates=[1.0]",
            "compare_video.rates: got [1.0], which leads to a rate of 1, expected ",
        ),
    ],
)
def test_a_setting_of_a_training_is_refused_as_it_is_typed(
    finished: Path, tmp_path: Path, change: str, message: str
) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    command = ("compare-video", "env=button_press", "preset=smoke", "methods=svg", f"out={out}", "threads=1")
    done = playslot(*command, "device=cpu", change)
    assert "1 of 1 trainings failed (svg-s0)" in done.err
    error = result(out)["jobs"][0]["error"]
    assert error.startswith(message), error


@pytest.mark.usefixtures("started")
def test_a_method_that_fails_leaves_a_row_that_says_so(finished: Path, tmp_path: Path) -> None:
    """A learning rate that blows up ends one training, not the others; and one of several, that trial alone."""
    data = f"{finished}/data/random"
    done = playslot(
        "compare-video", "env=button_press", "preset=smoke", f"data.root={data}", "methods=svg,slotformer",
        f"run={finished}/world_model", "baselines.svg.optim.lr=1e30", "compare_video.rates=[1.0,1e30]",
        f"out={tmp_path / 'out'}", "threads=1", "device=cpu",
    )  # fmt: skip
    assert done.code == 1
    assert "1 of 2 trainings failed (svg-s0)" in done.err
    jobs = {job["name"]: job for job in result(tmp_path / "out")["jobs"]}
    assert {name: job["status"] for name, job in jobs.items()} == {"svg-s0": "failed", "slotformer-s0": "done"}
    assert jobs["slotformer-s0"]["rate"] == 1
    tried = {trial["rate"]: trial["psnr"] for trial in jobs["slotformer-s0"]["tried"]}
    assert (tried[1.0] is None, tried[1e30]) == (False, None)
    page = (tmp_path / "out" / "video.md").read_text()
    assert "**svg-s0: failed.**" in page
    assert "1e+30: failed" in page


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("methods=dreamer",), r"compare_video\.methods: got 'dreamer', expected one of playslot, svg, caddy"),
        (("methods=svg,svg",), r"compare_video\.methods: .*each one once"),
        (("seeds=-1",), r"compare_video\.seeds: got -1, expected a non-negative"),
        (("compare_video.predicted=0",), r"compare_video\.predicted: got 0, expected at least 1"),
        (
            ("compare_video.shown=[4]",),
            r"compare_video\.shown: got \(4,\), expected fewer than a training clip's 4 frames",
        ),
        (("vary=model.inverse_dynamics.mode",), r"compare_video\.values: got \(\), expected vary=SETTING and values="),
    ],
)
def test_what_cannot_be_asked_is_refused(tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    refused("compare-video", "preset=smoke", f"out={tmp_path / 'out'}", *arguments, message=message, code=2)
    assert not (tmp_path / "out").exists()


def test_clips_that_do_not_fit_are_refused_before_anything_is_trained(finished: Path, tmp_path: Path) -> None:
    data, out = f"data.root={finished}/data/random", tmp_path / "out"
    for change, message in (
        ("compare_video.predicted=30", "got episodes of at most 7 frames .* expected at least one of 32"),
        ("compare_video.trained_frames=30", "got episodes of at most 7 frames .* expected at least one of 32"),
        ("compare_video.tested=0.9", "expected at least 4, two of them to train on"),
    ):
        refused("compare-video", "preset=smoke", data, "methods=svg", change, f"out={out}", message=message)
        assert not out.exists()


@pytest.mark.usefixtures("started")
@pytest.mark.slow
def test_a_setting_of_playslot_is_varied_on_two_kinds_of_clips(finished: Path, tmp_path: Path) -> None:
    """Action representation in one command; real actions count as what they are."""
    out, data, other = tmp_path / "out", finished / "data", tmp_path / "random"
    smoke("collect", "policy=random", "env=button_press", "seed=77", f"out={other}")
    smoke(
        "compare-video", "preset=smoke", "env=button_press", f"run={finished}/world_model", "methods=playslot",
        f"data.root={data}/random", f"compare_video.test='{data}/test/expert,{other}'",
        "vary=model.inverse_dynamics.mode", "values=discrete,ground_truth", "compare_video.rates=[1.0]", f"out={out}",
    )  # fmt: skip
    rows = [row for row in result(out)["summary"] if row["method"] and row["seed_frames"] == 2]
    assert {(row["title"], row["row"], row["clips_of"]) for row in rows} == {
        (f"PlaySlot, mode={mode}", row, clips)
        for mode, shuffled in (("discrete", "latents of another clip"), ("ground_truth", "actions of another clip"))
        for row in ("", shuffled)
        for clips in ("expert", "random")
    }
    modes = {name: json.loads((out / "runs" / name / "config.json").read_text()) for name in
             ("playslot-mode-discrete-s0", "playslot-mode-ground_truth-s0")}  # fmt: skip
    assert [stored["model"]["inverse_dynamics"]["mode"] for stored in modes.values()] == ["discrete", "ground_truth"]
    assert all((out / f"frames_{clips}_2.png").is_file() for clips in ("expert", "random"))


def test_the_command_line_of_a_launcher_takes_every_name() -> None:
    """Hydra's grammar has its own `=`, commas and brackets."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    jobs = [
        VideoJob("playslot", 3, Path("/tmp"), variant)
        for variant in ("mode=hybrid", "n_prototypes=8", "residual=false", "image_weight=1e-3", "decoded_frames=0")
    ]
    command = sweep_command([job.file for job in jobs], "joblib", ())
    job = next(part for part in command if part.startswith("+job="))
    (parsed,) = OverridesParser.create().parse_overrides([job])
    assert list(parsed.sweep_string_iterator()) == [job.name for job in jobs]


@pytest.mark.usefixtures("started")
@pytest.mark.slow
def test_numbers_of_objects_have_one_table(tmp_path: Path) -> None:
    out = tmp_path / "out"
    smoke(
        "compare-video", "env=grid_shapes", "methods=playslot,playslot_m,svg", "objects=1,2",
        "collect.learn_from_demos=true",  # as all larger presets have it
        "compare_video.rates=[1.0]", f"out={out}",
    )  # fmt: skip
    found = result(out)["objects"]
    assert list(found) == ["1", "2"]
    for number, part in found.items():
        run = json.loads((out / f"objects_{number}" / "runs" / "playslot-s0" / "config.json").read_text())
        assert run["env"]["action_dim"] == 2 * int(number)
        assert {row["method"] for row in part["summary"]} == {None, "playslot", "playslot_m", "svg"}
    variants = [
        json.loads((out / "objects_2" / "runs" / f"{name}-s0" / "config.json").read_text())["model"]["inverse_dynamics"]
        for name in ("playslot", "playslot_m")
    ]
    assert [variant["variant"] for variant in variants] == ["single", "multi"]
    assert "| PlaySlot (InvDyn_M) |" in (out / "video.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("vary=model.nothing", "values=1"), r"vary: got 'model.nothing', expected a setting under model\.inverse_dyn"),
        (("vary=model.savi.n_slots", "values=1,2"), r"vary: got 'model.savi.n_slots', expected a setting under"),
        (
            ("vary=dynamics.predicted_frames", "values=3,4"),
            "values: got 3 for dynamics.predicted_frames",
        ),
        (("vary=model.predictor.context", "values=99"), "values: got 99 for model.predictor.context, expected what"),
        (("vary=dynamics.steps", "values=3", "compare_video.budget_minutes=1"), "vary: got dynamics.steps with"),
        (("vary=dynamics.steps", "values=3", "methods=svg"), "vary: got methods=svg, expected playslot"),
        (("env.image_size=32", "methods=svg"), r"env\.image_size: got 32, expected 64, .*leave out method svg"),
        (("env.image_size=32", "methods=ocvp_seq", "run=pretrained"), "env.image_size.*64"),
        (("metrics.lpips_weights=nowhere.safetensors",), r"metrics\.lpips_weights=nowhere\.safetensors: got .*No such"),
        (("env=video",), "data.root: got nothing with env=video"),
        (("vary=model.inverse_dynamics.mode", "values=loud"), "values: got 'loud' for model.inverse_dynamics.mode"),
        (("objects=1,2",), "objects: got a task or videos with a number of objects of their own"),
    ],
)
def test_what_cannot_be_varied_is_refused(tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    out = tmp_path / "out"
    first = ("compare-video", "env=button_press", "methods=playslot", f"out={out}")
    refused(*instead(first, *arguments), message=message)
    assert not out.exists()


def test_a_test_on_what_is_trained_on_is_refused(finished: Path, tmp_path: Path) -> None:
    data, other = finished / "data" / "random", tmp_path / "random"
    shutil.copytree(data, other)
    for tests, message in (
        (str(data), "got videos of data.root, which models are trained on"),
        (str(other), "got videos of data.root, which models are trained on"),
        (f"'{data},{other}'", "got folders of one name"),
        (str(tmp_path / "nothing"), r"compare_video\.test"),
    ):
        refused(
            "compare-video", "preset=smoke", "methods=svg", f"data.root={data}", f"compare_video.test={tests}",
            f"out={tmp_path / 'out'}", message=message,
        )  # fmt: skip
        assert not (tmp_path / "out").exists()


def test_a_trial_is_the_training_in_small() -> None:
    config = compose(["preset=compact", "env=button_press"])
    small = in_steps(config, "playslot", 150).dynamics
    assert small.steps == 150
    assert small.teacher_steps / small.steps == pytest.approx(config.dynamics.teacher_steps / config.dynamics.steps)
    assert in_steps(config, "playslot", config.dynamics.steps) == config
    caddy = in_steps(config, "caddy", 2).baselines.caddy
    assert (caddy.warmup_steps, caddy.anneal_steps, caddy.growth_steps) == (1, 2, 1)
    assert in_steps(config, "svg", 100).baselines.svg.optim.warmup_steps < config.baselines.svg.optim.warmup_steps


@pytest.mark.usefixtures("started")
def test_seeds_share_the_trials_whichever_comes_first(finished: Path, tmp_path: Path) -> None:
    tried = {}
    for seeds in ("0,1", "1"):
        out = tmp_path / seeds
        smoke(
            "compare-video", "env=button_press", "preset=smoke", f"data.root={finished}/data/random",
            "methods=slotformer",
            f"run={finished}/world_model", f"seeds={seeds}", f"out={out}",
        )  # fmt: skip
        assert [path.name for path in (out / "trials").iterdir()] == ["slotformer"]
        jobs = result(out)["jobs"]
        assert [job["seed"] for job in jobs] == [int(seed) for seed in seeds.split(",")]
        tried[seeds] = [[(trial["rate"], trial["psnr"]) for trial in job["tried"]] for job in jobs]
    assert tried["0,1"] == tried["1"] * 2


def test_clips_are_drawn_alike() -> None:
    config = compose(["preset=compact", "env=button_press"], "compare-video")
    assert config.dynamics.from_start > 0
    job = video_config(config, VideoJob("playslot", 0, Path("out")), "pretrained")
    assert job.dynamics.from_start == 0


def test_no_predictor_attends_to_more_frames_than_its_training_clips_show(finished: Path) -> None:
    for name in ("playslot-s0", "playslot_m-s0", "slotformer-s0", "ocvp_seq-s0"):
        stored = json.loads((finished / "runs" / name / "config.json").read_text())
        method = name.removesuffix("-s0")
        at = stored["model"] if method.startswith("playslot") else stored["baselines"][method]
        assert at["predictor"]["context"] == 3


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_two_trainings_of_two_processes_each_run_side_by_side(finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ["compare-video", "env=button_press", "preset=smoke", f"data.root={finished}/data/random",
               "methods=slotformer,playslot", f"run={finished}/world_model", f"out={out}", "threads=1", "device=cpu",
               "processes=2"]  # fmt: skip
    done = playslot(*command, "hydra.launcher=joblib", "hydra.launcher.n_jobs=2")
    assert (done.code, done.err) == (0, ""), (out / "jobs" / "launcher.log").read_text()
    assert {job["status"] for job in result(out)["jobs"]} == {"done"}
    alone = tmp_path / "alone"
    given = ("processes=2", "threads=1", "device=cpu")  # `smoke` gives the last two
    smoke(*(word.replace(str(out), str(alone)) for word in command if word not in given))
    for one, two in zip(result(alone)["summary"], result(out)["summary"], strict=True):
        assert one["title"] == two["title"]
        assert one["psnr"] == pytest.approx(two["psnr"], abs=1e-3)
