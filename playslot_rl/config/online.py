"""Config of the loop of acting and learning, which the configs of the online methods extend."""

from __future__ import annotations

from dataclasses import dataclass

from playslot_rl.config.plain import check


@dataclass(frozen=True)
class OnlineConfig:
    """Acting, replay and schedule of a method that learns by acting.

    A step is an agent step: `env.frame_skip` environment steps of the same action.

    Attributes:
        steps: agent steps in all, those of the random start too.
        minutes: wall-clock budget over all processes; 0 means none. Training then ends at the round that crosses it,
            so that how far it got depends on the machine.
        prefill: agent steps of uniformly random actions before the first update.
        envs: episodes played side by side, a round: the policy changes between rounds only.
        update_ratio: updates for each agent step.
        batch_size: sequences in an update (B).
        sequence: frames in a sequence (T); 0 means whole episodes. Sequences longer than an episode run across
            episodes, shorter ones stay within one.
        reward_scale: rewards are multiplied by it before the method learns from them; the curve's returns are not.
            Grids of values and the least range of returns that is divided by (1) suit rewards of the order of 1 to 10.
        capacity: frames that the replay keeps; the oldest episodes go first.
        replay_on_disk: memory-map the replay, where it does not fit into memory.
        evaluate_every: agent steps between points of the learning curve.
        evaluation_episodes: development episodes for a point.
        checkpoint_every: agent steps between checkpoints.
        log_every: updates between lines of `metrics.jsonl`.
    """

    steps: int = 1_000_000
    minutes: float = 0.0
    prefill: int = 1000
    envs: int = 1
    update_ratio: float = 0.5
    batch_size: int = 16
    sequence: int = 64
    reward_scale: float = 1.0
    capacity: int = 1_000_000
    replay_on_disk: bool = False
    evaluate_every: int = 10_000
    evaluation_episodes: int = 20
    checkpoint_every: int = 10_000
    log_every: int = 100

    def __post_init__(self) -> None:
        for name in (
            "steps", "prefill", "envs", "batch_size", "capacity",
            "evaluate_every", "evaluation_episodes", "checkpoint_every", "log_every",
        ):  # fmt: skip
            check(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        check(self.minutes >= 0, "minutes", self.minutes, "at least 0")
        check(self.reward_scale > 0, "reward_scale", self.reward_scale, "above 0")
        check(self.update_ratio > 0, "update_ratio", self.update_ratio, "above 0")
        check(self.sequence == 0 or self.sequence >= 2, "sequence", self.sequence, "0 (whole episodes), or at least 2")
        check(self.prefill <= self.steps, "prefill", self.prefill, f"at most steps ({self.steps})")
