"""The report of a run: whole, partial and broken."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch

from playslot_rl.acting.episodes import TaskPool
from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.errors import ConfigError
from playslot_rl.evaluation.card_lines import line
from playslot_rl.testing import tiny_config
from playslot_rl.visualization.charts import loss_names
from playslot_rl.visualization.document import Document, Missing, Section, Table, Text, to_html, to_markdown
from playslot_rl.visualization.report import notes, read_metas, settings_section, write_report
from playslot_rl.visualization.sections import ReportInput, slots_section, success_section
from playslot_rl.world_model import Agent, WorldModel

REFERENCES = {
    "random": {"success_rate": 0.0, "ci95": [0.0, 0.071]},
    "expert": {"success_rate": 1.0, "ci95": [0.93, 1.0], "mean_steps_to_success": 14.5},
    "slot_oracle": {"success_rate": None, "ci95": None},
}


class _Page(HTMLParser):
    """Open tags, addresses and pictures without alternative text."""

    VOID = ("meta", "img", "source", "br")

    def __init__(self) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.addresses: list[str] = []
        self.silent = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.addresses += [str(values[k]) for k in ("src", "srcset", "href") if k in values]
        self.silent += tag == "img" and not values.get("alt")
        if tag not in self.VOID:
            self.stack.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.stack.pop() == tag


def _check_page(text: str) -> None:
    page = _Page()
    page.feed(text)
    assert page.stack == []
    assert page.silent == 0
    assert page.addresses
    assert all(a.startswith(("data:image/png;base64,", "#")) for a in page.addresses)
    style = text[text.index("<style>") : text.index("</style>")]
    assert "url(" not in style
    assert "@import" not in style


def _run(folder: Path, config: ExperimentConfig) -> Path:
    run = folder / "run"
    for protocol, rate in (("simulation", 0.98), ("imagination", 0.5)):
        result = {"protocol": protocol, "episodes": 50, "seeds": list(range(10**9, 10**9 + 50)), "success_rate": rate}
        result |= {"ci95": [0.4, 0.99], "mean_steps_to_success": None, "references": REFERENCES, "seed": 0}
        path = run / "evaluation" / protocol / "eval_info.json"
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps(result))
    for stage in ("slots", "policy"):
        (run / stage / "checkpoint").mkdir(parents=True)
        meta = {
            "steps": 5,
            "seconds": 3.0,
            "metrics": {"psnr": 20.0},
            "demos": 9,
            "labelled_demos": 4,
            "kept_rows": 0.41,
        }
        (run / stage / "checkpoint" / "meta.json").write_text(json.dumps(meta))
        rows = [{"step": s, "split": "train", "loss": 1 / (s + 1)} for s in range(5)]
        (run / stage / "metrics.jsonl").write_text("\n".join(map(json.dumps, rows)) + '\n{"step": 5, "lo')
    (run / "config.json").write_text(json.dumps(to_dict(config)))
    return run


def _card(run: Path) -> None:
    """A stored card, of a code that was chosen and one that was not."""
    details = {
        "code_counts": [3, 0],
        "code_actions": [
            {"code": 2, "count": 3, "mean": [0.5], "std": [0.1]},
            {"code": 1, "count": 0, "mean": None, "std": None},
        ],
        "probes": {"latent": {"linear": {"r2": [0.3, None]}, "mlp": {"r2": [0.4, None]}}},
        "telling_slots": [{"slot": 1, "change": 0.8, "r2": 0.7}],
        "prototypes": [{"code": 2, "slot": 3, "pixels": [3.0, -1.0], "spread": 0.5}],
    }
    metas = read_metas(run)
    card = {
        "lines": [line("perplexity", 0.5).plain(), line("linear_probe", 0.3).plain(), line("replay", 0.9).plain()],
        "details": details,
        "fingerprints": {stage: metas.get(stage, {}).get("fingerprint") for stage in ("slots", "dynamics")},
        "episodes_tested": [3],
        "held_out_known": True,
        "held_out": "held out",
        "data": "videos",
        "episodes_fitted": 3,
    }
    (run / "inspect").mkdir()
    (run / "inspect" / "inspect.json").write_text(json.dumps(card))


def _agent(config: ExperimentConfig) -> Agent:
    torch.manual_seed(0)
    agent = Agent.untrained(WorldModel(config.model, config.env)).train()
    agent.world_model.inverse_dynamics(torch.randn(4, 9, 4, 32))  # fills the codebook
    return agent.eval()


@pytest.mark.integration
def test_report_of_a_whole_run_is_self_contained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = tiny_config(max_steps=2)
    run = _run(tmp_path, config)
    _card(run)
    path = write_report(run, agent=_agent(config))
    html, text = path.read_text(), (run / "report.md").read_text()
    _check_page(html)
    for title in ("Success", "rollouts", "Slots", "Action prototypes", "Report card", "Training", "Settings"):
        assert re.search(f"<h2>.*{title}", html), title
    assert "98 %" in html
    assert "9 demonstration videos, the real actions of 4 of them" in text
    assert "Still stretches left out: 41 % of the demonstrations' rows were learned from" in text
    assert "| code 2 | 3 | +0.50 ± 0.10 |" in text
    assert "| linear | 0.30 | – |" in text
    assert "| slot 1 | 80% | 0.70 |" in text
    assert "| code 2 | slot 4 | +3.0 right, -1.0 down | 0.5 |" in text
    assert "Stage dynamics is not finished" in text
    named = re.findall(r"\]\((figures/[a-z_]+\.png)\)", text)
    assert len(named) == 7
    assert len(re.findall(r'<img src="data:image/png;base64,[A-Za-z0-9+/=]{500,}" alt="[^"]', html)) == len(named)
    assert all((run / name).stat().st_size > 500 for name in named)
    assert str(tmp_path) not in html + text  # no path of this machine


def _success(run: Path, config: ExperimentConfig) -> tuple[str, str]:
    """The success section and the notes."""
    metas = read_metas(run)
    with TaskPool(config.acting, config.render) as pool:
        given = ReportInput(run, config, None, None, pool, "run", metas)
        return to_markdown(Document("", "", [success_section(given)])), "\n".join(notes(given))


def _change(run: Path, protocol: str, **values: object) -> None:
    path = run / "evaluation" / protocol / "eval_info.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def test_results_of_another_policy_are_missing(tmp_path: Path) -> None:
    run = _run(tmp_path, config := tiny_config(max_steps=2))
    for protocol, policy in (("simulation", "old"), ("imagination", "new")):
        _change(run, protocol, fingerprints={"slots": "s", "policy": policy}, max_steps=40)
    meta = run / "policy" / "checkpoint" / "meta.json"
    meta.write_text(json.dumps({**json.loads(meta.read_text()), "fingerprint": "new"}))
    text, _ = _success(run, config)
    assert "98 %" not in text
    assert "Success in simulation has not been measured with these weights." in text
    assert "50 %" in text
    assert "unfolds 40 steps" in text


@pytest.mark.parametrize("other", [False, True])
def test_references_are_of_the_seeds_that_they_ran_on(tmp_path: Path, other: bool) -> None:
    run = _run(tmp_path, config := tiny_config(max_steps=2))
    if other:
        _change(run, "imagination", seeds=[1, 2], episodes=2, seed=1)
    text, said = _success(run, config)
    assert text.count("| scripted expert") == 1 + other
    assert ("on the same seeds." in text) is not other
    assert ("| random actions, seeds of imagination | 0 % | 0 to 7 % | – | 2 |" in text) is other
    assert "One training seed: " in said, "whatever the evaluations' seeds"


def test_report_of_an_empty_run_says_what_is_missing_and_how_to_make_it(tmp_path: Path) -> None:
    config = tiny_config()
    path = write_report(tmp_path, config)
    _check_page(path.read_text())
    text = (tmp_path / "report.md").read_text()
    for command in ("evaluate", "train-policy", "train-slots", "train-dynamics"):
        assert f"`playslot {command} run={tmp_path.name}" in text


def test_a_run_without_config_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected the folder of a run"):
        write_report(tmp_path)


def test_text_is_escaped_in_both_formats() -> None:
    blocks = [Text("a < b & `c<d>`"), Table(["x|y"], [["<b>"]], "note"), Missing("No <i>.", "playslot a=<b>")]
    document = Document("<t>", "lead", [Section("<s>", blocks)])
    html = to_html(document)
    assert "<code>c&lt;d&gt;</code>" in html
    assert "a &lt; b &amp;" in html
    assert not re.search("<(b|i|t|s)>", html)
    assert "x\\|y" in to_markdown(document)


def test_a_single_loss_term_is_drawn_once() -> None:
    assert loss_names([{"step": 1, "loss": 1.0, "loss_reconstruction": 1.0}]) == ["loss"]
    assert loss_names([{"loss_a": 1.0, "loss": 1.0}, {"loss_b": 1.0, "lr": 1.0}]) == ["loss", "loss_a", "loss_b"]
    assert loss_names([]) == []


@pytest.mark.integration
def test_a_mode_without_prototypes_is_said_so(tmp_path: Path) -> None:
    config = replace(tiny_config(mode="continuous", max_steps=2))
    model = WorldModel(config.model, config.env)
    write_report(tmp_path, config, world_model=model)
    assert "mode is `continuous`, which has no prototypes" in (tmp_path / "report.md").read_text()


def test_scores_of_other_weights_and_of_other_episodes_are_not_passed_off(tmp_path: Path) -> None:
    run = _run(tmp_path, tiny_config())
    given = ReportInput(
        run, tiny_config(), None, None, TaskPool(tiny_config().env, tiny_config().render), "run", read_metas(run)
    )
    for protocol, steps in (("simulation", 9), ("imagination", 6)):
        path = run / "evaluation" / protocol / "eval_info.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"max_steps": steps, "render": {"quality": "full"}}))
    text = to_markdown(Document("", "", [success_section(given), settings_section(given)]))
    assert "Episodes differ in agent steps: 9 in simulation, 6 in imagination." in text
    assert "at most 9 agent steps, rendering `full`" in text
    scored = {"episodes": 20, "foreground_ari": 0.99, "ari": 0.9, "slots_per_object": 1.0, "psnr": 30.0}
    path = run / "evaluation" / "slots" / "eval_info.json"
    path.parent.mkdir()
    model = WorldModel(tiny_config().model, tiny_config().env)
    shown = replace(given, world_model=model, metas={"slots": {"fingerprint": "now"}})
    for of in ("now", "before"):
        path.write_text(json.dumps(scored | {"fingerprints": {"slots": of}}))
        said = slots_section(shown, lambda: np.zeros((3, 64, 64, 3), np.uint8))
        assert any(isinstance(block, Text) and "FG-ARI 0.99" in block.text for block in said.blocks) == (of == "now")
        assert any(isinstance(block, Missing) for block in said.blocks) == (of == "before")


def test_commands_can_be_pasted(tmp_path: Path) -> None:
    pool = TaskPool(tiny_config().env, tiny_config().render)
    given = ReportInput(tmp_path, tiny_config(), None, None, pool, "runs/a b")
    assert given.command("evaluate", "protocol=replay") == "playslot evaluate 'run=runs/a b' protocol=replay"
