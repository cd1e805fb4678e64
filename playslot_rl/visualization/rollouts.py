"""Imagined futures beside what happens when their actions are executed.

Shapes: E episodes, T agent steps, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.agent import ImaginationActor, playslot_actor
from playslot_rl.acting.episodes import Moment, Outcome, TaskPool, record
from playslot_rl.evaluation.video import VideoMetrics, video_metrics
from playslot_rl.frames import to_float, to_uint8
from playslot_rl.visualization.grid import film_strip, side_by_side
from playslot_rl.world_model import Agent

Frames = npt.NDArray[np.uint8]
COLUMNS = ("imagined", "executed", "closed loop")


@dataclass(frozen=True)
class Rollouts:
    """The same episodes imagined, executed open-loop, and run closed-loop.

    Attributes:
        clips: (E, 3, T + 1, H, W, 3): frames decoded from the unfolded slots, those of the imagined actions in
            the simulator, and those of the agent observing every frame.
        executed_outcome, closed_outcome: the episodes of the last two.
    """

    clips: Frames
    executed_outcome: list[Outcome]
    closed_outcome: list[Outcome]

    def metrics(self) -> VideoMetrics:
        """PSNR and SSIM of the imagined against the executed frames, without the parsed first one."""
        return video_metrics(to_float(self.clips[:, 0, 1:]), to_float(self.clips[:, 1, 1:]))


@torch.no_grad()
def run_rollouts(agent: Agent, pool: TaskPool, seeds: Sequence[int]) -> Rollouts:
    """Run the episodes of `seeds` both ways."""
    unfolded: list[Tensor] = []

    def keep_imagined(moment: Moment) -> None:
        if moment.step == 0 and moment.seen is not None:
            unfolded.append(moment.seen.get(keys.PREDICTED_SLOTS))

    executed, executed_outcome = record(pool, ImaginationActor(agent, pool.env.max_steps), seeds, keep_imagined)
    slots = torch.cat(unfolded)
    imagined = np.stack([to_uint8(agent.world_model.savi.decode(s).frames) for s in slots])
    closed, closed_outcome = record(pool, playslot_actor(agent), seeds)
    return Rollouts(np.stack([imagined, executed, closed], 1), executed_outcome, closed_outcome)


def draw_animation(rollouts: Rollouts) -> list[Image.Image]:
    """One picture a step: a row an episode, the three ways of running it side by side."""
    return side_by_side(rollouts.clips, COLUMNS, [f"episode {i + 1}" for i in range(len(rollouts.clips))], scale=3)


def draw_strip(rollouts: Rollouts) -> Image.Image:
    """Frames spread evenly over time: three rows an episode."""
    labels = [f"{i + 1} {name}" for i in range(len(rollouts.clips)) for name in COLUMNS]
    return film_strip(rollouts.clips.reshape(-1, *rollouts.clips.shape[2:]), labels)
