"""Training of LeRobot's policies on the labelled demonstrations: as `lerobot-train` does it, on rows of our caches.

A row is a frame with the H actions that follow it (of Diffusion Policy, that begin with its first frame's); those
before the episode's first action or after its last repeat it and are marked as padding.

Note: LeRobot's reader takes an episode's last row for one with an action; here it has none, so it neither begins a
chunk nor is in one. Rows are drawn with replacement; still stretches begin no chunk (`behaviour.trim_pixels`), which
LeRobot's reader knows nothing of. Diffusion's warm-up begins one step further.

Shapes: M rows, B batch, F frames, H actions of a chunk, E of them executed, A action dim, S proprioception.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig, OptimConfig
from playslot_rl.data.demonstrations import moving_frames, real_actions, require_finite, transitions
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.methods.cloning import task_of
from playslot_rl.methods.lerobot_policy.method import ACTConfig, ChunkConfig
from playslot_rl.methods.lerobot_policy.policy import PAD, ChunkPolicy, Observation, chunk_policy
from playslot_rl.methods.resnet_oracle.network import load_trunk
from playslot_rl.runtime.devices import to_device
from playslot_rl.runtime.precision import autocast
from playslot_rl.runtime.shares import own_rows
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.training.demonstrated import cloning_alone
from playslot_rl.training.fit import Part
from playslot_rl.training.optimizer import build_adam
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training
from playslot_rl.training.stage_regression import HELD_OUT, FrameInputs, unexplained

SEEN = (keys.PIXELS, keys.STATE, keys.TASK)
"""An `Observation`, in a batch."""
VALIDATED = 128
"""Rows of each set that a validation predicts chunks of."""


class Chunks(NamedTuple):
    """Rows: frames (M, F), the actions (M, H, A) in [-1, 1] that are predicted from them, which of these are padding,
    bool (M, H), proprioception (M, F, S) where it is seen, and the task int64 (M, 1) where it is told.
    """

    frames: FrameInputs
    actions: Tensor
    pad: Tensor
    states: Tensor | None
    task: Tensor | None

    def __len__(self) -> int:
        return len(self.actions)

    def observed(self, rows: Tensor, pixels: Tensor) -> Observation:
        """What is seen at rows (B,), beside their frames (B, F, 3, W, W)."""
        there = to_device(rows, self.actions.device)
        return Observation(pixels, *(None if part is None else part[there] for part in (self.states, self.task)))


def chunked(
    config: ExperimentConfig,
    source: EpisodeFrames,
    own: ChunkConfig,
    chunk: int,
    device: torch.device,
    shift: int = 0,
    state: bool = False,
) -> Chunks:
    """The rows of demonstrations; a DataError where there are no actions, or no proprioception that is to be seen, or
    nothing moves.
    """
    moves = moving_frames(source, config.behaviour.trim_pixels, config.behaviour.trim_margin)
    lengths = moves.lengths[moves.episode]
    # As LeRobot's sampler: the last rows of an episode, whose chunks would be padding for the most part, begin none.
    unused = max(0, chunk - own.kept(chunk) - own.frames + 1) if own.drops else 0
    kept = moves.step < np.maximum(1, lengths - unused)
    rows, step, lengths = moves.rows[kept], moves.step[kept], lengths[kept]
    first = (rows - step)[:, None]
    last = first + lengths[:, None] - 1
    wanted = rows[:, None] + np.arange(1 - own.frames, 1 - own.frames + chunk)
    seen = np.maximum(rows[:, None] + np.arange(1 - own.frames, 1), first)
    actions = real_actions(source, np.clip(wanted, first, last), config.env.action_dim)
    frames = FrameInputs(source, seen, device, shift, config.data.device == "auto")
    pad = torch.from_numpy((wanted < first) | (wanted > last)).to(device)
    states = torch.from_numpy(source.require_states()[seen]).to(device) if state else None
    task = task_of(source, moves, config, device)
    task = None if task is None else task[torch.from_numpy(kept).to(device)]
    return Chunks(frames, actions.to(device), pad, states, task)


class ChunkStage:
    """A policy of LeRobot's on chunks, trained in place."""

    def __init__(self, policy: ChunkPolicy, own: ChunkConfig, trained: Chunks, held_out: Chunks | None) -> None:
        self.policy, self.own, self.trained = policy, own, trained
        self.checks = {"unexplained": trained}
        if held_out is not None:
            self.checks[f"unexplained{HELD_OUT}"] = held_out

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"policy": self.policy}

    def phase(self, step: int) -> Hashable:  # noqa: ARG002
        """LeRobot's loss waits for values: no step can be captured."""
        return None

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        drawn = torch.randint(len(self.trained), (self.own.batch_size,), generator=generators.torch("policy", "cpu"))
        rows = own_rows(drawn)
        there = to_device(rows, self.trained.actions.device)
        pixels = self.trained.frames.draw(rows, generators)
        seen = zip(SEEN, self.trained.observed(rows, pixels), strict=True)
        known = {key: value for key, value in seen if value is not None}
        return {**known, keys.ACTION: self.trained.actions[there], PAD: self.trained.pad[there]}

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        """Note: dropout, the VAE's and the diffusion's noise are drawn for each share of a batch alike."""
        with autocast(batch[keys.PIXELS].device.type, self.own.precision):
            seen = Observation(batch[keys.PIXELS], batch.get(keys.STATE), batch.get(keys.TASK))
            return {"loss": self.policy.loss(seen, batch[keys.ACTION], batch[PAD]).float()}

    def validate(self, step: int) -> Mapping[str, float]:  # noqa: ARG002
        """Unexplained fraction of the variance of the actions that are executed."""
        return {name: unexplained(*self._compared(rows)) for name, rows in self.checks.items()}

    def _compared(self, chunks: Chunks) -> tuple[Tensor, Tensor]:
        rows = torch.linspace(0, len(chunks) - 1, min(VALIDATED, len(chunks))).long()
        there, begin = to_device(rows, chunks.actions.device), self.own.frames - 1
        predicted = self.policy.plan(chunks.observed(rows, chunks.frames.plain(rows)), rows.tolist())
        shown = slice(begin, begin + self.policy.executed)
        real = ~chunks.pad[there][:, shown]
        return predicted[real], chunks.actions[there][:, shown][real]


