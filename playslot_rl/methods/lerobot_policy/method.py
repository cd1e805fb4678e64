"""ACT (Zhao et al., 2023) and Diffusion Policy (Chi et al., 2023) as LeRobot has them; their settings.

Networks, losses, processors and optimisers are LeRobot's (`lerobot.policies`), and so are the names' meanings and the
defaults; frames, rows, seeds, checkpoints and the loop are ours.

The camera is their input; of `act_state` and `diffusion_state` the robot's proprioception, too.

Note: a chunk has 20 actions at most, LeRobot's defaults 100 and 64: episodes here have 20 to 25.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import ClassVar, Final, Literal

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import WEIGHT, Need, frame_numbers, windows
from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.plain import check
from playslot_rl.config.roles import COUNT, NOT_NEGATIVE, at_least, below_one, between
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.config.stages import OptimConfig, StageConfig
from playslot_rl.errors import ConfigError
from playslot_rl.methods.resnet_oracle.method import require_weights

MOST: Final = 20
"""Actions of a chunk: demonstrations are hardly longer."""


@dataclass(frozen=True)
class ChunkConfig(StageConfig):
    """What both have.

    Attributes:
        chunk: actions predicted at once, at most: no more than the longest labelled demonstration has.
        executed: of them executed before the next are predicted; 0 executes all.
        shift: shift of frames in training, pixels; those of one input are shifted alike.
        weights: of ResNet-18, as `baselines.resnet_oracle.weights`.
        weight_decay: of the optimiser.
    """

    frames: ClassVar[int] = 1
    drops: ClassVar[bool] = False

    steps: int = field(default=100_000, metadata=at_least(1))
    batch_size: int = field(default=8, metadata=at_least(1))
    chunk: int = field(default=MOST, metadata=between(1, MOST, f"1 to {MOST}"))
    executed: int = field(default=0, metadata=between(0, MOST, f"0 (all) to {MOST}"))
    shift: int = field(default=0, metadata=between(0, 16, "0 to 16 pixels"))
    weights: str = "auto"
    weight_decay: float = field(default=1e-4, metadata=NOT_NEGATIVE)

    def check(self, name: str, config: ExperimentConfig) -> None:  # noqa: ARG002
        require_weights(name, self.weights)

    def sized(self, longest: int) -> int:
        """Actions of a chunk where the longest demonstration has so many."""
        return min(self.chunk, longest)

    def kept(self, chunk: int) -> int:
        """Of a chunk, the actions that are executed."""
        return min(self.executed or chunk, chunk)


@dataclass(frozen=True)
class ACTConfig(ChunkConfig):
    """ACT.

    Attributes:
        dim: width of the transformers.
        heads: attention heads, a divisor of `dim`.
        mlp_dim: hidden width of their feed-forward layers.
        layers: of the encoder; the decoder has one, as the original's.
        vae_layers: of the VAE's encoder of a chunk, which only training has.
        latent_dim: width of its latent.
        kl_weight: weight of the KL term.
        dropout: in the transformers.
    """

    group = "baselines.act."
    optim: OptimConfig = field(
        default_factory=lambda: OptimConfig(lr=1e-5, warmup_steps=0, schedule="constant", grad_clip=10.0)
    )
    dim: int = field(default=512, metadata=COUNT)
    heads: int = field(default=8, metadata=at_least(1))
    mlp_dim: int = field(default=3200, metadata=COUNT)
    layers: int = field(default=4, metadata=at_least(1, largest=64))
    vae_layers: int = field(default=4, metadata=at_least(1, largest=64))
    latent_dim: int = field(default=32, metadata=COUNT)
    kl_weight: float = field(default=10.0, metadata=NOT_NEGATIVE)
    dropout: float = field(default=0.1, metadata=below_one())

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self.dim % (2 * self.heads) == 0, "baselines.act.dim", self.dim, f"a multiple of {2 * self.heads}")

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        yield windows(name, self, frame_numbers(config))
        layers = self.layers + self.vae_layers + 1
        yield Need((name,), "ACT's weights", layers * self.dim * (4 * self.dim + 2 * self.mlp_dim) * WEIGHT)


@dataclass(frozen=True)
class DiffusionConfig(ChunkConfig):
    """Diffusion Policy, its U-Net over the chunk.

    Attributes:
        frames: the last so many are seen.
        channels: of the U-Net's levels, each of which halves the chunk: `chunk` is cut to a multiple of 2 to their
            number.
        keypoints: of the spatial softmax over the image's features.
        crop: side of random crops in training, of the middle otherwise; 0 takes whole frames.
        noise_steps: of the diffusion in training.
        denoising_steps: from noise to a chunk; 0 takes `noise_steps`.
        scheduler: `DDPM`, or `DDIM`, which needs fewer steps.
    """

    group = "baselines.diffusion."
    drops = True
    optim: OptimConfig = field(
        default_factory=lambda: OptimConfig(lr=1e-4, warmup_steps=500, schedule="cosine", grad_clip=10.0)
    )
    chunk: int = field(default=16, metadata=between(1, MOST, f"1 to {MOST}"))
    executed: int = field(default=8, metadata=between(0, MOST, f"0 (all) to {MOST}"))
    weight_decay: float = field(default=1e-6, metadata=NOT_NEGATIVE)
    frames: int = field(default=2, metadata=between(1, 16, "1 to 16"))  # type: ignore[misc]  # a key here
    channels: tuple[int, ...] = field(default=(512, 1024, 2048), metadata=COUNT)
    keypoints: int = field(default=32, metadata=COUNT)
    crop: int = field(default=0, metadata=NOT_NEGATIVE)
    noise_steps: int = field(default=100, metadata=at_least(1, largest=10_000))
    denoising_steps: int = field(default=0, metadata=at_least(0, "0 (as many) to 10000", 10_000))
    scheduler: Literal["DDPM", "DDIM"] = "DDPM"

    def __post_init__(self) -> None:
        super().__post_init__()
        check(1 <= len(self.channels) <= 4, "baselines.diffusion.channels", self.channels, "1 to 4 widths")
        check(all(c % 8 == 0 for c in self.channels), "baselines.diffusion.channels", self.channels, "multiples of 8")
        levels = 2 ** len(self.channels)
        check(self.chunk >= levels, "baselines.diffusion.chunk", self.chunk, f"{levels} at least for its U-Net")
        most = self.noise_steps
        check(
            self.denoising_steps <= most, "baselines.diffusion.denoising_steps", self.denoising_steps, f"up to {most}"
        )

    def check(self, name: str, config: ExperimentConfig) -> None:
        super().check(name, config)
        require_diffusers()
        if self.crop > config.env.image_size:
            raise ConfigError(f"{name}.crop: got {self.crop}, expected at most env.image_size={config.env.image_size}")

    def sized(self, longest: int) -> int:
        levels: int = 2 ** len(self.channels)
        return max(1, super().sized(longest) // levels) * levels

    def kept(self, chunk: int) -> int:
        return min(self.executed or chunk, chunk - self.frames + 1)

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        yield windows(name, self, self.frames * frame_numbers(config))
        weights = sum(5 * 4 * width * width for width in self.channels)
        yield Need((name,), "the U-Net's weights", weights * WEIGHT)


def require_diffusers() -> None:
    """Refuse Diffusion Policy where its library is missing, by a ConfigError that names the extra."""
    if find_spec("diffusers") is None:
        raise ConfigError(
            "method=diffusion: got no package diffusers, expected it: pip install 'playslot_rl[diffusion]'"
        )


def _method(
    name: str, titles: tuple[str, ...], style: Style, config: type[ChunkConfig] | None, group: str = ""
) -> Method:
    """A method with settings of its own, or with proprioception and those of the method `group`."""
    stage = StageSpec(
        name,
        keys=("behaviour.trim_pixels", "behaviour.trim_margin"),
        settings=(f"baselines.{group or name}",),
        data="labelled",
        parts=f"playslot_rl.methods.lerobot_policy.training:{'with_state' if group else 'training'}",
        names={f"baselines.{group}": name} if group else {},
    )
    return Method(
        name, titles, style, config, (stage,),
        Load(actor=f"playslot_rl.methods.lerobot_policy.actor:load_{name}"), told="task",
    )  # fmt: skip


ACT: Final = _method("act", ("ACT",), Style(6, "d"), ACTConfig)
DIFFUSION: Final = _method("diffusion", ("Diffusion Policy",), Style(7, "h"), DiffusionConfig)
ACT_STATE: Final = _method("act_state", ("ACT with state",), Style(6, "$A$"), None, "act")
DIFFUSION_STATE: Final = _method(
    "diffusion_state", ("Diffusion Policy with state",), Style(7, "$D$"), None, "diffusion"
)
