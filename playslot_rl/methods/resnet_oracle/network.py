"""The ResNet Oracle: the policy's head on ResNet-18 features of the frame, cloning real actions (paper, section 4).

    a_t = clamp(f(R(o_t) + P), -1, 1)

R is torchvision's ResNet-18 without pooling and classifier: its last feature map, read as h w tokens of 512, takes the
place of the slots in the policy's network f; P is a learned position of each token. All of it is trained. With history
f reads the tokens of the last F frames, each at a position of its own; before an episode's first frame it stands again.

Note: the paper does not say where in ResNet-18 the features are taken, nor whether it stays frozen. Frames are 64x64,
so the last feature map is 2x2: as many tokens as ButtonPress has slots.

Shapes: B batch, F frames, H W image height and width, h w those of the feature map (H / 32, W / 32), A action dim.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.acting.actor import Actor, ReactiveActor, with_present
from playslot_rl.config import PolicyConfig
from playslot_rl.errors import CheckpointError
from playslot_rl.frames import IMAGENET_MEAN, IMAGENET_STD, normalise
from playslot_rl.methods.resnet_oracle.method import HISTORY, NAME, ResNetOracleConfig
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.runs import Run
from playslot_rl.storage.tensors import cached, load_published
from playslot_rl.world_model import oracle_module

WIDTH = 512
Pretraining = Literal["imagenet", "scratch"]


class ResNetPolicy(nn.Module):
    """Real actions from frames H = W = `image_size`, a multiple of 32; from the last `frames` of them. Of several
    `tasks` it is told which, as the `LatentPolicy` that is its head.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, config: PolicyConfig, image_size: int, out_dim: int, frames: int = 1, tasks: int = 0) -> None:
        from torchvision.models import resnet18

        super().__init__()
        trunk = resnet18(weights=None)
        trunk.avgpool, trunk.fc = nn.Identity(), nn.Identity()
        self.trunk, self.frames, self.tasks = trunk, frames, tasks
        self.position = nn.Parameter(torch.randn(frames * (image_size // 32) ** 2, WIDTH) * 0.02)
        self.head = LatentPolicy(config.of_frames, WIDTH, out_dim, acts=True, tasks=tasks)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)

    def features(self, pixels: Tensor) -> Tensor:
        """Frames (B, [F,] 3, H, W), uint8 or float [0, 1], to tokens (B, F h w, 512)."""
        flat: Tensor = self.trunk((normalise(pixels).flatten(0, -4) - self.mean) / self.std)
        return flat.view(len(flat), WIDTH, -1).transpose(1, 2).reshape(len(pixels), -1, WIDTH)

    def forward(self, pixels: Tensor, *task: Tensor) -> Tensor:
        """Frames (B, [F,] 3, H, W), uint8 or float [0, 1], and the task int64 (B, 1) where it is told, to actions
        (B, A), not clamped.
        """
        actions: Tensor = self.head(self.features(pixels) + self.position, *task)
        return actions


def load_trunk(trunk: nn.Module, weights: str, key: str, names: Mapping[str, str] | None = None) -> Pretraining:
    """Give a ResNet-18 its starting weights (`ResNetOracleConfig.weights`), and say which; a CheckpointError where the
    file is missing, damaged or not ResNet-18's, or cannot be fetched. `names` are torchvision's of its tensors.
    """
    from torchvision.models import ResNet18_Weights

    if weights == "scratch":
        return "scratch"
    url = ResNet18_Weights.IMAGENET1K_V1.url
    path = cached(url) if weights in ("auto", "download") else Path(weights)
    if weights == "auto" and not path.is_file():
        return "scratch"
    if weights == "download" and not path.is_file():
        _download(url, path, key)
    cures, note = ("give another", "set it to scratch"), " (torchvision's ResNet-18)"
    load_published(trunk, path, key, "ResNet-18", cures, names, note)
    return "imagenet"


def _download(url: str, path: Path, key: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.hub.download_url_to_file(url, str(path), progress=False)
    except OSError as error:
        raise CheckpointError(
            f"{key}=download: got {error}, expected a network: put the file at {path}, or set it to scratch"
        ) from error


def resnet_actor(policy: ResNetPolicy) -> Actor:
    """The actor of a policy in evaluation mode; actions clamped to [-1, 1]."""
    return ReactiveActor(oracle_module(policy, keys.PIXELS), policy.tasks)


class HistoryActor(Actor):
    """The last F frames (n, F, 3, W, W), its memory, to ACTION (n, A), clamped to [-1, 1]."""

    def __init__(self, policy: ResNetPolicy, image_size: int) -> None:
        super().__init__((keys.FRAME_HISTORY, keys.STEP_COUNT), tasks=policy.tasks)
        self.policy, self.image_size = policy, image_size

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        memory, n, side = super().reset(seeds), len(seeds), self.image_size
        memory[keys.FRAME_HISTORY] = torch.zeros(n, self.policy.frames, 3, side, side)
        memory[keys.STEP_COUNT] = torch.zeros(n, 1, dtype=torch.long)
        return memory

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        step = tensordict.get(keys.STEP_COUNT)
        frames = with_present(tensordict.get(keys.FRAME_HISTORY), normalise(tensordict.get(keys.PIXELS)), step)
        task = [tensordict.get(keys.TASK)] if self.tasks else []
        actions = self.policy(frames, *task).clamp(-1, 1)
        return tensordict.update({keys.ACTION: actions, keys.FRAME_HISTORY: frames, keys.STEP_COUNT: step + 1})


def load_actor(run: Run, device: torch.device | str = "cpu") -> Actor:
    """The actor of a finished run; a CheckpointError where it is missing or damaged."""
    return resnet_actor(_load(run, NAME, 1, device))


def load_with_history(run: Run, device: torch.device | str = "cpu") -> Actor:
    """As `load_actor`, of frames with history."""
    own = run.stage(HISTORY).group(ResNetOracleConfig, HISTORY)
    return HistoryActor(_load(run, HISTORY, own.history, device), run.stage(HISTORY).sizes[1].image_size)


def _load(run: Run, stage: str, frames: int, device: torch.device | str) -> ResNetPolicy:
    done = run.stage(stage)
    model, env = done.sizes
    build = partial(ResNetPolicy, model.policy, env.image_size, env.action_dim, frames, len(env.tasks))
    return done.restore(build, "policy", device)