def with_state(record: StageRecord) -> Training:
    """With proprioception."""
    return training(record, state=True)


def training(record: StageRecord, state: bool = False) -> Training:
    config, device, split = record.config, record.device, record.demos
    group = f"baselines.{record.spec.own}"
    own: ChunkConfig = getattr(config.baselines, record.spec.own)
    width = config.env.action_dim
    split.trained.require_actions(width)
    require_finite(split)
    moves = transitions(split.trained)
    chunk = own.sized(int(moves.lengths.max()))
    states = torch.from_numpy(split.trained.require_states()[moves.rows]) if state else None
    with global_seed(config.seed, 0, record.name):
        policy = chunk_policy(own, config.env, chunk, 0 if states is None else states.shape[1])
    trunk, names = policy.trunk()
    pretraining = load_trunk(trunk, own.weights, f"{group}.weights", names)
    learned = pretraining == "scratch" and policy.learn_norms()
    policy.give(real_actions(split.trained, moves.rows, width), states)
    policy.to(device)
    trained = chunked(config, split.trained, own, chunk, device, own.shift, state)
    other = split.held_out
    measured = other is not None and bool(np.isfinite(other.require_actions()).all() or not other.unlabelled)
    held_out = chunked(config, other, own, chunk, device, 0, state) if other is not None and measured else None
    stage = ChunkStage(policy, own, trained, held_out)
    facts: dict[str, Any] = {"pretraining": pretraining, "chunk": chunk}
    facts |= {"state": policy.state_dim} if state else {}
    if learned:
        facts["norms"] = "learned"  # a training of before, whose layers were frozen, does not go on
    part = Part(f"baselines.{record.name}", stage, own, group=group, optimizer=partial(_optimizer, policy, own))
    said = f", chunks of {chunk}, ResNet-18 from {pretraining}"
    return cloning_alone(record, part, len(trained), said, facts)


def _optimizer(
    policy: ChunkPolicy, own: ChunkConfig, parameters: Mapping[str, nn.Parameter], config: OptimConfig
) -> torch.optim.Adam:
    """Adam or AdamW with LeRobot's settings for this policy, but for rate and decay, which are ours."""
    preset = policy.policy.config.get_optimizer_preset()
    return build_adam(
        parameters, config, betas=tuple(preset.betas), eps=preset.eps, weight_decay=own.weight_decay,
        decoupled_weight_decay=isinstance(own, ACTConfig),
    )  # fmt: skip
