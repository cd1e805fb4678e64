"""What this machine can run: threads by its cores, and the least memory that sizes need, before any is allocated.

Every estimate is a lower bound: weights in fp32 with gradients and Adam's two moments, and of a batch what is certainly
there at once. What is refused would not have run; what is not may still be too large.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple, Protocol, runtime_checkable

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.baselines import baselines_of
from playslot_rl.config.model import InverseDynamicsConfig, PolicyConfig, PredictorConfig
from playslot_rl.config.sizes import shown
from playslot_rl.config.stages import DynamicsStageConfig, StageConfig
from playslot_rl.errors import ConfigError
from playslot_rl.runtime.threads import available_cores

ELSEWHERE: Final = frozenset({"submitit_slurm", "ray"})
"""Launchers whose jobs run on other machines."""
WEIGHT: Final = 16
"""Bytes of a trained weight: itself, its gradient and two moments."""
FLOAT: Final = 4
_THREADS, _THREADS_A_CORE = 64, 8
_LARGEST_ACCELERATOR: Final = 300 * 10**9
"""A batch may lie on an accelerator, whose memory is known only once torch is loaded."""
_DRIVERS: Final = ("/dev/nvidiactl", "/dev/kfd", "/dev/dxg", "/System/Library/Frameworks/Metal.framework")


class Need(NamedTuple):
    """Memory in bytes, at least, that is needed at once, and the keys or groups whose numbers it is made of; `host` is
    the machine itself, not an accelerator.
    """

    keys: tuple[str, ...]
    what: str
    size: float
    host: bool = True


@runtime_checkable
class Needy(Protocol):
    """Settings of a method that say what memory they need."""

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        """What networks, batches and buffers need, by the dotted name of these settings."""


def machine_memory() -> int:
    """Bytes of memory of this machine, or of the container where that has fewer; 2^63 where nobody says."""
    known = [2**63]
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        known.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for limit in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            known.append(int(Path(limit).read_text()))
        except (OSError, ValueError):
            continue  # no such limit
    return min(size for size in known if size > 0)


def require_machine(config: ExperimentConfig, typed: Mapping[str, str]) -> None:
    """Refuse typed sizes that cannot fit, and typed threads that would only wait for one another; not those of a
    comparison that a launcher runs on other machines.
    """
    if {config.compare.launcher, config.compare_video.launcher} & ELSEWHERE:
        return
    cores = available_cores()
    most = max(_THREADS, _THREADS_A_CORE * cores)
    if "threads" in typed and config.threads > most:
        raise ConfigError(f"threads: got {config.threads}, expected at most {most} for {cores} cores: use {cores}")
    memory = machine_memory()
    aside = config.device != "cpu" and any(Path(driver).exists() for driver in _DRIVERS)
    for need in needs(config):
        mine = [f"{key}={value}" for key, value in typed.items() if any(_meet(key, of) for of in need.keys)]
        limit = memory if need.host or not aside else max(memory, _LARGEST_ACCELERATOR)
        if mine and need.size > limit:
            raise ConfigError(
                f"{', '.join(mine)}: got sizes with which {need.what} need at least {shown(need.size)} of memory, "
                f"expected at most the {shown(limit)} there are: choose smaller ones"
            )


def _meet(key: str, group: str) -> bool:
    """Whether one of two dotted names is the other, or within it."""
    return f"{key}.".startswith(f"{group}.") or f"{group}.".startswith(f"{key}.")


def needs(config: ExperimentConfig) -> Iterator[Need]:
    """What a config's networks, batches and buffers need, whatever the command."""
    yield from _world_model(config)
    for name, own in baselines_of(config).items():
        if isinstance(own, Needy):
            yield from own.needs(f"baselines.{name}", config)
    frame = frame_numbers(config)
    slots = config.model.savi.n_slots * config.model.savi.slot_dim
    yield rollouts("dynamics", config.dynamics, config)
    # Masks and colours of each slot, and the slots' attention to the pixels.
    decoded = (config.model.savi.n_slots * 5 + 3) * frame / 3 + slots
    yield windows("slots", config.slots, config.slots.clip_frames * decoded, "model.savi")
    yield windows("behaviour", config.behaviour, slots, "model.savi")
    yield Need(("data.shuffle_buffer",), "the frames of the shuffle buffer", config.data.shuffle_buffer * frame)
    for name, steps in (("random", config.collect.random_steps), ("expert", config.collect.expert_steps)):
        yield Need((f"collect.{name}_steps",), "the frames of an episode", steps * frame)
    plan = config.plan
    plans = max(plan.candidates or 1, plan.descents) * (plan.horizon or 1)
    yield Need(("plan.candidates", "plan.descents", "plan.horizon"), "the plans", plans * slots * FLOAT, host=False)


