"""The offline baselines from end to end: trained, evaluated, carried on, refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from commands import instead, refused, smoke, weights

from playslot_rl.config import to_dict
from playslot_rl.config.compose import compose

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("thin_resnets")]

FEW = ("lapo", "laom", "caddy_policy")
"""They see the labels of three demonstrations only."""
RESNETS = ("resnet_oracle", "history_bc", "act", "act_state", "diffusion")
METHODS = ("slot_oracle", *RESNETS, "autoencoder_bc", "inverse_bc", *FEW, "caddy_oracle")


def _command(method: str, shared_run: Path, out: Path, *more: object) -> tuple[str, ...]:
    demos, videos = shared_run / "data" / "expert", shared_run / "data" / "random"
    slots = method == "slot_oracle"
    own = (f"run={shared_run}",) if slots else (f"data.root={videos}",)
    still = (f"behaviour.{'trim' if slots else 'trim_pixels'}=0.001",)
    return ("train-baseline", f"method={method}", "preset=smoke", f"data.demos={demos}", f"out={out}", *own, *still,
            *map(str, more))  # fmt: skip


@pytest.fixture(scope="module")
def trained(shared_run: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A run of each method on the first four demonstrations, the stillest rows of their videos left out."""
    runs = {}
    for method in METHODS:
        runs[method] = tmp_path_factory.mktemp("baselines") / method
        done = smoke(*_command(method, shared_run, runs[method], "demos=4"))
        kept = _meta(runs[method], method)["kept_rows"]
        assert f"{method}: 4 demos, {100 * kept:.0f} % of their rows kept" in done.out
    return runs


def _meta(run: Path, stage: str) -> dict[str, Any]:
    values: dict[str, Any] = json.loads((run / stage / "checkpoint" / "meta.json").read_text())
    return values


@pytest.mark.parametrize("method", METHODS)
def test_a_baseline_is_a_run_that_says_what_it_saw(trained: dict[str, Path], method: str) -> None:
    run = trained[method]
    meta = _meta(run, method)
    assert (meta["demos"], meta["labelled_demos"]) == (4, 3 if method in FEW else 4)
    assert json.loads((run / "config.json").read_text())["method"] == method
    assert (run / method / "metrics.jsonl").is_file()
    assert ("pretraining" in meta) == (method in RESNETS)


def test_a_finished_slot_oracle_does_not_ask_for_what_it_has_none_of(
    trained: dict[str, Path], shared_run: Path
) -> None:
    run = trained["slot_oracle"]
    again = _command("slot_oracle", shared_run, run, "demos=4")
    assert "slot_oracle: finished before" in smoke(*again).out
    refused(*again, "behaviour.finetune_steps=7", message="method=slot_oracle, which does not read it", code=2)
    refused(*again, "behaviour.whiten=false", message="behaviour.whiten: got False, expected True")


@pytest.mark.parametrize("method", METHODS)
def test_it_is_evaluated_as_playslot_is(trained: dict[str, Path], shared_run: Path, method: str) -> None:
    run = trained[method]
    done = smoke("evaluate", f"run={run}", "episodes=2")
    info = json.loads((run / "evaluation" / "simulation" / "eval_info.json").read_text())
    playslot = json.loads((shared_run / "evaluation" / "simulation" / "eval_info.json").read_text())
    assert info.keys() - {"pretraining"} == playslot.keys()
    assert info["method"] == method
    assert info["seeds"] == playslot["seeds"]
    for name in ("random", "expert"):
        assert info["references"][name] == playslot["references"][name]
    assert info["references"]["slot_oracle"]["success_rate"] is None
    assert info["fingerprints"][method] == _meta(run, method)["fingerprint"]
    assert "simulation:" in done.out


@pytest.mark.parametrize("method", METHODS)
def test_another_number_of_demonstrations_or_another_seed_is_refused(
    trained: dict[str, Path], shared_run: Path, method: str
) -> None:
    refused(*_command(method, shared_run, trained[method], "demos=3"), message="data: got [0-9a-f]{16}, expected")
    refused(*_command(method, shared_run, trained[method], "demos=4", "seed=1"), message="seed: got 1, expected 0")


@pytest.mark.parametrize("method", METHODS)
def test_a_threshold_that_leaves_nothing_is_refused_before_anything_is_trained(
    shared_run: Path, tmp_path: Path, method: str
) -> None:
    key = "behaviour.trim" if method == "slot_oracle" else "behaviour.trim_pixels"
    refused(*instead(_command(method, shared_run, tmp_path / "x"), f"{key}=1"),
            message=rf"{key}: got 1, which leaves none of \d+ transitions, expected less than")  # fmt: skip
    assert not (tmp_path / "x").exists()


def test_imagination_is_refused(trained: dict[str, Path]) -> None:
    refused("evaluate", f"run={trained['lapo']}", "protocol=imagination",
            message="protocol: got imagination for method=lapo, expected simulation")  # fmt: skip


@pytest.mark.parametrize(
    ("method", "source", "stage"),
    [
        ("lapo", "lapo", "lapo_model"),
        ("caddy_policy", "caddy_oracle", "caddy"),
        ("caddy_oracle", "caddy_policy", "caddy"),
    ],
)
def test_a_model_of_videos_is_taken_from_another_run(
    trained: dict[str, Path], shared_run: Path, tmp_path: Path, method: str, source: str, stage: str
) -> None:
    out, world = tmp_path / "few", f"baselines.{method}.world={trained[source]}"
    smoke(*_command(method, shared_run, out, "demos=3", world))
    assert weights(out, stage) == weights(trained[source], stage)
    assert weights(out, method) != weights(trained[method], method)
    assert not (out / stage / "checkpoints").exists(), "nothing was trained there"
    refused(*_command(method, shared_run, tmp_path / "x", world, "env.image_size=32", "data.resize=true"),
            message="env.image_size: got 32, expected 64, with which .* was trained")  # fmt: skip
    refused(*_command(method, shared_run, tmp_path / "x", f"baselines.{method}.world={shared_run}"),
            message=f"{method}.world=.*: got no .*{stage}/checkpoint, expected a run with .* leave it out")  # fmt: skip
    assert not (tmp_path / "x").exists()


