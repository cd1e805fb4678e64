"""LAPO's inverse and forward model on pixels (Schmidt and Jiang, 2024, "Learning to Act without Actions", section 4),
and the convolutional encoder that its three networks share in form (not in weights).

    z_t = VQ(IDM(o_{t-1}, o_t, o_{t+1})),   o^_{t+1} = FDM(o_{t-1}, o_t, z_t)

The forward model sees the next frame only through z_t, whose few codes are the bottleneck: what they best carry is what
the agent did. Before an episode's first frame that frame stands again. Groups of z_t are looked up in `codebooks`
codebooks, as many in each.

Note: each dimension of z is standardised over the batch (BatchNorm without weights) before it is quantised: frames
differ little from the next ones, and otherwise all of them fall to one code, from which nothing is learned. The forward
model predicts the change of the frame and starts from no change at all. Where LAPO concatenates z to the maps, a linear
map of it is added, which differs at the borders alone; its U-Net has BatchNorm and transposed convolutions.

Shapes: B batch, F frames (`frames`), C input channels, H W image height and width, G groups, Z = G times the width of a
code.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from playslot_rl.acting.actor import Actor, latent_actor
from playslot_rl.frames import normalise
from playslot_rl.methods.decoded_policy import DecodedPolicy
from playslot_rl.methods.lapo.method import MODEL, NAME, Encoder, LAPOConfig, LatentConfig, Targets
from playslot_rl.modules.quantizer import ActionQuantizer
from playslot_rl.runs import Run
from playslot_rl.storage.checkpoints import StageCheckpoint


class ResidualBlock(nn.Module):
    """x + conv(relu(conv(relu(x)))), 3x3, same channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = x + self.second(F.relu(self.first(F.relu(x))))
        return out


def _level(kind: Encoder, ins: int, outs: int) -> nn.Sequential:
    if kind == "strided":
        return nn.Sequential(nn.Conv2d(ins, outs, 3, stride=2, padding=1), ResidualBlock(outs))
    blocks = [ResidualBlock(outs) for _ in range(2)]
    return nn.Sequential(nn.Conv2d(ins, outs, 3, padding=1), nn.MaxPool2d(3, stride=2, padding=1), *blocks)


class ConvEncoder(nn.Module):
    """Levels of halved resolution: of `impala` (Espeholt et al., 2018) a 3x3 conv, a maximum over 3x3 and two residual
    blocks; `strided` has a conv of stride 2 and one block, a fifth of the arithmetic.
    """

    def __init__(self, in_channels: int, channels: tuple[int, ...], kind: Encoder = "strided") -> None:
        super().__init__()
        ins = (in_channels, *channels[:-1])
        self.levels = nn.ModuleList(_level(kind, a, b) for a, b in zip(ins, channels, strict=True))

    def forward(self, x: Tensor, start: Tensor | None = None) -> list[Tensor]:
        """(B, C, H, W) to the outputs of all levels, (B, channels[i], H / 2^(i+1), W / 2^(i+1)), after a ReLU; `start`
        (B, channels[0]) is added behind the first conv.
        """
        outputs: list[Tensor] = []
        for level in self.levels:
            first, *rest = level.children()
            x = first(x)
            if start is not None and not outputs:
                x = x + start[:, :, None, None]
            for part in rest:
                x = part(x)
            x = F.relu(x)
            outputs.append(x)
        return outputs


class EncoderMLP(nn.Module):
    """A ConvEncoder's last level, flattened, through one hidden layer: F frames (B, 3 F, H, W) to latents (B, Z), of
    the settings of a method (LAPO's, LAOM's, CLAM's).
    """

    def __init__(self, config: Any, frames: int, image_size: int) -> None:
        super().__init__()
        channels, hidden = config.channels, config.hidden
        self.encoder = ConvEncoder(3 * frames, channels, config.encoder)
        width = channels[-1] * (image_size // 2 ** len(channels)) ** 2
        self.mlp = nn.Sequential(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, config.latent_dim))

    def forward(self, x: Tensor) -> Tensor:
        return self.out(self.hidden(x))

    def hidden(self, x: Tensor, start: Tensor | None = None, shift: Tensor | None = None) -> Tensor:
        """(B, 3 F, H, W) to the hidden layer, (B, hidden), after its ReLU, to which `shift` (B, hidden) is added before
        it; `start` as in `ConvEncoder`.
        """
        h: Tensor = self.mlp[0](self.encoder(x, start)[-1].flatten(1))
        return F.relu(h if shift is None else h + shift)

    def out(self, hidden: Tensor) -> Tensor:
        """(B, hidden) to (B, Z)."""
        out: Tensor = self.mlp[2](hidden)
        return out


