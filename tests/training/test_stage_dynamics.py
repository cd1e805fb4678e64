"""The dynamics stage's precision: transformers in bf16, what small differences pass through in fp32."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tiny_stages import STAGES

from playslot_rl.runtime.precision import autocast
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.training.stage import step_loss
from playslot_rl.training.stage_dynamics import DynamicsStage

KINDS = ["dynamics", "dynamics of many agents", "slotformer", "ocvp_seq"]


def stage_of(kind: str, precision: str) -> DynamicsStage:
    stage = STAGES[kind]().stage
    assert isinstance(stage, DynamicsStage)
    stage.config = replace(stage.config, precision=precision)
    torch.manual_seed(0)
    for module in stage.modules.values():  # a predictor that says "nothing moves" has no rounding to show
        for parameter in module.parameters():
            torch.nn.init.normal_(parameter, std=0.2)
    return stage


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("step", [0, 9], ids=["teacher", "rollout"])
def test_bf16_is_trained_under_autocast_and_validated_in_fp32(kind: str, step: int) -> None:
    losses, validations = [], []
    for precision in ("fp32", "bf16", "fp32"):
        stage = stage_of(kind, precision)
        with torch.no_grad(), global_seed(0, step):
            losses.append(step_loss(stage, step, StepGenerators(3, step)))
            validations.append(stage_of(kind, precision).validate(1))
    for name in ("loss", "mse_image", "mse_slot"):
        full, half, again = (values[name] for values in losses)
        assert full == again != half
        torch.testing.assert_close(full, half, rtol=0.05, atol=0.01)
    assert validations[0] == validations[1]


@pytest.mark.parametrize("kind", KINDS)
def test_latents_and_predictions_keep_the_precision_of_the_slots(kind: str) -> None:
    model = stage_of(kind, "bf16").model
    slots = torch.randn(2, 4, 3, 16)
    with autocast("cpu", "bf16"):
        latent = model.inverse_dynamics(slots)
        predicted = model.predictor.rollout(slots[:, :1], latent.prototype, latent.variability)
    assert {latent.z.dtype, latent.prototype.dtype, latent.variability.dtype, predicted.dtype} == {torch.float32}
