"""Labels are part of what LAOM's and CLAM's models are: another draw, or another number, is another model."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from stages import on_few_videos

from playslot_rl.config.compose import compose
from playslot_rl.config.methods import METHODS
from playslot_rl.errors import CheckpointError
from playslot_rl.recipes import train_baseline
from playslot_rl.runs import Run
from playslot_rl.studies.success.jobs import latent_models, success_config, success_jobs, success_record
from playslot_rl.training.record import StageRecord

SHARED = ("preset=smoke", "env=button_press", "data.root=videos", "data.demos=demos", "device=cpu")
SUPERVISED = ("laom", "clam")
OUT = Path("out")


@pytest.fixture(autouse=True)
def _few_videos() -> Iterator[None]:
    with on_few_videos():
        yield


@pytest.mark.parametrize("method", SUPERVISED)
def test_a_model_is_identified_by_the_labels_of_the_draw_and_not_by_the_other_demonstrations(method: str) -> None:
    spec = METHODS[method].model
    assert spec is not None

    def identity(*typed: str) -> dict[str, Any]:
        return StageRecord(spec, OUT, compose([*SHARED, f"method={method}", *typed])).resumes()

    plain = identity("demos=5", "behaviour.labelled_demos=2", "data.draw=0")
    assert identity("demos=6", "behaviour.labelled_demos=2", "data.draw=0") == plain
    found = [
        identity("demos=5", f"behaviour.labelled_demos={labels}", f"data.draw={draw}")["behaviour.labelled_demos"]
        for labels in (2, 3)
        for draw in (0, 1)
    ]
    assert len(set(found)) == 4
    assert plain["behaviour.labelled_demos"] == found[0]


def test_without_weight_labels_are_not_read() -> None:
    spec = METHODS["laom"].model
    assert spec is not None
    first, second = (
        StageRecord(spec, OUT, compose([*SHARED, "baselines.laom.label_weight=0", f"behaviour.labelled_demos={n}"]))
        for n in (2, 3)
    )
    assert first.labelled is None
    assert first.resumes() == second.resumes()
    assert "behaviour.labelled_demos" not in first.resumes()


@pytest.mark.parametrize("method", SUPERVISED)
def test_every_job_of_a_comparison_trains_its_own_model(method: str) -> None:
    config = compose(["preset=compact", f"methods={method},lapo", "demos=100", "labels=5,25", "seeds=0,1"], "compare")
    own = [job for job in success_jobs(config, OUT) if job.method == method]
    assert [job.policy_of for job in own] == [None] * 4
    assert latent_models(config).keys() == {"lapo_model"}
    configs = [success_config(config, job, "") for job in own]
    assert {getattr(found.baselines, method).world for found in configs} == {""}
    assert [(found.behaviour.labelled_demos, found.data.draw) for found in configs] == [
        (5, 0),
        (25, 0),
        (5, 1),
        (25, 1),
    ]
    records = [success_record(job, found, {"demos": "a"}) for job, found in zip(own, configs, strict=True)]
    assert len({record["fingerprint"] for record in records}) == 4


def test_without_weight_the_model_and_the_policy_are_made_once() -> None:
    typed = ("methods=laom", "demos=100", "labels=5,25", "seeds=0", "baselines.laom.label_weight=0")
    config = compose(["preset=compact", *typed], "compare")
    first, second = success_jobs(config, OUT)
    assert (first.policy_of, second.policy_of) == (None, 5)
    assert latent_models(config) == {"laom_model": "laom"}
    assert success_config(config, second, "").baselines.laom.world == str((OUT / "laom_world").resolve())


@pytest.mark.integration
@pytest.mark.parametrize("method", SUPERVISED)
def test_a_model_of_other_labels_is_refused(method: str, tmp_path: Path) -> None:
    def train(out: str, *typed: str) -> None:
        shared = (*SHARED, f"data.cache={tmp_path / 'cache'}", "logging.backend=none", f"method={method}")
        train_baseline.main(compose([*shared, f"out={tmp_path / out}", "demos=4", *typed]))

    train("run", "behaviour.labelled_demos=3")
    model = METHODS[method].model
    assert model is not None
    assert Run(tmp_path / "run").own(model.name).meta["labelled"].startswith("3 (")
    refused = "behaviour.labelled_demos: got {} .*, expected 3 .* was trained with: use another out="
    with pytest.raises(CheckpointError, match=refused.format(2)) as caught:
        train("run", "behaviour.labelled_demos=2")
    assert "\n" not in str(caught.value)
    with pytest.raises(CheckpointError, match=refused.format(3)):
        train("run", "behaviour.labelled_demos=3", "data.draw=4")
    world = f"baselines.{method}.world={tmp_path / 'run'}"
    with pytest.raises(CheckpointError, match=r"world=.*: got .* of the labels 3 .*, expected 2 .*: leave it out"):
        train("other", "behaviour.labelled_demos=2", world)
    train("same", "behaviour.labelled_demos=3", world)
    assert Run(tmp_path / "same").own(model.name).fingerprint == Run(tmp_path / "run").own(model.name).fingerprint
