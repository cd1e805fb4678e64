"""CLAM's mathematics: which frames it sees, where gradients go, what it starts from."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from clips import moving_square

from playslot_rl import keys
from playslot_rl.config import ActionDecoderConfig, StageConfig
from playslot_rl.config.compose import compose
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import transitions
from playslot_rl.data.neighbours import Ends
from playslot_rl.data.views import first_demonstrations
from playslot_rl.methods.clam.method import CLAMConfig
from playslot_rl.methods.clam.model import Forward, Inverse
from playslot_rl.methods.clam.training import CLAMStage
from playslot_rl.methods.cloning import inferred
from playslot_rl.methods.supervised import LabelledMoves
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.training.stage import step_loss

CONFIG = CLAMConfig(channels=(8, 16), hidden=16, latent_dim=3, model=StageConfig(steps=4, batch_size=8))


def stage() -> CLAMStage:
    source = moving_square()
    config = compose(["preset=smoke", "env=button_press", "env.action_dim=2"])
    labelled = LabelledMoves(first_demonstrations(source, 2), config, torch.device("cpu"))
    with global_seed(0, 0):
        inverse, forward = Inverse(CONFIG, 32), Forward(CONFIG)
        decoder = ActionDecoder(ActionDecoderConfig(8), 3, 2)
    return CLAMStage(inverse, forward, decoder, Clips(source, 2, validation=0.2, seed=0, shown=64), labelled, CONFIG)


def test_it_sees_the_frame_before_the_frame_and_the_next_and_an_episodes_first_frame_twice() -> None:
    source = moving_square(episodes=2, length=4)
    rows = Ends.of(source).past(transitions(source).rows + 1, 3)
    assert rows.tolist() == [[0, 0, 1], [0, 1, 2], [1, 2, 3], [4, 4, 5], [4, 5, 6], [5, 6, 7]]
    inverse = stage().inverse.eval()
    latents = inferred(inverse, source.pixels, rows)
    torch.testing.assert_close(latents[2:3], inverse(source.pixels(np.array([[1, 2, 3]]))))


def test_labels_and_frames_teach_the_inverse_model_and_only_labels_the_decoder() -> None:
    made = stage()
    with torch.no_grad():
        made.forward.ups[-1].weight.normal_(std=0.1)
    losses = step_loss(made, 0, StepGenerators(0, 0))
    for name, taught in (("loss_image", False), ("loss_action", True)):
        first = next(made.inverse.parameters())
        (grad,) = torch.autograd.grad(losses[name], first, retain_graph=True)
        assert bool(grad.abs().sum() > 0)
        weight = made.decoder.layers[0].weight
        (decoded,) = torch.autograd.grad(losses[name], weight, retain_graph=True, allow_unused=True)
        assert (decoded is not None) == taught
    torch.testing.assert_close(losses["loss"], losses["loss_image"] + CONFIG.label_weight * losses["loss_action"])


def test_before_training_the_error_is_that_of_no_change() -> None:
    made = stage()
    assert made.validate(0)["unexplained"] == pytest.approx(1)
    batch = made.batch(0, StepGenerators(0, 0))
    assert batch[f"labelled/{keys.PIXELS}"].shape == (8, 3, 3, 32, 32)
    assert batch[f"labelled/{keys.ACTION}"].shape == (8, 2)
