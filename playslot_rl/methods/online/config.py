"""Settings of a method that learns by acting."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

from playslot_rl.config.machine import Need
from playslot_rl.config.plain import check
from playslot_rl.config.roles import YEAR_MINUTES, Checked, above_zero, at_least, between, role, was, within

SHARE = between(0, 1, "a number in [0, 1]")
SEQUENCE = within(lambda value: value != 1, "0 (whole episodes), or at least 2")


@dataclass(frozen=True)
class OnlineConfig(Checked):
    """Acting, replay and schedule of a method that learns by acting.

    A step is an agent step: `env.frame_skip` environment steps of the same action.

    Attributes:
        steps: agent steps in all, those of the random start too.
        minutes: wall-clock budget over all processes; 0 means none. Training then ends at the round that crosses it,
            so that how far it got depends on the machine.
        prefill: agent steps of uniformly random actions before the first update.
        envs: episodes played side by side, a round: the policy changes between rounds only.
        workers: processes that play the rounds while this one learns, each `envs / workers` episodes, with weights that
            are one round old; 0 plays them in this process, between its updates, with the newest ones.
        update_ratio: updates for each agent step.
        batch_size: sequences in an update (B).
        sequence: frames in a sequence (T); 0 means whole episodes. Others run across episodes; SOLD's stay within one
            where they are no longer.
        reward_scale: rewards are multiplied by it before the method learns from them; the curve's returns are not.
            Grids of values and the least range of returns that is divided by (1) suit rewards of the order of 1 to 10.
        capacity: frames that the replay keeps; the oldest episodes go first.
        replay_on_disk: memory-map the replay, where it does not fit into memory.
        evaluate_every: agent steps between points of the learning curve.
        evaluation_episodes: development episodes for a point.
        checkpoint_every: agent steps between checkpoints.
        log_every: updates between lines of `metrics.jsonl`.
    """

    within_episode: ClassVar[bool] = True
    steps: int = field(default=1_000_000, metadata=at_least(1))
    minutes: float = field(default=0.0, metadata=role("free") | at_least(0, largest=YEAR_MINUTES))
    prefill: int = field(default=1000, metadata=at_least(1))
    envs: int = field(default=1, metadata=at_least(1, largest=1024))
    workers: int = field(default=0, metadata=was(0) | at_least(0, largest=1024))
    update_ratio: float = field(default=0.5, metadata=above_zero())
    batch_size: int = field(default=16, metadata=at_least(1))
    sequence: int = field(default=64, metadata=SEQUENCE)
    reward_scale: float = field(default=1.0, metadata=was(1.0) | above_zero())
    capacity: int = field(default=1_000_000, metadata=at_least(1))
    replay_on_disk: bool = field(default=False, metadata=role("free"))
    evaluate_every: int = field(default=10_000, metadata=role("free") | at_least(1))
    evaluation_episodes: int = field(default=20, metadata=at_least(1))
    checkpoint_every: int = field(default=10_000, metadata=role("free") | at_least(1))
    log_every: int = field(default=100, metadata=role("free") | at_least(1))

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self.prefill <= self.steps, "prefill", self.prefill, f"at most steps ({self.steps})")
        divided = self.workers == 0 or self.envs % self.workers == 0
        check(divided, "workers", self.workers, f"0 or a divisor of envs ({self.envs})")

    def acting_needs(self, name: str, row: float, episode: int) -> Iterator[Need]:
        """Of the replay and its batches, of rows of so many bytes."""
        if not self.replay_on_disk:
            yield Need((f"{name}.capacity",), "the frames of the replay", self.capacity * row)
        sequences = self.batch_size * (self.sequence or episode) * row
        yield Need((f"{name}.batch_size", f"{name}.sequence"), "the sequences of a batch", sequences, host=False)
