"""What this machine can run: threads by its cores, and the least memory that sizes need, before any is allocated.

Every estimate is a lower bound: weights in fp32 with their gradients and Adam's two moments, and of a batch only what
is certainly there at once. So what is refused would not have run, and what is not may still be too large.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.baselines import OnlineConfig
from playslot_rl.config.model import InverseDynamicsConfig, PolicyConfig, PredictorConfig
from playslot_rl.config.sizes import shown
from playslot_rl.config.stages import DynamicsStageConfig, StageConfig
from playslot_rl.config.video import VideoStageConfig
from playslot_rl.errors import ConfigError
from playslot_rl.runtime.threads import available_cores

ELSEWHERE: Final = frozenset({"submitit_slurm", "ray"})
"""Launchers whose jobs run on other machines."""
_WEIGHT: Final = 16
"""Bytes of a trained weight: itself, its gradient and two moments."""
_FLOAT: Final = 4
_THREADS, _THREADS_A_CORE = 64, 8
_LARGEST_ACCELERATOR: Final = 300 * 10**9
"""A batch may lie on an accelerator, whose memory is known only once torch is loaded."""
_DRIVERS: Final = ("/dev/nvidiactl", "/dev/kfd", "/dev/dxg", "/System/Library/Frameworks/Metal.framework")


class Need(NamedTuple):
    """Memory that is needed at once.

    Attributes:
        keys: keys or groups whose numbers it is made of.
        what: in words.
        size: bytes, at least.
        host: of the machine itself, not of an accelerator.
    """

    keys: tuple[str, ...]
    what: str
    size: float
    host: bool = True


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
    """Refuse typed sizes that cannot fit, and typed threads that would only wait for one another.

    Args:
        config: of the command. A comparison that a launcher runs on other machines is left to them.
        typed: dotted keys and values that were typed; what none of them changes was accepted when it was made.

    Raises:
        ConfigError: with the estimate and what there is.
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
    yield from _baselines(config)
    frame = _frame(config)
    slots = config.model.savi.n_slots * config.model.savi.slot_dim
    stages = {"dynamics": config.dynamics, "baselines.slotformer": config.baselines.slotformer}
    stages["baselines.ocvp_seq"] = config.baselines.ocvp_seq
    for name, stage in stages.items():
        yield _clips(name, stage, (stage.seed_frames + stage.predicted_frames) * (slots + frame))
    # Masks and colours of each slot, and the slots' attention to the pixels.
    decoded = (config.model.savi.n_slots * 5 + 3) * frame / 3 + slots
    yield _clips("slots", config.slots, config.slots.clip_frames * decoded, "model.savi")
    yield _clips("behaviour", config.behaviour, slots, "model.savi")
    yield Need(("data.shuffle_buffer",), "the frames of the shuffle buffer", config.data.shuffle_buffer * frame)
    for name, steps in (("random", config.collect.random_steps), ("expert", config.collect.expert_steps)):
        yield Need((f"collect.{name}_steps",), "the frames of an episode", steps * frame)
    plan = config.plan
    plans = max(plan.candidates or 1, plan.descents) * (plan.horizon or 1)
    yield Need(("plan.candidates", "plan.descents", "plan.horizon"), "the plans", plans * slots * _FLOAT, host=False)


def _world_model(config: ExperimentConfig) -> Iterator[Need]:
    savi, actions = config.model.savi, config.model.inverse_dynamics
    width, latent = savi.slot_dim, config.model.inverse_dynamics.latent_dim
    weights = 25 * _chain(3, *savi.encoder_channels) + 9 * _chain(width, *savi.decoder_channels)
    weights += savi.n_slots * width + 3 * savi.token_dim * width + savi.token_dim * savi.encoder_channels[-1]
    weights += 10 * width * width + 2 * width * (savi.corrector_mlp + savi.transition_mlp)
    yield Need(("model.savi",), "SAVi's weights", weights * _WEIGHT)
    weights = _transformer(actions) + actions.dim * (width + latent) + actions.n_prototypes * latent
    keys = ("model.savi.slot_dim", "model.inverse_dynamics")
    yield Need(keys, "InvDyn's weights", weights * _WEIGHT)
    predictors = {"model.predictor": config.model.predictor}
    predictors["baselines.slotformer.predictor"] = config.baselines.slotformer.predictor
    predictors["baselines.ocvp_seq.predictor"] = config.baselines.ocvp_seq.predictor
    for name, predictor in predictors.items():
        weights = _transformer(predictor) + 2 * predictor.dim * width + predictor.context * predictor.dim
        yield Need(("model.savi.slot_dim", name), "the predictor's weights", weights * _WEIGHT)
    policy, decoder = config.model.policy, config.model.action_decoder
    weights = _transformer(policy) + policy.dim * (width + latent)
    yield Need(("model.savi.slot_dim", "model.policy"), "the policy's weights", weights * _WEIGHT)
    weights = decoder.hidden_dim * (decoder.hidden_dim + latent)
    weights += decoder.state_layers * 4 * decoder.state_dim**2 + decoder.state_dim * width
    yield Need(("model.action_decoder",), "the action decoder's weights", weights * _WEIGHT)


