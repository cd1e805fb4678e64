"""Weights in half precision: half as large, loaded as fp32, one model with its fingerprints."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import playslot_rl
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.pretrained import episode
from playslot_rl.runs import Run
from playslot_rl.sharing import ship as module
from playslot_rl.sharing.ship import halved, ship
from playslot_rl.storage.tensors import load_tensors

STAGES = ("slots", "dynamics", "policy")


def test_numbers_are_off_by_one_part_in_two_thousand_and_large_ones_stay() -> None:
    value = torch.randn(10_000).clamp(min=1e-3)
    assert halved(value).dtype == torch.float16
    assert ((halved(value).float() - value).abs() <= value.abs() * 2**-11).all()
    for kept in (torch.tensor([1.0, 1e6]), torch.tensor([True]), torch.arange(3)):
        assert halved(kept) is kept


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shipped") / "model"
    ship(Run.open("pretrained/button_press"), folder)
    return folder


def test_a_shipped_model_in_halves_is_half_as_large_and_acts_as_before(halves: Path) -> None:
    before, after = Run.open("pretrained/button_press"), Run.open(halves)
    for stage in STAGES:
        sizes = [(run.place(stage) / "weights.safetensors").stat().st_size for run in (before, after)]
        assert sizes[1] < 0.51 * sizes[0]
        assert after.own(stage).meta["halved_from"] == before.own(stage).fingerprint
        assert after.own(stage).meta["metrics"] == before.own(stage).meta["metrics"]
    models = [playslot_rl.load(run, device="cpu") for run in (before, after)]
    assert {p.dtype for p in models[1].world_model.parameters()} == {torch.float32}
    frames = episode("button_press")
    decoded = [model.decode(model.parse(frames)).frames for model in models]
    assert (decoded[0] - decoded[1]).abs().max() < 0.02
    actions = [np.stack([model.act(frame) for frame in frames]) for model in models]
    assert np.abs(actions[0] - actions[1]).max() < 0.05
    assert np.abs(actions[0] - actions[1]).max() > 0


def test_its_stages_belong_together_and_to_no_other_model(halves: Path) -> None:
    run = Run.open(halves)
    assert run.stage("policy").meta["parents"] == {name: run.own(name).fingerprint for name in STAGES[:2]}
    kept = load_tensors(run.place("slots") / "weights.safetensors")
    assert {value.dtype for value in kept.values()} == {torch.float16}
    (halves / "policy" / "checkpoint" / "weights.safetensors").write_bytes(b"")
    with pytest.raises(CheckpointError):
        ship(Run.open(halves), halves.parent / "again")
    assert not (halves.parent / "again").exists()


def test_a_run_is_not_written_over_itself(halves: Path) -> None:
    for arguments in ([], [str(halves)], [str(halves), str(halves)], [str(halves), str(halves / "model")]):
        with pytest.raises(ConfigError, match="expected a run and another folder to write"):
            module.main(arguments)
    assert not (halves / "model").exists()


@pytest.mark.integration
@pytest.mark.parametrize("arguments", [(), ("pretrained/button_press",), ("no/such/run", "model")])
def test_bad_arguments_are_one_line(
    arguments: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["ship", *arguments])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=r"^ship: error: .*, expected .*(?!\n)$"):
        runpy.run_path(str(module.__file__), run_name="__main__")
    assert capsys.readouterr() == ("", "")