class Inferred(NamedTuple):
    """Latent actions z, quantised straight-through, and as they were `before` (B, Z), their codes int64 (B, G), each of
    its own codebook, and the commitment term, weight included (scalar).
    """

    z: Tensor
    before: Tensor
    code: Tensor
    vq_loss: Tensor


class QuantisedInverse(nn.Module):
    """IDM: what `network` makes of frames, (B, Z), to a quantised latent action."""

    def __init__(self, config: LatentConfig, network: nn.Module) -> None:
        super().__init__()
        self.config, self.network = config, network
        self.standardise = nn.BatchNorm1d(config.latent_dim, affine=False)
        sizes = config.code_dim, config.codes, config.decay, config.dead_threshold, config.commitment
        self.quantizers = nn.ModuleList(ActionQuantizer(*sizes) for _ in range(config.codebooks))

    def read(self, frames: Tensor) -> Tensor:
        """What the network makes of frames (B, F, ...): float32 (B, Z), before it is standardised."""
        found: Tensor = self.network(frames)
        return found.float()

    @torch.no_grad()
    def settle(self, batches: Iterable[Tensor]) -> None:
        """Standardise by the mean and variance over batches of frames (b, F, ...) in evaluation mode. The moving
        averages will not do: frames differ so little that a step moves the mean by several standard deviations.
        """
        z = torch.cat([self.read(frames) for frames in batches])
        for buffer, value in ((self.standardise.running_mean, z.mean(0)), (self.standardise.running_var, z.var(0))):
            assert buffer is not None
            buffer.copy_(value)

    def latents(self, targets: Targets, frames: Tensor) -> Tensor:
        """Latent actions (B, Z) of frames (B, F, ...), as `LatentConfig.targets` says."""
        found: Inferred = self(frames)
        return found.z if targets == "quantised" else found.before

    def forward(self, frames: Tensor) -> Inferred:
        """Frames (B, F, ...) to latent actions between the last two; the codebooks move in training mode."""
        z = self.standardise(self.read(frames))
        grouped = z.view(len(z), -1, self.config.code_dim)
        parts = grouped.chunk(self.config.codebooks, dim=1)
        found = [quantizer(part) for quantizer, part in zip(self.quantizers, parts, strict=True)]
        p, code, losses = zip(*found, strict=True)
        return Inferred(torch.cat(p, dim=1).flatten(1), z, torch.cat(code, dim=1), torch.stack(losses).mean())


class InverseModel(QuantisedInverse):
    """IDM on frames (B, F, 3, H, W), uint8 or float [0, 1]."""

    def __init__(self, config: LAPOConfig, image_size: int) -> None:
        super().__init__(config, EncoderMLP(config, config.frames, image_size))

    def read(self, frames: Tensor) -> Tensor:
        return super().read(normalise(frames).flatten(1, 2))


