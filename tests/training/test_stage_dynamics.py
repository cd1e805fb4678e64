"""The dynamics stage's precision: transformers in bf16, what small differences pass through in fp32."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_stages import STAGES, dynamics

from playslot_rl import keys
from playslot_rl.data.slot_cache import slot_cache
from playslot_rl.errors import ConfigError
from playslot_rl.modules.savi.initializer import SlotInitializer
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


def test_drawn_clips_are_parsed_as_the_slot_cache_parses_them(tmp_path: Path) -> None:
    stage = stage_of("dynamics of drawn clips", "bf16")
    step_loss(stage, 0, StepGenerators(3, 0))  # leaves SAVi in the stage's precision
    batch = stage.batch(1, StepGenerators(3, 1))
    frames = batch[keys.PIXELS].flatten(0, 1).movedim(1, -1).numpy()
    each = np.full(6, 5, np.int64)
    source = replace(stage.source, frames=frames, starts=np.arange(6) * 5, lengths=each, fingerprint="drawn")
    cached = slot_cache(source, stage.model.savi, "weights", tmp_path)
    torch.testing.assert_close(batch[keys.SLOTS].flatten(0, 1), torch.from_numpy(np.array(cached)))
    assert not batch[keys.SLOTS].requires_grad


def test_initial_slots_of_drawn_clips_are_drawn_by_seed_and_step() -> None:
    stage = stage_of("dynamics of drawn clips", "fp32")
    savi = stage.model.savi
    savi.config, savi.initializer = replace(savi.config, initial="gaussian"), SlotInitializer(3, 16, "gaussian")
    one, again, other = (stage.batch(1, StepGenerators(seed, 1))[keys.SLOTS] for seed in (3, 3, 4))
    assert torch.equal(one, again)
    assert not torch.equal(one, other)


def test_drawn_clips_have_no_actions_to_learn_from() -> None:
    with pytest.raises(ConfigError, match=r"data\.drawn: got true in mode ground_truth, expected false"):
        dynamics(mode="ground_truth", drawn=True)
