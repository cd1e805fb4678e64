"""The paper's sizes give the paper's parameter counts (system.md, sections 1 to 3)."""

from __future__ import annotations

import pytest
from torch import nn

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import compose
from playslot_rl.world_model import WorldModel


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.fixture(scope="module")
def paper() -> ExperimentConfig:
    return compose(["preset=paper"])


@pytest.fixture(scope="module")
def model(paper: ExperimentConfig) -> WorldModel:
    return WorldModel(paper.model, paper.env)


def test_savi_has_the_papers_parameter_count(model: WorldModel) -> None:
    assert count(model.savi) == 1_012_036


def test_invdyn_s_has_the_papers_parameter_count(model: WorldModel) -> None:
    assert count(model.inverse_dynamics) == 3_197_728


def test_cocvp_has_the_papers_parameter_count(model: WorldModel) -> None:
    assert count(model.predictor) == 4_279_680


def test_each_part_of_savi_has_its_count(model: WorldModel) -> None:
    savi = model.savi
    got = {
        "encoder": count(savi.encoder.convs),
        "encoder position": count(savi.encoder.position),
        "token MLP": count(savi.encoder.mlp),
        "initial slots": count(savi.initializer),
        "corrector": count(savi.corrector),
        "transition": count(savi.transition),
        "decoder position": count(savi.decoder.get_submodule("position")),
    }
    expected = {
        "encoder": 79_328,
        "encoder position": 160,
        "token MLP": 20_800,
        "initial slots": 256,
        "corrector": 214_912,
        "transition": 181_376,
        "decoder position": 640,
    }
    assert got == expected
    assert count(savi.decoder) - got["decoder position"] == 514_564


def test_the_paper_preset_collapses_the_first_layer_and_predicts_without_a_residual(paper: ExperimentConfig) -> None:
    assert paper.model.savi.collapse
    assert not paper.model.predictor.residual
    assert (paper.model.inverse_dynamics.latent_dim, paper.model.inverse_dynamics.n_prototypes) == (16, 8)