def _world_model(config: ExperimentConfig) -> Iterator[Need]:
    savi, actions = config.model.savi, config.model.inverse_dynamics
    width, latent = savi.slot_dim, config.model.inverse_dynamics.latent_dim
    weights = 25 * chain(3, *savi.encoder_channels) + 9 * chain(width, *savi.decoder_channels)
    weights += savi.n_slots * width + 3 * savi.token_dim * width + savi.token_dim * savi.encoder_channels[-1]
    weights += 10 * width * width + 2 * width * (savi.corrector_mlp + savi.transition_mlp)
    yield Need(("model.savi",), "SAVi's weights", weights * WEIGHT)
    weights = _transformer(actions) + actions.dim * (width + latent) + actions.n_prototypes * latent
    keys = ("model.savi.slot_dim", "model.inverse_dynamics")
    yield Need(keys, "InvDyn's weights", weights * WEIGHT)
    yield predictor_weights("model.predictor", config.model.predictor, config)
    policy, decoder = config.model.policy, config.model.action_decoder
    weights = _transformer(policy) + policy.dim * (width + latent)
    yield Need(("model.savi.slot_dim", "model.policy"), "the policy's weights", weights * WEIGHT)
    weights = decoder.hidden_dim * (decoder.hidden_dim + latent)
    weights += decoder.state_layers * 4 * decoder.state_dim**2 + decoder.state_dim * width
    yield Need(("model.action_decoder",), "the action decoder's weights", weights * WEIGHT)


def predictor_weights(name: str, sizes: PredictorConfig, config: ExperimentConfig) -> Need:
    """Of a predictor of slots, whose config is called so."""
    weights = _transformer(sizes) + 2 * sizes.dim * config.model.savi.slot_dim + sizes.context * sizes.dim
    return Need(("model.savi.slot_dim", name), "the predictor's weights", weights * WEIGHT)


def rollouts(name: str, stage: DynamicsStageConfig, config: ExperimentConfig) -> Need:
    """Of a stage that predicts slots and decodes them."""
    slots = config.model.savi.n_slots * config.model.savi.slot_dim
    return windows(name, stage, (stage.seed_frames + stage.predicted_frames) * (slots + frame_numbers(config)))


def windows(name: str, stage: StageConfig, numbers: float, *more: str) -> Need:
    """Of a stage: the batch that a process holds at once, of so many numbers a window."""
    size = stage.batch_size / stage.optim.accumulate * numbers * FLOAT
    return Need((name, *more), "the windows of a batch", size, host=False)


def frame_numbers(config: ExperimentConfig) -> int:
    """Numbers of a frame."""
    return 3 * config.env.image_size**2


def chain(*widths: int) -> float:
    """Products of neighbouring widths, as of the weights between them."""
    return float(sum(left * right for left, right in pairwise(widths)))


def _transformer(sizes: InverseDynamicsConfig | PredictorConfig | PolicyConfig) -> float:
    """Weights of the layers."""
    return float(sizes.layers) * sizes.dim * (4 * sizes.heads * sizes.head_dim + 2 * sizes.mlp_dim)
