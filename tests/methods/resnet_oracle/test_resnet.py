"""The ResNet oracle: tokens of the last feature map, all of it trained, weights from where they were said to come."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torchvision.models import ResNet18_Weights, resnet18

from playslot_rl import keys
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.config import PolicyConfig
from playslot_rl.data.neighbours import Ends
from playslot_rl.errors import CheckpointError
from playslot_rl.methods.resnet_oracle.network import (
    HistoryActor,
    ResNetPolicy,
    load_trunk,
    resnet_actor,
)
from playslot_rl.storage.tensors import cached, save_tensors

HEAD = PolicyConfig(dim=16, layers=1, heads=2, head_dim=8, mlp_dim=16)


@pytest.fixture
def policy() -> ResNetPolicy:
    torch.manual_seed(0)
    return ResNetPolicy(HEAD, 64, 4)


def test_features_are_those_of_torchvisions_network(policy: ResNetPolicy) -> None:
    pixels = torch.randint(256, (2, 3, 64, 64), dtype=torch.uint8)
    whole = resnet18(weights=None)
    whole.load_state_dict({**policy.trunk.state_dict(), **{k: v for k, v in whole.state_dict().items() if "fc" in k}})
    whole.eval()
    policy.eval()
    got = policy.features(pixels)
    assert got.shape == (2, 4, 512)
    torch.testing.assert_close(
        whole.fc(got.mean(1)), whole((pixels / 255.0 - policy.mean) / policy.std), atol=1e-4, rtol=1e-4
    )


def test_gradients_reach_trunk_position_and_head(policy: ResNetPolicy) -> None:
    policy(torch.rand(2, 3, 64, 64)).square().sum().backward()
    missing = [name for name, p in policy.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert missing == []


def test_actions_are_clamped_and_the_actor_remembers_nothing(policy: ResNetPolicy) -> None:
    with torch.no_grad():
        policy.head.head.bias.fill_(9.0)
    actor = resnet_actor(policy.eval())
    memory = actor.reset([1, 2])
    assert memory.is_empty()
    actions = actor(memory.set(keys.PIXELS, torch.zeros(2, 3, 64, 64, dtype=torch.uint8)))[keys.ACTION]
    assert (actions == 1).all()


def test_auto_takes_the_cached_weights_and_says_scratch_without(
    policy: ResNetPolicy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.hub, "_hub_dir", str(tmp_path))
    before = policy.trunk.conv1.weight.clone()
    assert load_trunk(policy.trunk, "auto", "weights") == "scratch"
    assert torch.equal(policy.trunk.conv1.weight, before)
    other = resnet18(weights=None)
    path = cached(ResNet18_Weights.IMAGENET1K_V1.url)
    path.parent.mkdir()
    torch.save(other.state_dict(), path)
    assert load_trunk(policy.trunk, "auto", "weights") == "imagenet"
    assert torch.equal(policy.trunk.conv1.weight, other.conv1.weight)
    assert load_trunk(policy.trunk, "scratch", "weights") == "scratch"


def test_a_given_file_is_read_and_a_wrong_one_refused(policy: ResNetPolicy, tmp_path: Path) -> None:
    tensors = dict(policy.trunk.state_dict())
    save_tensors(tmp_path / "good.safetensors", tensors)
    assert load_trunk(policy.trunk, str(tmp_path / "good.safetensors"), "weights") == "imagenet"
    tensors.pop("layer1.0.conv1.weight")
    save_tensors(tmp_path / "short.safetensors", tensors)
    with pytest.raises(CheckpointError, match=r"got no tensor layer1\.0\.conv1\.weight"):
        load_trunk(policy.trunk, str(tmp_path / "short.safetensors"), "weights")
    with pytest.raises(CheckpointError, match="expected a file of ResNet-18's"):
        load_trunk(policy.trunk, str(tmp_path / "none.pth"), "weights")
    (tmp_path / "bad.pth").write_bytes(b"no weights")
    with pytest.raises(CheckpointError, match="expected a file of ResNet-18's"):
        load_trunk(policy.trunk, str(tmp_path / "bad.pth"), "weights")


@torch.no_grad()
def test_with_history_it_acts_on_the_last_frames_in_their_order() -> None:
    torch.manual_seed(0)
    network = ResNetPolicy(HEAD, 64, 4, frames=3).eval()
    frames = torch.randint(256, (5, 2, 3, 64, 64), dtype=torch.uint8)
    loop = ClosedLoop(HistoryActor(network, 64))
    loop.reset([1, 2])
    acted = torch.stack([loop.act(pixels) for pixels in frames])
    for step, rows in enumerate(((0, 0, 0), (0, 0, 1), (0, 1, 2), (1, 2, 3), (2, 3, 4))):
        expected = network(frames[list(rows)].transpose(0, 1)).clamp(-1, 1)
        torch.testing.assert_close(acted[step], expected, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(network(frames[:3].transpose(0, 1)), network(frames[:3].flip(0).transpose(0, 1)))


def test_rows_of_the_past_end_in_the_present_and_begin_with_the_episode() -> None:
    ends = Ends(np.array([0, 0, 0, 3, 3]), np.array([2, 2, 2, 4, 4]))
    assert ends.past(np.array([0, 2, 4]), 3).tolist() == [[0, 0, 0], [0, 1, 2], [3, 3, 4]]
