"""Autoencoder BC: an autoencoder that learns to show frames, and a policy that leaves it as it is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from playslot_rl.config import PolicyConfig
from playslot_rl.config.compose import choices, compose
from playslot_rl.methods.autoencoder.method import AutoencoderBCConfig
from playslot_rl.methods.autoencoder.network import Autoencoder, CodePolicy

OWN = AutoencoderBCConfig(channels=(8, 8), code_dim=4)
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
        loss = (network(frames) - target).square().mean()
        loss.backward()
        optimizer.step()
    assert network(frames).shape == target.shape
    assert loss.item() < 0.3 * still, "less than by the mean frame"


def test_the_policy_learns_and_the_code_stays(frames: torch.Tensor) -> None:
    torch.manual_seed(0)
    network = CodePolicy(Autoencoder(OWN).encoder, HEAD, OWN, 16, 2)
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
    own, size = config.baselines.autoencoder_bc, config.env.image_size
    with torch.device("meta"):
        network = Autoencoder(own)
        policy = CodePolicy(network.encoder, config.model.policy, own, size, config.env.action_dim)
        pixels = torch.zeros(2, 3, size, size)
        assert network(pixels).shape == pixels.shape
        assert policy(pixels).shape == (2, config.env.action_dim)