def _baselines(config: ExperimentConfig) -> Iterator[Need]:
    own, frame, slots = config.baselines, _frame(config), config.model.savi.n_slots * config.model.savi.slot_dim
    stages = {"resnet_oracle": own.resnet_oracle, "lapo.model": own.lapo.model, "lapo.policy": own.lapo.policy}
    stages |= {"caddy_policy.policy": own.caddy_policy.policy, "caddy_oracle.policy": own.caddy_oracle.policy}
    for name, stage in (stages | {"svg": own.svg, "caddy": own.caddy}).items():
        frames = stage.seed_frames + stage.predicted_frames if isinstance(stage, VideoStageConfig) else 1
        yield _clips(f"baselines.{name}", stage, frames * frame)
    lapo, svg, caddy, dreamer, sold = own.lapo, own.svg, own.caddy, own.dreamer, own.sold
    weights = 9 * _chain(3, *lapo.channels) + lapo.hidden * (lapo.channels[-1] + lapo.latent_dim)
    weights += lapo.codes * lapo.code_dim
    yield Need(("baselines.lapo",), "LAPO's weights", weights * _WEIGHT)
    weights = 9 * _chain(3, *svg.channels) + svg.features * svg.channels[-1]
    weights += svg.hidden * (svg.features + svg.latent_dim) + 8 * svg.layers * svg.hidden**2
    yield Need(("baselines.svg",), "SVG's weights", weights * _WEIGHT)
    weights = 9 * (_chain(3, *caddy.encoder) + _chain(caddy.dynamics, *caddy.generator)) + 9 * caddy.dynamics**2
    weights += caddy.actions * (caddy.latent_dim + caddy.dynamics)
    yield Need(("baselines.caddy",), "CADDY's weights", weights * _WEIGHT)
    state, depths = dreamer.categoricals * dreamer.classes, [dreamer.depth * mult for mult in dreamer.mults]
    weights = dreamer.kernel**2 * _chain(3, *depths) + dreamer.belief**2 / dreamer.blocks
    weights += dreamer.hidden * (dreamer.belief + state) + dreamer.units * (dreamer.belief + state)
    weights += 2 * dreamer.layers * dreamer.units**2
    yield Need(("baselines.dreamer",), "Dreamer's weights", weights * _WEIGHT)
    layers = sold.dynamics_layers + 3 * sold.head_layers
    weights = layers * (4 * sold.dim**2 + 2 * sold.dim * sold.mlp_dim) + sold.dim * (sold.bins + config.env.action_dim)
    yield Need(("baselines.sold",), "SOLD's weights", weights * _WEIGHT)
    side = 3 * (dreamer.frame_size or config.env.image_size) ** 2
    yield from _acting("dreamer", dreamer, side, config.env.max_steps)
    yield from _acting("sold", sold, slots * _FLOAT, config.env.max_steps)
    imagined = sold.starts * sold.horizon * slots
    keys = ("baselines.sold.starts", "baselines.sold.horizon")
    yield Need(keys, "imagined rollouts", imagined * _FLOAT, host=False)
    imagined = dreamer.horizon * dreamer.batch_size * (dreamer.belief + state)
    yield Need(("baselines.dreamer.horizon",), "imagined rollouts", imagined * _FLOAT, host=False)


def _acting(name: str, own: OnlineConfig, row: float, episode: int) -> Iterator[Need]:
    """Of a method that acts: its replay, and its batch of sequences; `row`: bytes of an observation as it is kept."""
    group = f"baselines.{name}"
    if not own.replay_on_disk:
        yield Need((f"{group}.capacity",), "the frames of the replay", own.capacity * row)
    sequences = own.batch_size * (own.sequence or episode) * row
    yield Need((f"{group}.batch_size", f"{group}.sequence"), "the sequences of a batch", sequences, host=False)


def _clips(name: str, stage: StageConfig | DynamicsStageConfig, numbers: float, *more: str) -> Need:
    """Of a stage: the batch that a process holds at once, of so many numbers a window."""
    size = stage.batch_size / stage.optim.accumulate * numbers * _FLOAT
    return Need((name, *more), "the windows of a batch", size, host=False)


def _frame(config: ExperimentConfig) -> int:
    """Numbers of a frame."""
    return 3 * config.env.image_size**2


def _chain(*widths: int) -> float:
    """Products of neighbouring widths, as of the weights between them."""
    return float(sum(left * right for left, right in pairwise(widths)))


def _transformer(sizes: InverseDynamicsConfig | PredictorConfig | PolicyConfig) -> float:
    """Weights of the layers."""
    return float(sizes.layers) * sizes.dim * (4 * sizes.heads * sizes.head_dim + 2 * sizes.mlp_dim)
