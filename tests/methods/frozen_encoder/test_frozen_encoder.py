"""Policies on a frozen encoder: models that learn to show frames, and a policy that leaves the encoder as it is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from playslot_rl.config import PolicyConfig
from playslot_rl.config.compose import choices, compose
from playslot_rl.methods.frozen_encoder.method import AutoencoderBCConfig, InverseBCConfig
from playslot_rl.methods.frozen_encoder.network import Autoencoder, CodePolicy, LatentInverse, video_encoder

OWN = AutoencoderBCConfig(channels=(8, 8), code_dim=4)
INVERSE = InverseBCConfig(channels=(8, 8), hidden=16, latent_dim=2)
HEAD = PolicyConfig(dim=16, layers=1, heads=2, head_dim=8, mlp_dim=16)


@pytest.fixture
def frames() -> torch.Tensor:
    """A square at different places."""
    shown = np.full((8, 3, 16, 16), 40, np.uint8)
    for i in range(8):
        shown[i, :, i : i + 6, 2:8] = 220
    return torch.from_numpy(shown)


def test_it_learns_where_things_are(frames: torch.Tensor) -> None:
    torch.manual_seed(0)
    network = Autoencoder(OWN)
    optimizer = torch.optim.Adam(network.parameters(), 1e-2)
    target = frames / 255
    still = float((target - target.mean(0)).square().mean())
    for _ in range(150):
        optimizer.zero_grad()
        loss = (network.shown(target[:, None]) - target).square().mean()
        loss.backward()
        optimizer.step()
    assert loss.item() < 0.3 * still, "less than by the mean frame"


@pytest.mark.slow
def test_the_resnet_learns_through_the_latent_action_what_moved(frames: torch.Tensor) -> None:
    torch.manual_seed(0)
    network = LatentInverse(INVERSE, 32)
    grown = torch.nn.functional.interpolate(frames / 255, size=32)
    pairs = torch.stack((grown[2:5].repeat(2, 1, 1, 1), torch.cat((grown[:3], grown[4:7]))), dim=1)
    still = float((pairs[:, 1] - pairs[:, 0]).square().mean())
    assert torch.equal(network.shown(pairs), pairs[:, 0]), "it starts from no change"
    optimizer = torch.optim.Adam(network.parameters(), 5e-3)
    for _ in range(60):
        optimizer.zero_grad()
        loss = (network.shown(pairs) - pairs[:, 1]).square().mean()
        loss.backward()
        optimizer.step()
    assert all(p.grad is not None and bool(p.grad.any()) for p in network.encoder.parameters())
    assert loss.item() < 0.4 * still, "each frame goes either way: only the latent says which"


def test_batch_statistics_of_the_encoder_stay_while_the_policy_is_trained(frames: torch.Tensor) -> None:
    torch.manual_seed(0)
    pixels = torch.nn.functional.interpolate(frames / 255, size=32)
    policy = CodePolicy(LatentInverse(INVERSE, 32).encoder, HEAD, INVERSE.code, 32, 2)
    trained, evaluated = policy.train().code(pixels), policy.eval().code(pixels)
    assert torch.equal(trained, evaluated)
    torch.testing.assert_close(trained[:1], policy.train().code(pixels[:1]), msg="no frame hangs on the others")


def test_the_policy_learns_and_the_code_stays(frames: torch.Tensor) -> None:
    torch.manual_seed(0)
    network = CodePolicy(Autoencoder(OWN).encoder, HEAD, OWN.code, 16, 2)
    network.standardise(frames)
    tokens = (network.code(frames) - network.mean) / network.std
    assert tokens.shape == (8, 16, 4)
    torch.testing.assert_close(tokens.mean((0, 1)), torch.zeros(4), atol=1e-4, rtol=0)
    network(frames).square().sum().backward()
    moved = {name.partition(".")[0] for name, p in network.named_parameters() if p.grad is not None}
    assert moved == {"position", "head"}


@pytest.mark.parametrize("preset", choices("preset"))
@pytest.mark.parametrize("env", choices("env"))
def test_every_task_and_preset_has_sizes_that_fit(env: str, preset: str) -> None:
    config = compose([f"env={env}", f"preset={preset}"])
    size = config.env.image_size
    for own in (config.baselines.autoencoder_bc, config.baselines.inverse_bc):
        with torch.device("meta"):
            network = video_encoder(own, size)
            policy = CodePolicy(network.encoder, config.model.policy, own.code, size, config.env.action_dim)
            pixels = torch.zeros(2, network.frames, 3, size, size)
            assert network.shown(pixels).shape == pixels[:, 0].shape
            assert policy(pixels[:, 0]).shape == (2, config.env.action_dim)
