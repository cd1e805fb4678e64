"""What is timed: the sizes, the variants of each case, and one step of each torch case.

Losses are written out on the plain modules: importing TorchRL in the children's server would take longer than some of
the timing; a test holds them to the values of `playslot_rl.losses`.

Shapes: frames (B, T, 3, H, W) in [0, 1]; slots (B, T, N, D).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor

from playslot_rl.config import EnvConfig, ModelConfig, OptimConfig, Precision, PredictorConfig, SAViConfig
from playslot_rl.losses.common import draw_frames, of_frames
from playslot_rl.modules.inverse_dynamics import InverseDynamics
from playslot_rl.modules.predictors.cocvp import COCVP
from playslot_rl.modules.savi import SAVi
from playslot_rl.modules.savi.decoder import BroadcastDecoder
from playslot_rl.runtime.precision import autocast, native_bf16
from playslot_rl.training.fit import build_adam, clip_gradients, trainable_parameters

if TYPE_CHECKING:
    from playslot_rl.world_model import WorldModel

Case = Literal["savi_step", "dynamics_step", "rollout_cache", "play_step", "plan_step", "ddp_2"]


@dataclass(frozen=True)
class Sizes:
    """Sizes and repeats; the defaults are the paper's model, with batches small enough for two CPU cores.

    Attributes:
        model: all networks.
        image_size: side of the frames, pixels.
        savi_batch, savi_frames: clips and frames of SAVi's training step.
        shared_batch: clips of that step where processes share it.
        dynamics_batch, seed_frames, predicted_frames: clips and frames of the dynamics step.
        decoded_frames: predicted frames that its extra row decodes.
        rollout_batch, rollout_slots, rollout_steps: of the rollout.
        play_slots, play_steps: of a game: four slots are what a task has, the steps fill the predictor's context.
        plan_candidates, plan_iterations, plan_horizon, plan_elites: of a search.
        episodes, episode_frames: the data set that windows are read from.
        parsed: episodes of it that are parsed into slots.
        window, window_batch: frames a window, windows a batch.
        loader_batches: batches a repeat that LeRobotDataset + DataLoader delivers.
        cache_batches: batches a repeat that the frame cache delivers.
        fast_frames, full_frames: frames drawn in a repeat by either renderer.
        repeats: timed rounds of each case, after one that is not counted.
    """

    model: ModelConfig = field(default_factory=ModelConfig)
    image_size: int = 64
    savi_batch: int = 2
    savi_frames: int = 4
    shared_batch: int = 4
    dynamics_batch: int = 2
    seed_frames: int = 6
    predicted_frames: int = 8
    decoded_frames: int = 2
    rollout_batch: int = 64
    rollout_slots: int = 8
    rollout_steps: int = 15
    play_slots: int = 4
    play_steps: int = 30
    plan_candidates: int = 64
    plan_iterations: int = 8
    plan_horizon: int = 16
    plan_elites: int = 8
    episodes: int = 40
    episode_frames: int = 21
    parsed: int = 8
    window: int = 14
    window_batch: int = 32
    loader_batches: int = 6
    cache_batches: int = 60
    fast_frames: int = 40
    full_frames: int = 8
    repeats: int = 3


def quick_sizes() -> Sizes:
    """Sizes that show that everything runs; the figures mean nothing (`preset=smoke`, tests)."""
    savi = SAViConfig(slot_dim=32, encoder_channels=(8, 8, 8, 8), decoder_channels=(8, 8), token_dim=32)
    small = ModelConfig(
        savi=savi,
        inverse_dynamics=replace(ModelConfig().inverse_dynamics, dim=32, layers=1, mlp_dim=64),
        predictor=PredictorConfig(dim=32, layers=1, heads=2, head_dim=16, mlp_dim=64),
    )
    return Sizes(
        model=small, image_size=32, savi_batch=1, savi_frames=2, shared_batch=2, dynamics_batch=1, seed_frames=2,
        predicted_frames=2, decoded_frames=1, rollout_batch=2, rollout_slots=3, rollout_steps=5, play_slots=3,
        play_steps=2, plan_candidates=4, plan_iterations=1, plan_horizon=2, plan_elites=2, episodes=3,
        episode_frames=8, parsed=2, window=4, window_batch=2, loader_batches=1,
        cache_batches=2, fast_frames=2, full_frames=1, repeats=1,
    )  # fmt: skip


@dataclass(frozen=True)
class Variant:
    """One way to compute a case; the defaults are the fast path.

    Attributes:
        case: what is computed.
        collapse: collapsed first layer of the decoder.
        precision: of convolutions and transformers; `auto` is what this processor is fastest in.
        channels_last: memory format of the convolutions' maps.
        allocator: keep freed memory (`playslot_rl.runtime.allocator`).
        cached: rollout with cached keys and values; of a search, our own planner.
        decoded_frames: predicted frames decoded for the image loss; 0 decodes all.
        shipped: the world model that ships for ButtonPress, in the place of `Sizes.model`.
        rank, world, port: which of how many processes it is, and where they meet.
    """

    case: Case
    collapse: bool = True
    precision: Precision = "auto"
    channels_last: bool = True
    allocator: bool = True
    cached: bool = True
    decoded_frames: int = 0
    shipped: bool = False
    rank: int = 0
    world: int = 1
    port: int = 0


def savi_variants() -> dict[str, Variant]:
    """First layer, precision (fp32 in PyTorch's own memory format, bf16 in channels_last) and allocator: eight."""
    precisions: tuple[Precision, ...] = ("fp32", "bf16")
    found = {}
    for collapse, precision, allocator in itertools.product((False, True), precisions, (False, True)):
        name = f"{'collapsed' if collapse else 'plain'}_{precision}_{'allocator' if allocator else 'glibc'}"
        found[name] = Variant("savi_step", collapse, precision, precision == "bf16", allocator)
    return found


def dynamics_variants(decoded_frames: int) -> dict[str, Variant]:
    """Plain, the same with single parts of the fast path, the fast path, and fewer decoded frames on top."""
    fast = Variant("dynamics_step")
    base = replace(fast, collapse=False, precision="fp32", channels_last=False, allocator=False, cached=False)
    return {
        "plain_fp32_glibc": base,
        "plain_fp32_allocator": replace(base, allocator=True),
        "collapsed_fp32_allocator": replace(base, allocator=True, collapse=True),
        "fast": fast,
        f"fast_{decoded_frames}_decoded": replace(fast, decoded_frames=decoded_frames),
    }


def rollout_variants() -> dict[str, Variant]:
    """Cached and full, all else equal."""
    return {"full": Variant("rollout_cache", cached=False), "cached": Variant("rollout_cache")}


def play_variants() -> dict[str, Variant]:
    """The shipped model as `playslot play` runs it, in fp32, and one of the paper's sizes in both precisions."""
    plain = Variant("play_step", precision="fp32", channels_last=False)
    return {
        "shipped": replace(plain, shipped=True),
        "paper_fp32": plain,
        "paper_bf16": Variant("play_step", precision="bf16"),
    }


def computed_here(variants: Mapping[str, Variant]) -> dict[str, Variant]:
    """Without those in bf16 where this processor only emulates it: they would take most of the benchmark's time."""
    return {name: own for name, own in variants.items() if own.precision != "bf16" or native_bf16("cpu")}


Step = Callable[[], Tensor]
"""Computes once and returns a scalar, the loss where there is one."""

OPTIM = OptimConfig(lr=1e-4)
_ACTION_DIM = 4


def build_step(variant: Variant, sizes: Sizes) -> Step:
    """Networks and data of a variant, the same for all variants, and the function to time."""
    torch.manual_seed(0)
    from playslot_rl.speed.plan import plan_step
    from playslot_rl.speed.several import several_step

    steps: dict[Case, Callable[[Variant, Sizes], Step]] = {
        "savi_step": _savi_step, "dynamics_step": _dynamics_step, "rollout_cache": _rollout, "play_step": _play,
        "plan_step": plan_step, "ddp_2": several_step,
    }  # fmt: skip
    return steps[variant.case](variant, sizes)


def build_savi(variant: Variant, sizes: Sizes) -> SAVi:
    """SAVi as the variant computes it."""
    savi = SAVi(sizes.model.savi, sizes.image_size)
    savi.precision = variant.precision
    savi.encoder.channels_last = variant.channels_last
    if isinstance(savi.decoder, BroadcastDecoder):
        savi.decoder.collapse, savi.decoder.channels_last = variant.collapse, variant.channels_last
    return savi


def slots_loss(savi: SAVi, frames: Tensor, generator: torch.Generator) -> Tensor:
    """Stage 1's loss, as `SlotsLoss`."""
    slots, _ = savi(frames, generator=generator)
    return (savi.decode(slots).frames - frames).square().mean()


def dynamics_loss(
    inverse: InverseDynamics,
    predictor: COCVP,
    savi: SAVi,
    slots: Tensor,
    frames: Tensor,
    variant: Variant,
    seed_frames: int,
    generator: torch.Generator,
) -> Tensor:
    """Stage 2's loss, as `DynamicsLoss` with the default weights."""
    with autocast(slots.device.type, variant.precision):
        latent = inverse(slots, generator=generator)
        rollout = predictor.rollout if variant.cached else predictor.rollout_full
        predicted = rollout(slots[:, :seed_frames], latent.prototype, latent.variability)
    slot_error = (predicted - slots[:, 1:]).square().mean()
    decoded, targets = predicted, frames[:, 1:]
    batch, steps = decoded.shape[:2]
    chosen = draw_frames(batch, steps, variant.decoded_frames, generator)
    if chosen is not None:
        decoded, targets = of_frames(decoded, chosen), of_frames(targets, chosen)
    image_error = (savi.decode(decoded).frames - targets).square().mean()
    total: Tensor = image_error + slot_error + 0.25 * latent.vq_loss
    return total


def _savi_step(variant: Variant, sizes: Sizes) -> Step:
    savi = build_savi(variant, sizes)
    frames = torch.rand(sizes.savi_batch, sizes.savi_frames, 3, sizes.image_size, sizes.image_size)
    generator = torch.Generator().manual_seed(0)
    return _training_step({"savi": savi}, lambda: slots_loss(savi, frames, generator))


def _dynamics_step(variant: Variant, sizes: Sizes) -> Step:
    savi = build_savi(variant, sizes).eval().requires_grad_(False)
    dim, config = sizes.model.savi.slot_dim, sizes.model
    inverse = InverseDynamics(config.inverse_dynamics, dim, _ACTION_DIM)
    predictor = COCVP(config.predictor, dim, inverse.latent_dim)
    t = sizes.seed_frames + sizes.predicted_frames
    # Slots come from the slot cache in training, so parsing is no part of the step.
    slots = torch.randn(sizes.dynamics_batch, t, config.savi.n_slots, dim)
    frames = torch.rand(sizes.dynamics_batch, t, 3, sizes.image_size, sizes.image_size)
    generator = torch.Generator().manual_seed(0)

    def loss() -> Tensor:
        return dynamics_loss(inverse, predictor, savi, slots, frames, variant, sizes.seed_frames, generator)

    return _training_step({"inverse_dynamics": inverse, "predictor": predictor}, loss)


def _rollout(variant: Variant, sizes: Sizes) -> Step:
    dim, z = sizes.model.savi.slot_dim, sizes.model.inverse_dynamics.latent_dim
    predictor = COCVP(sizes.model.predictor, dim, z).eval()
    seed = torch.randn(sizes.rollout_batch, 1, sizes.rollout_slots, dim)
    p, v = (torch.randn(sizes.rollout_batch, sizes.rollout_steps, z) for _ in range(2))
    rollout = predictor.rollout if variant.cached else predictor.rollout_full

    @torch.no_grad()
    def step() -> Tensor:
        return rollout(seed, p, v).square().mean()

    return step


def _play(variant: Variant, sizes: Sizes) -> Step:
    """A game from its start: each step is predicted, decoded and encoded as what the page sends."""
    from playslot_rl.play.pictures import encode, strip, with_masks
    from playslot_rl.play.session import PlaySession
    from playslot_rl.play.starts import Start
    from playslot_rl.runs import Run

    model = Run.open("pretrained").load_world_model() if variant.shipped else _play_model(variant, sizes)
    session, side = PlaySession(model), model.env.image_size
    first = Start("", np.zeros((side, side, 3), np.uint8), torch.randn(1, *model.slot_shape))

    @torch.no_grad()
    def step() -> Tensor:
        session.begin(first)
        for number in range(sizes.play_steps):
            session.press(number % len(session.prototypes), 1.0)
            look = session.look()
            encode(look.frame)
            encode(with_masks(look))
            encode(strip(look, session, None, 4))
        return session.slots.square().mean()

    return step


def _play_model(variant: Variant, sizes: Sizes) -> WorldModel:
    from playslot_rl.world_model import WorldModel

    savi = replace(sizes.model.savi, n_slots=sizes.play_slots)
    model = WorldModel(replace(sizes.model, savi=savi), EnvConfig(image_size=sizes.image_size))
    model.savi = build_savi(variant, replace(sizes, model=replace(sizes.model, savi=savi)))
    model.inverse_dynamics.split(torch.randn(64, model.inverse_dynamics.latent_dim))  # sets the codebook
    return model.eval()


def training_step(modules: Mapping[str, torch.nn.Module], backward: Step) -> Step:
    """Clipping and Adam around a backward pass, which says its loss."""
    parameters = trainable_parameters(modules)
    optimizer = build_adam(parameters, OPTIM)

    def step() -> Tensor:
        optimizer.zero_grad(set_to_none=True)
        value = backward()
        clip_gradients(parameters, OPTIM.grad_clip)
        optimizer.step()
        return value.detach()

    return step


def _training_step(modules: Mapping[str, torch.nn.Module], loss: Step) -> Step:
    def backward() -> Tensor:
        value = loss()
        value.backward()
        return value

    return training_step(modules, backward)
