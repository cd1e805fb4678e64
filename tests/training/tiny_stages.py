"""Every stage that `fit` trains, tiny, on a square that moves: six rows a batch, for one, two and three ranks."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from tiny_savi import tiny_savi
from torch import nn

from playslot_rl import keys
from playslot_rl.config import (
    ActionDecoderConfig,
    BehaviourStageConfig,
    DynamicsStageConfig,
    EnvConfig,
    ExperimentConfig,
    GridConfig,
    InverseDynamicsConfig,
    ModelConfig,
    OptimConfig,
    PolicyConfig,
    PredictorConfig,
    SAViConfig,
    SlotsStageConfig,
    StageConfig,
)
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import Demonstrations
from playslot_rl.data.drawn_clips import DrawnClips
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.losses.behaviour import BehaviourLoss
from playslot_rl.methods.caddy.method import CADDYConfig
from playslot_rl.methods.caddy.model import CADDY
from playslot_rl.methods.caddy.stage import CADDYStage
from playslot_rl.methods.clam.method import CLAMConfig
from playslot_rl.methods.clam.model import Forward, Inverse
from playslot_rl.methods.clam.training import CLAMStage
from playslot_rl.methods.frozen_encoder.method import AutoencoderBCConfig
from playslot_rl.methods.frozen_encoder.network import Autoencoder
from playslot_rl.methods.frozen_encoder.training import EncoderStage
from playslot_rl.methods.laom.method import LAOMConfig
from playslot_rl.methods.laom.training import LAOMStage
from playslot_rl.methods.laom.training import built as laom_built
from playslot_rl.methods.lapo.method import LAPOConfig
from playslot_rl.methods.lapo.model import ForwardModel, InverseModel
from playslot_rl.methods.lapo.training import LAPOModelStage
from playslot_rl.methods.resnet_oracle.network import ResNetPolicy
from playslot_rl.methods.supervised import LabelledMoves
from playslot_rl.methods.svg.method import SVGConfig
from playslot_rl.methods.svg.model import SVG
from playslot_rl.methods.svg.training import SVGStage
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.fit import Part
from playslot_rl.training.stage_behaviour import CloneStage, DecoderStage, FinetuneStage
from playslot_rl.training.stage_dynamics import DynamicsStage
from playslot_rl.training.stage_regression import FrameInputs, RegressionStage
from playslot_rl.training.stage_slots import SlotsStage
from playslot_rl.world_model import WorldModel

DEVICE = torch.device("cpu")
"""Where the stages are made; tests of a GPU set another."""
STEPS = 20
BATCH = 6
CADDY_STEPS = 8
"""It normalises a hundred times a step; 3 steps are its warm-up."""
OPTIM = OptimConfig(lr=1e-3, warmup_steps=2, grad_clip=0.05)
SETTINGS: dict[str, Any] = {
    "steps": STEPS,
    "batch_size": BATCH,
    "optim": OPTIM,
    "checkpoint_every": 10,
    "validate_every": 10,
    "log_every": 1,
}
SIZES = PolicyConfig(dim=16, layers=1, heads=2, head_dim=8, mlp_dim=16)


def videos(size: int) -> EpisodeFrames:
    """Six episodes of seven frames: a square that moves, over noise."""
    generator = np.random.default_rng(0)
    frames = generator.integers(0, 60, (42, size, size, 3), dtype=np.uint8)
    for t in range(42):
        at = (3 * t) % (size - 6)
        frames[t, at : at + 6, size // 4 : size // 4 + 6] = 200 - 20 * (t // 7)
    starts, lengths = np.arange(0, 42, 7, dtype=np.int64), np.full(6, 7, np.int64)
    actions = generator.uniform(-1, 1, (42, 2)).astype(np.float32)
    return EpisodeFrames(frames, starts, lengths, actions, None, "f", 10.0, "", "camera")


def clips(size: int, frames: int) -> Clips:
    return Clips(videos(size), frames, 0.4, 0)


def demonstrations() -> Demonstrations:
    draw = torch.Generator().manual_seed(0)
    slots, latents = torch.randn(30, 3, 16, generator=draw), torch.randn(30, 4, generator=draw)
    episode, step = torch.arange(30) // 6, torch.arange(30) % 6
    imagined, actions = slots + 0.1, torch.rand(30, 2, generator=draw) * 2 - 1
    made = (slots, imagined, latents, actions, episode, step, torch.full((5,), 6))
    return Demonstrations(*(part.to(DEVICE) for part in made))


def slots() -> Part:
    savi = tiny_savi(initial="gaussian").to(DEVICE)
    own = SlotsStageConfig(**SETTINGS, clip_frames=4, zoom_steps=8, foreground_weight=3.0)
    return Part("slots", SlotsStage(savi, clips(32, 4), own), own)


def drawn_clips(size: int, frames: int) -> DrawnClips:
    env = EnvConfig("grid_shapes", size, 4, grid=GridConfig(size=9))
    return DrawnClips(env, 1, videos(size), frames, 0.4, 0)


def dynamics(
    multi: bool = False, mode: Any = "hybrid", kind: Any = "cocvp", teacher: int = 5, drawn: bool = False
) -> Part:
    savi = SAViConfig(**vars(tiny_savi().config))
    inverse = InverseDynamicsConfig(
        variant="multi" if multi else "single",
        mode=mode,
        latent_dim=4,
        n_prototypes=4,
        dim=16,
        layers=1,
        heads=2,
        head_dim=8,
        mlp_dim=16,
        decay=0.8,
        dead_threshold=1.5,
    )
    predictor = PredictorConfig(kind=kind, dim=16, layers=1, heads=2, head_dim=8, mlp_dim=16)
    model = ModelConfig(savi=savi, inverse_dynamics=inverse, predictor=predictor)
    with global_seed(0, 0, "test"):
        world = WorldModel(model, EnvConfig(image_size=32, action_dim=2)).to(DEVICE)
        cached = torch.randn(42, 3, 16).numpy()
    own = DynamicsStageConfig(
        **SETTINGS, seed_frames=2, predicted_frames=3, decoded_frames=2, from_start=0.3, teacher_steps=teacher
    )
    return Part("dynamics", DynamicsStage(world, (drawn_clips if drawn else clips)(32, 5), cached, own), own)


def _behaviour() -> tuple[LatentPolicy, LatentPolicy, ActionDecoder, BehaviourStageConfig]:
    with global_seed(0, 0, "test"):
        sizes = replace(SIZES, whiten=True)
        policy, oracle = LatentPolicy(sizes, 16, 4), LatentPolicy(SIZES, 16, 2)
        decoder = ActionDecoder(
            ActionDecoderConfig(hidden_dim=8, reads_slots=True, state_dim=8, state_layers=1, state_heads=2), 4, 2, 16
        )
    for network in (policy, oracle, decoder):
        network.to(DEVICE)
    return policy, oracle, decoder, BehaviourStageConfig(**SETTINGS, labelled_demos=4, slot_noise=0.1)


def policy() -> Part:
    network, oracle, _, config = _behaviour()
    return Part("policy", CloneStage(network, oracle, demonstrations(), config, demonstrations()), config)


def decoder() -> Part:
    network, _, decoder, config = _behaviour()
    return Part("decoder", DecoderStage(decoder, network.eval(), demonstrations(), config), config)


def finetune() -> Part:
    network, oracle, decoder, config = _behaviour()
    clone = CloneStage(network, oracle, demonstrations(), config).stages["policy"]
    return Part("finetune", FinetuneStage(clone, decoder, demonstrations(), config), config)


def resnet() -> Part:
    data, config = videos(32), replace(_plain(), steps=2, checkpoint_every=2, validate_every=2)
    with global_seed(0, 0, "test"):
        network = ResNetPolicy(SIZES, 32, 2)
        # A thirteenth of the weights, and still blocks, shortcuts and BatchNorm.
        network.trunk.layer3 = nn.Sequential(nn.Conv2d(128, 256, 1, stride=2), nn.BatchNorm2d(256))
        network.trunk.layer4 = nn.Sequential(nn.Conv2d(256, 512, 1, stride=2), nn.BatchNorm2d(512))
    criterion = BehaviourLoss(network.to(DEVICE))
    criterion.set_keys(observation=keys.PIXELS, action=keys.ACTION)
    rows = np.arange(42)
    actions = torch.from_numpy(data.require_actions()).float().to(DEVICE)
    stage = RegressionStage("policy", criterion, FrameInputs(data, rows, DEVICE, 2), actions, BATCH)
    return Part("resnet", stage, config)


def svg() -> Part:
    config = SVGConfig(
        **SETTINGS | {"optim": replace(OPTIM, grad_clip=0.0)},
        channels=(4, 8),
        convs=(1, 1),
        features=6,
        latent_dim=3,
        hidden=8,
        seed_frames=2,
        predicted_frames=3,
        decoded_frames=2,
    )
    with global_seed(0, 0, "test"):
        model = SVG(config, 16).to(DEVICE)
    return Part("svg", SVGStage(model, clips(16, 5), config), config)


def caddy() -> Part:
    config = CADDYConfig(
        **SETTINGS | {"optim": replace(OPTIM, lr=4e-4, grad_clip=0.0), "steps": CADDY_STEPS, "validate_every": 4},
        encoder=(4, 4, 4, 8),
        dynamics=8,
        generator=(8, 4, 4),
        actions=3,
        latent_dim=2,
        seed_frames=2,
        predicted_frames=2,
        warmup_steps=3,
        first_frames=3,
        growth_steps=4,
    )
    with global_seed(0, 0, "test"):
        model = CADDY(config, 16).to(DEVICE)
    return Part("caddy", CADDYStage(model, clips(16, 4), config), config)


def lapo() -> Part:
    own = LAPOConfig(
        channels=(4, 8), forward_channels=(4, 8), hidden=16, groups=4, code_dim=4, codes=6, dead_threshold=1.5
    )
    with global_seed(0, 0, "test"):
        inverse, forward = InverseModel(own, 16).to(DEVICE), ForwardModel(own).to(DEVICE)
    return Part("lapo", LAPOModelStage(inverse, forward, clips(16, 2), _plain()), _plain())


def laom() -> Part:
    own = LAOMConfig(channels=(4, 8), hidden=16, latent_dim=4, offset=3, jitter=1, label_weight=1.0, model=_plain())
    with global_seed(0, 0, "test"):
        model, target = laom_built(own, 16, 2)
    videos = clips(16, 2)
    labelled = LabelledMoves(videos.source, ExperimentConfig(env=EnvConfig(action_dim=2)), DEVICE)
    return Part("laom", LAOMStage(model.to(DEVICE), target.to(DEVICE), videos, labelled, own), own.model)


def clam() -> Part:
    own = CLAMConfig(channels=(4, 8), hidden=16, latent_dim=4, model=_plain())
    with global_seed(0, 0, "test"):
        inverse, forward = Inverse(own, 16).to(DEVICE), Forward(own).to(DEVICE)
        decoder = ActionDecoder(ActionDecoderConfig(hidden_dim=8), 4, 2).to(DEVICE)
    videos = clips(16, 2)
    labelled = LabelledMoves(videos.source, ExperimentConfig(env=EnvConfig(action_dim=2)), DEVICE)
    return Part("clam", CLAMStage(inverse, forward, decoder, videos, labelled, own), own.model)


def autoencoder() -> Part:
    own = AutoencoderBCConfig(channels=(4, 8, 8, 8), model=_plain())
    with global_seed(0, 0, "test"):
        network = Autoencoder(own).to(DEVICE)
    return Part("autoencoder", EncoderStage("autoencoder", network, clips(32, 1), own.model), own.model)


@contextlib.contextmanager
def in_double(wanted: bool) -> Iterator[None]:
    """Compute everything in double precision, also what the library says is float32."""
    as_float = torch.Tensor.float
    if wanted:
        torch.set_default_dtype(torch.float64)
        torch.Tensor.float = torch.Tensor.double  # type: ignore[method-assign, assignment]
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)
        torch.Tensor.float = as_float  # type: ignore[method-assign]


def _plain() -> StageConfig:
    return StageConfig(**SETTINGS)


DOUBLE = ("slots", "resnet", "svg", "caddy", "lapo")
"""In double precision: BatchNorm divides by small spreads, Adam by small gradients, and together they turn the rounding
of a batch's mean into another curve within a few steps, as another number of threads does. Slots that still share all
pixels do likewise.
"""
BY_BATCH = ("resnet", "svg", "caddy", "lapo")
"""They normalise by their whole batch and do not accumulate."""
STAGES: dict[str, Callable[[], Part]] = {
    "slots": slots,
    "dynamics": dynamics,
    "dynamics of many agents": lambda: dynamics(multi=True),
    "dynamics of drawn clips": lambda: dynamics(drawn=True),
    "slotformer": lambda: dynamics(mode="none", kind="slotformer"),
    "ocvp_seq": lambda: dynamics(mode="none", kind="ocvp_seq"),
    "policy": policy,
    "decoder": decoder,
    "finetune": finetune,
    "resnet": resnet,
    "svg": svg,
    "caddy": caddy,
    "lapo": lapo,
    "laom": laom,
    "clam": clam,
    "autoencoder": autoencoder,
}
