"""VGG19's features: torchvision's layers, weights from where they were said to come, none without them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn
from torchvision.models import VGG19_Weights, vgg19

from playslot_rl.errors import CheckpointError
from playslot_rl.methods.caddy.stage import VGGFeatures, load_perceptual
from playslot_rl.storage.tensors import cached, save_tensors


@pytest.fixture(scope="module")
def network() -> VGGFeatures:
    torch.manual_seed(0)
    return VGGFeatures()


def test_the_layers_are_the_first_thirty_of_torchvisions() -> None:
    with torch.device("meta"):
        ours, theirs = VGGFeatures().features, vgg19(weights=None).features[:30]
    assert [type(layer) for layer in ours] == [type(layer) for layer in theirs]
    assert {k: v.shape for k, v in ours.state_dict().items()} == {k: v.shape for k, v in theirs.state_dict().items()}


def test_the_first_relu_of_each_resolution_is_read(network: VGGFeatures) -> None:
    outputs = network(torch.rand(1, 3, 32, 32))
    assert [x.shape[1:] for x in outputs] == [(64, 32, 32), (128, 16, 16), (256, 8, 8), (512, 4, 4), (512, 2, 2)]
    assert all((x >= 0).all() for x in outputs)
    assert len(network(torch.rand(1, 3, 4, 4))) == 3, "a small frame has fewer levels"


def test_frames_are_standardised_by_imagenets_statistics(network: VGGFeatures) -> None:
    seen = []
    handle = network.features[0].register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    network(torch.full((1, 3, 4, 4), 0.0))
    handle.remove()
    expected = (0.5 - torch.tensor([0.485, 0.456, 0.406])) / torch.tensor([0.229, 0.224, 0.225])
    torch.testing.assert_close(seen[0].mean(dim=(0, 2, 3)), expected)


def test_the_distance_is_zero_to_itself_and_trains_the_prediction_only(network: VGGFeatures) -> None:
    predicted, target = torch.rand(2, 3, 8, 8, requires_grad=True), torch.rand(2, 3, 8, 8, requires_grad=True)
    assert network.distance(target, target) == 0
    network.distance(predicted, target).backward()
    assert predicted.grad is not None
    assert predicted.grad.abs().sum() > 0
    assert target.grad is None
    assert not any(parameter.requires_grad for parameter in network.parameters())


def test_empty_and_a_missing_cache_go_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.hub, "_hub_dir", str(tmp_path))
    assert load_perceptual("") is None
    assert load_perceptual("auto") is None


def test_auto_takes_the_cache_and_leaves_the_global_generator_alone(
    network: VGGFeatures, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.hub, "_hub_dir", str(tmp_path))
    path = cached(VGG19_Weights.IMAGENET1K_V1.url)
    path.parent.mkdir()
    torch.save({**network.state_dict(), "classifier.0.weight": torch.zeros(1)}, path)
    before = torch.get_rng_state()
    loaded = load_perceptual("auto")
    assert torch.equal(torch.get_rng_state(), before)
    assert isinstance(loaded, nn.Module)
    assert not loaded.training
    assert all(torch.equal(a, b) for a, b in zip(loaded.parameters(), network.parameters(), strict=True))


def test_wrong_files_are_refused(tmp_path: Path) -> None:
    save_tensors(tmp_path / "short.safetensors", {"features.0.weight": torch.zeros(64, 3, 3, 3)})
    with pytest.raises(CheckpointError, match=r"^baselines\.caddy\.perceptual=.*got no tensor features\.0\.bias"):
        load_perceptual(str(tmp_path / "short.safetensors"))
    with pytest.raises(CheckpointError, match="expected a file of VGG19's"):
        load_perceptual(str(tmp_path / "none.pth"))
    (tmp_path / "bad.pth").write_bytes(b"no weights")
    with pytest.raises(CheckpointError, match="expected a file of VGG19's"):
        load_perceptual(str(tmp_path / "bad.pth"))
