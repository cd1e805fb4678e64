"""One step of each torch case. Losses are written out on the plain modules: importing TorchRL in the children's server
would take longer than some of the timing; a test holds them to the values of `playslot_rl.losses`.

Shapes: frames (B, T, 3, H, W) in [0, 1]; slots (B, T, N, D).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from playslot_rl.config import OptimConfig
from playslot_rl.modules.inverse_dynamics import InverseDynamics
from playslot_rl.modules.predictors.cocvp import COCVP
from playslot_rl.modules.savi import SAVi
from playslot_rl.modules.savi.decoder import BroadcastDecoder
from playslot_rl.speed.spec import Sizes, Variant
from playslot_rl.training.fit import build_adam, clip_gradients, trainable_parameters

Step = Callable[[], Tensor]
"""Computes once and returns a scalar, the loss where there is one."""

_OPTIM = OptimConfig(lr=1e-4)
_ACTION_DIM = 4


def build_step(variant: Variant, sizes: Sizes) -> Step:
    """Networks and data of a variant, the same for all variants, and the function to time."""
    torch.manual_seed(0)
    steps = {"savi_step": _savi_step, "dynamics_step": _dynamics_step, "rollout_cache": _rollout}
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
    latent = inverse(slots, generator=generator)
    rollout = predictor.rollout if variant.cached else predictor.rollout_full
    predicted = rollout(slots[:, :seed_frames], latent.prototype, latent.variability)
    slot_error = (predicted - slots[:, 1:]).square().mean()
    decoded, targets = predicted, frames[:, 1:]
    if variant.decoded_frames:
        order = torch.rand(decoded.shape[:2], generator=generator).argsort(dim=1)[:, : variant.decoded_frames]
        rows = torch.arange(len(decoded))[:, None]
        decoded, targets = decoded[rows, order], targets[rows, order]
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


def _training_step(modules: dict[str, torch.nn.Module], loss: Step) -> Step:
    parameters = trainable_parameters(modules)
    optimizer = build_adam(parameters, _OPTIM)

    def step() -> Tensor:
        optimizer.zero_grad(set_to_none=True)
        value = loss()
        value.backward()
        clip_gradients(parameters, _OPTIM.grad_clip)
        optimizer.step()
        return value.detach()

    return step
