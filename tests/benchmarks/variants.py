"""The fast path and plainer ones: the same weights, data and random numbers, computed in other ways."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from playslot_rl.config import Precision
from playslot_rl.modules.predictors.cocvp import COCVP
from playslot_rl.modules.savi.decoder import BroadcastDecoder
from playslot_rl.speed.cases import CPU, Sizes, rollout_step
from playslot_rl.speed.steps import RandomStage, Step, fresh_agent

SHARED_BATCH = 4
"""Clips of SAVi's step where processes share it."""


@dataclass(frozen=True)
class Variant:
    """One way to compute a case; the defaults are the fast path.

    Attributes:
        collapse: collapsed first layer of the decoder.
        precision: of convolutions and transformers; `auto` is what this processor is fastest in.
        channels_last: memory format of the convolutions' maps.
        allocator: keep freed memory.
        cached: rollout with cached keys and values.
    """

    case: Literal["savi_step", "dynamics_step", "rollout_cache", "ddp_2"]
    collapse: bool = True
    precision: Precision = "auto"
    channels_last: bool = True
    allocator: bool = True
    cached: bool = True

    @property
    def plain(self) -> Variant:
        """As PyTorch comes."""
        return Variant(self.case, collapse=False, precision="fp32", channels_last=False, allocator=False, cached=False)


def savi_variants() -> dict[str, Variant]:
    """First layer, precision (fp32 in PyTorch's own memory format, bf16 in channels_last) and allocator: eight."""
    precisions: tuple[Precision, ...] = ("fp32", "bf16")
    return {
        f"{'collapsed' if collapse else 'plain'}_{precision}_{'allocator' if allocator else 'glibc'}": Variant(
            "savi_step", collapse, precision, precision == "bf16", allocator
        )
        for collapse, precision, allocator in itertools.product((False, True), precisions, (False, True))
    }


def dynamics_variants() -> dict[str, Variant]:
    """Plain, the same with single parts of the fast path, and the fast path."""
    fast = Variant("dynamics_step")
    return {
        "plain_fp32_glibc": fast.plain,
        "plain_fp32_allocator": replace(fast.plain, allocator=True),
        "collapsed_fp32_allocator": replace(fast.plain, allocator=True, collapse=True),
        "fast": fast,
    }


def rollout_variants() -> dict[str, Variant]:
    """Cached and full, all else equal."""
    return {"full": Variant("rollout_cache", cached=False), "cached": Variant("rollout_cache")}


def build_step(variant: Variant, sizes: Sizes) -> Step:
    """What computes a variant once."""
    torch.manual_seed(0)
    if variant.case == "rollout_cache":
        return rollout_step(sizes, COCVP.rollout if variant.cached else COCVP.rollout_full)
    agent = fresh_agent(sizes.config)
    model = agent.world_model
    model.savi.encoder.channels_last = variant.channels_last
    if isinstance(model.savi.decoder, BroadcastDecoder):
        model.savi.decoder.collapse, model.savi.decoder.channels_last = variant.collapse, variant.channels_last
    if not variant.cached and isinstance(model.predictor, COCVP):
        model.predictor.rollout = model.predictor.rollout_full  # type: ignore[method-assign]
    stage = "dynamics" if variant.case == "dynamics_step" else "slots"
    batch = SHARED_BATCH if variant.case == "ddp_2" else 0
    return RandomStage(sizes.config, stage, CPU, variant.precision, agent, batch).step()


def torchrl_search(sizes: Sizes) -> Step:
    """TorchRL's planner in the imagination environment, of as many predicted steps as our own."""
    from torchrl.modules.planners import CEMPlanner

    from playslot_rl.acting.planners import latent_statistics
    from playslot_rl.acting.planners.costs import SlotDistance
    from playslot_rl.acting.planners.torchrl_planning import latent_of, planning_env, planning_start
    from playslot_rl.runs import Run

    agent = Run.open("pretrained").load_agent()
    model, statistics = agent.world_model.eval().requires_grad_(False), latent_statistics(agent)
    candidates, iterations, horizon, elites = sizes.plan
    start, goal = torch.randn(2, *model.slot_shape)
    env = planning_env(model, SlotDistance(goal), statistics, horizon)
    planner = CEMPlanner(env, planning_horizon=horizon, optim_steps=iterations, num_candidates=candidates, top_k=elites)

    @torch.no_grad()
    def search() -> Tensor:
        return latent_of(statistics, planner(planning_start(env, start))["action"])

    return search