class ChangeUNet(nn.Module):
    """A U-Net whose lowest maps a latent is added to, at the start without output; with `start` it is added behind the
    first conv, too.
    """

    def __init__(
        self,
        in_channels: int,
        channels: tuple[int, ...],
        latent_dim: int,
        kind: Encoder = "strided",
        start: bool = False,
    ) -> None:
        super().__init__()
        self.encoder = ConvEncoder(in_channels, channels, kind)
        self.to_input = nn.Linear(latent_dim, channels[0]) if start else None
        self.to_map = nn.Linear(latent_dim, channels[-1])
        self.bottom = ResidualBlock(channels[-1])
        outs = (*channels[-2::-1], 3)
        ins = (channels[-1], *(2 * c for c in channels[-2::-1]))
        self.ups = nn.ModuleList(nn.Conv2d(a, 4 * b, 3, padding=1) for a, b in zip(ins, outs, strict=True))
        for parameter in self.ups[-1].parameters():
            nn.init.zeros_(parameter)

    def change(self, x: Tensor, z: Tensor) -> Tensor:
        """Maps (B, C, H, W) and latents (B, Z) to the change of a frame, (B, 3, H, W)."""
        *skips, x = self.encoder(x, None if self.to_input is None else self.to_input(z))
        x = self.bottom(x + self.to_map(z)[:, :, None, None])
        for i, up in enumerate(self.ups):
            x = F.pixel_shuffle(up(F.relu(x)), 2)
            if i < len(skips):
                x = torch.cat((x, skips[-1 - i]), dim=1)
        return x


class ForwardModel(ChangeUNet):
    """FDM: frames and a latent action, which enters at the input and at the lowest resolution, to the next frame."""

    def __init__(self, config: LAPOConfig) -> None:
        channels = config.forward_channels or config.channels
        super().__init__(3 * (config.frames - 1), channels, config.latent_dim, config.encoder, start=True)

    def forward(self, past: Tensor, z: Tensor) -> Tensor:
        """Frames (B, F - 1, 3, H, W), uint8 or float [0, 1], and latents (B, Z) to next frames (B, 3, H, W), float,
        about [0, 1].
        """
        past = normalise(past)
        return past[:, -1] + self.change(past.flatten(1, 2), z)


class LAPOPolicy(nn.Module):
    """LAPO's latent policy, and that of the methods after it: frames (B, 3, H, W), uint8 or float [0, 1], and the task
    int64 (B, 1) where it is told, to latent actions (B, Z); `config` are the settings of one of them.

    Note: LAPO's is of one task. Of several, a learned row of each enters where the forward model takes a latent: behind
    the first conv, and behind the encoder.
    """

    def __init__(self, config: Any, image_size: int, tasks: int = 0) -> None:
        super().__init__()
        self.network = EncoderMLP(config, 1, image_size)
        self.tasks, self._widths = tasks, (config.channels[0], config.hidden)
        self.told = nn.Embedding(tasks, sum(self._widths)) if tasks else None
        if self.told is not None:
            nn.init.normal_(self.told.weight, std=0.1)  # about as large as what it is added to

    def forward(self, pixels: Tensor, *task: Tensor) -> Tensor:
        return self.decide(self.features(pixels, *task))

    def features(self, observed: Tensor, *task: Tensor) -> Tensor:
        """Frames to the hidden layer, as one slot (B, 1, hidden)."""
        said = () if self.told is None else self.told(task[0][:, 0]).split(self._widths, dim=-1)
        return self.network.hidden(normalise(observed), *said)[:, None]

    def decide(self, features: Tensor, *task: Tensor) -> Tensor:  # noqa: ARG002
        return self.network.out(features[:, 0])


def pixel_actor(done: StageCheckpoint, own: Any, device: torch.device | str) -> Actor:
    """The actor of a finished policy, and of the decoder beside it."""
    env = done.sizes[1]
    build = partial(LAPOPolicy, own, env.image_size, len(env.tasks))
    parts = DecodedPolicy.load(done, build, own.latent_dim, own.hidden, device)
    return latent_actor(parts.policy, parts.action_decoder)


def sizes(done: StageCheckpoint) -> LAPOConfig:
    """Of a finished stage; the policies from before there was `encoder` are strided."""
    own = done.group(LAPOConfig, NAME)
    return own if "encoder" in done.config[NAME] else replace(own, encoder="strided")


def load_actor(run: Run, device: torch.device | str = "cpu") -> Actor:
    """The actor of a finished run; a CheckpointError where it is missing, damaged, or of another inverse model."""
    done = run.stage(NAME, MODEL.name)
    return pixel_actor(done, sizes(done), device)
