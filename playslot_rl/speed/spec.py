"""What is timed: the sizes, and the variants of each case.

Symbols: B batch, T frames, N slots.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from typing import Literal

from playslot_rl.config import ModelConfig, Precision, PredictorConfig, SAViConfig

Case = Literal["savi_step", "dynamics_step", "rollout_cache"]


@dataclass(frozen=True)
class Sizes:
    """Sizes and repeats; the defaults are the paper's model, with batches small enough for two CPU cores.

    Attributes:
        model: all networks.
        image_size: side of the frames, pixels.
        savi_batch, savi_frames: clips and frames of SAVi's training step.
        dynamics_batch, seed_frames, predicted_frames: clips and frames of the dynamics step.
        decoded_frames: predicted frames that its extra row decodes.
        rollout_batch, rollout_slots, rollout_steps: of the rollout.
        episodes, episode_frames: the data set that windows are read from.
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
    dynamics_batch: int = 2
    seed_frames: int = 6
    predicted_frames: int = 8
    decoded_frames: int = 2
    rollout_batch: int = 64
    rollout_slots: int = 8
    rollout_steps: int = 15
    episodes: int = 40
    episode_frames: int = 21
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
        model=small, image_size=32, savi_batch=1, savi_frames=2, dynamics_batch=1, seed_frames=2, predicted_frames=2,
        decoded_frames=1, rollout_batch=2, rollout_slots=3, rollout_steps=5, episodes=3, episode_frames=8, window=4,
        window_batch=2, loader_batches=1, cache_batches=2, fast_frames=2, full_frames=1, repeats=1,
    )  # fmt: skip


@dataclass(frozen=True)
class Variant:
    """One way to compute a case; the defaults are the fast path.

    Attributes:
        case: what is computed.
        collapse: collapsed first layer of the decoder.
        precision: of the convolutions.
        channels_last: memory format of the convolutions' maps.
        allocator: keep freed memory (`playslot_rl.allocator`).
        cached: rollout with cached keys and values.
        decoded_frames: predicted frames decoded for the image loss; 0 decodes all.
    """

    case: Case
    collapse: bool = True
    precision: Precision = "bf16"
    channels_last: bool = True
    allocator: bool = True
    cached: bool = True
    decoded_frames: int = 0


def plain(case: Case) -> Variant:
    """The plain computation in fp32, as PyTorch comes."""
    return Variant(case, collapse=False, precision="fp32", channels_last=False, allocator=False, cached=False)


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
    base = plain("dynamics_step")
    fast = Variant("dynamics_step")
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
