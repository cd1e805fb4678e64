"""`protocol=slots` scores a run's slots, without a policy; a pipeline's report says the score."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from playslot_rl.config.compose import compose
from playslot_rl.config.env import VariationConfig
from playslot_rl.recipes import evaluate, objects
from playslot_rl.runs import Run
from playslot_rl.runtime.devices import open_device

pytestmark = pytest.mark.integration


def test_slots_are_scored_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("playslot_rl.evaluation.objects.DEFAULT_SCENES", 2)
    Run(tmp_path).build_on(Run.open("pretrained/button_press"))
    config = compose(["preset=smoke", "protocol=slots", "episodes=2"], "evaluate")
    assert open_device(config.device, config.threads).type == "cpu"
    evaluate.main(replace(config, run=str(tmp_path)))
    assert "FG-ARI 0." in capsys.readouterr().out
    stored = json.loads((tmp_path / "evaluation" / "slots" / "eval_info.json").read_text())
    assert (stored["protocol"], stored["episodes"], len(stored["seeds"])) == ("slots", 2, 2)
    objects.score_slots_if_needed(config, Run(tmp_path))
    assert f"scored before, FG-ARI {stored['foreground_ari']:.2f}, skipped" in capsys.readouterr().out
    again = list[bool]()
    monkeypatch.setattr(objects, "score_slots", lambda asked, _: again.append(asked.env.variation.background))
    varied = replace(config.env, variation=VariationConfig(background=True))
    objects.score_slots_if_needed(replace(config, env=varied), Run(tmp_path))
    monkeypatch.setattr("playslot_rl.evaluation.objects.DEFAULT_SCENES", 20)
    objects.score_slots_if_needed(config, Run(tmp_path))
    assert again == [True, False], "of another task, and of more episodes"