def test_lapos_models_of_other_sizes_are_refused(trained: dict[str, Path], shared_run: Path, tmp_path: Path) -> None:
    refused(*_command("lapo", shared_run, tmp_path / "x", f"baselines.lapo.world={trained['lapo']}",
                      "baselines.lapo.codes=3"), message="lapo.codes: got 3, expected 4")  # fmt: skip


@pytest.mark.parametrize("method", ["svg", "slotformer", "ocvp_seq"])
def test_a_model_of_videos_is_trained_by_itself(shared_run: Path, tmp_path: Path, method: str) -> None:
    videos, out = shared_run / "data" / "random", tmp_path / "run"
    own = ("preset=smoke", f"run={shared_run}") if method != "svg" else ()
    smoke("train-baseline", f"method={method}", f"data.root={videos}", f"out={out}", *own)
    assert _meta(out, method)["steps"] == 4
    rows = [json.loads(line) for line in (out / method / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows if row["split"] == "validation"] == [2, 4]


def test_caddys_methods_find_the_caddy_that_was_trained_into_their_run(shared_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    smoke("train-baseline", "method=caddy", f"data.root={shared_run / 'data' / 'random'}", f"out={out}")
    before = weights(out, "caddy")
    done = smoke(*_command("caddy_oracle", shared_run, out))
    assert "caddy: finished before" in done.out
    assert weights(out, "caddy") == before


def test_a_policy_on_another_caddy_is_refused(trained: dict[str, Path], shared_run: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(trained["caddy_policy"], tmp_path / "run"))
    shutil.rmtree(run / "caddy")
    smoke("train-baseline", "method=caddy", f"data.root={shared_run / 'data' / 'random'}", f"out={run}", "seed=1")
    refused("evaluate", f"run={run}", "method=caddy_policy",
            message="was trained on caddy [0-9a-f]{16}, got caddy [0-9a-f]{16}")  # fmt: skip


def test_playslot_learns_from_the_first_demonstrations(shared_run: Path, demos: Path, tmp_path: Path) -> None:
    few, out = tmp_path / "few", f"out={tmp_path / 'all'}"
    base = (f"run={shared_run}", f"data.demos={demos}", "preset=smoke")
    config = to_dict(compose(["preset=smoke"]))
    assert config["behaviour"]["labelled_demos"] == 3
    smoke("train-baseline", "method=playslot", *base, "demos=4", f"out={few}")
    assert _meta(few, "policy")["demos"] == 4
    smoke("train-baseline", "method=playslot", *base, "data.held_out=2", out)
    assert weights(tmp_path / "all", "policy") == weights(shared_run, "policy"), "as many as the pipeline trained on"
    assert weights(few, "policy") != weights(shared_run, "policy")


@pytest.mark.parametrize("method", ["playslot", "lapo", "caddy_policy"])
def test_more_labels_than_demonstrations_are_refused(shared_run: Path, tmp_path: Path, method: str) -> None:
    command = [*_command(method, shared_run, tmp_path / "new", "demos=2"), f"run={shared_run}"]
    refused(*command, message="behaviour.labelled_demos: got 3, expected at most the 2 demonstrations")
    command = [*_command(method, shared_run, tmp_path / "new", "demos=9"), f"run={shared_run}"]
    refused(*command, message="demos: got 9, expected at most the 8 demonstrations")
    assert not (tmp_path / "new").exists()


def test_bad_arguments_are_refused(shared_run: Path, trained: dict[str, Path], tmp_path: Path) -> None:
    out = f"out={tmp_path / 'new'}"
    demos = f"data.demos={shared_run / 'data' / 'expert'}"
    refused("train-baseline", "method=lapoo", out, message="method: got 'lapoo', expected one of playslot", code=2)
    refused("train-baseline", "method=lapo", demos, message="out: got nothing, expected the folder of the baseline's")
    refused("train-baseline", "method=slot_oracle", demos, out, message="run: got nothing with method=slot_oracle")
    refused("train-baseline", "method=slot_oracle", demos, f"run={shared_run}", f"out={shared_run}", "preset=smoke",
            message="a baseline has a run folder of its own")  # fmt: skip
    refused("train-baseline", "method=lapo", "env=grid_shapes", demos, out, message="without a simulator")
    refused(*_command("resnet_oracle", shared_run, tmp_path / "new", "baselines.resnet_oracle.weights=none.pth"),
            message="weights: got none.pth, expected a file, auto, download or scratch")  # fmt: skip
    assert list(tmp_path.iterdir()) == []


def test_an_oracle_on_other_slots_is_refused(trained: dict[str, Path], videos: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(trained["slot_oracle"], tmp_path / "run"))
    smoke("train-slots", f"out={tmp_path / 'other'}", f"data.root={videos}", "seed=1")
    (run / "world_model.json").write_text(json.dumps({"source": str(tmp_path / "other")}))
    refused("evaluate", f"run={run}", message="was trained on slots [0-9a-f]{16}, got slots [0-9a-f]{16}")
