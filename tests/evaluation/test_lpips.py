"""LPIPS: on the weights of a file, as its paper has it, and nothing at all without."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor
from torchvision.models import AlexNet_Weights, alexnet

from playslot_rl.errors import CheckpointError
from playslot_rl.evaluation.video import frame_scores, open_lpips
from playslot_rl.storage.tensors import cached, load_tensors, save_tensors

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """AlexNet's tensors, at random, as a file."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("alexnet") / "alexnet.safetensors"
    save_tensors(path, {k: v for k, v in alexnet(weights=None).state_dict().items() if k.startswith("features")})
    return path


def pair() -> tuple[Tensor, Tensor]:
    numbers = torch.Generator().manual_seed(1)
    return torch.rand(1, 2, 3, 64, 64, generator=numbers), torch.rand(1, 2, 3, 64, 64, generator=numbers)


def test_it_is_the_papers_distance_on_the_files_features(weights: Path) -> None:
    network = open_lpips(str(weights)).network
    assert network is not None
    (a, b), net = pair(), alexnet(weights=None).eval()
    net.load_state_dict({**net.state_dict(), **load_tensors(weights)})
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    total = torch.zeros(2)
    x, y = (((2 * clip[0] - 1) - shift.view(3, 1, 1)) / scale.view(3, 1, 1) for clip in (a, b))
    level = 0
    for layer in net.features:
        x, y = layer(x), layer(y)
        if isinstance(layer, torch.nn.ReLU):
            unit = [f / (f.square().sum(1, keepdim=True).sqrt() + 1e-8) for f in (x, y)]
            head = network.lins[level].model[-1].weight  # type: ignore[index, union-attr]
            total += ((unit[0] - unit[1]).square() * head[0]).sum(1).mean(dim=(1, 2)).detach()
            level += 1
    assert level == 5
    scores = frame_scores(a, b, network)
    assert scores.lpips is not None
    torch.testing.assert_close(scores.lpips[0], total, rtol=1e-3, atol=1e-5)


def test_equal_frames_have_none(weights: Path) -> None:
    a, _ = pair()
    scores = frame_scores(a, a, open_lpips(str(weights)).network)
    assert scores.lpips is not None
    assert scores.lpips.abs().max() < 1e-6


def test_without_weights_it_is_not_available_and_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.hub, "_hub_dir", str(tmp_path))
    network, reason = open_lpips()
    assert network is None
    assert "metrics.lpips_weights=PATH" in reason
    a, b = pair()
    assert frame_scores(a, b, network).lpips is None


def test_the_cache_is_looked_into(weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.hub, "_hub_dir", str(tmp_path))
    path = cached(AlexNet_Weights.IMAGENET1K_V1.url)
    path.parent.mkdir(parents=True)
    torch.save(load_tensors(weights), path)
    assert open_lpips().network is not None


@pytest.mark.parametrize("content", [b"", b"no weights"])
def test_a_file_of_something_else_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "alexnet.pth").write_bytes(content)
    with pytest.raises(CheckpointError, match=r"metrics\.lpips_weights=.*expected a file of AlexNet's") as caught:
        open_lpips(str(tmp_path / "alexnet.pth"))
    assert "\n" not in str(caught.value)


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    save_tensors(tmp_path / "other.safetensors", {"features.0.weight": torch.zeros(2, 3, 3, 3)})
    with pytest.raises(CheckpointError, match=r"got no tensor features\.0\.bias of its shape"):
        open_lpips(str(tmp_path / "other.safetensors"))
