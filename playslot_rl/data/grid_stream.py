"""GridShapes as a stream: clips drawn while they are read, nothing stored.

Shapes: T steps (a clip has T + 1 frames), O objects, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from playslot_rl import keys
from playslot_rl.config import EnvConfig
from playslot_rl.envs.grid_shapes import check_actions, generate

CLIPS_AT_ONCE = 32


class GridShapesStream(IterableDataset[dict[str, Tensor]]):
    """The clips of consecutive seeds, for a `torch.utils.data.DataLoader`.

    Each clip is a dict of PIXELS uint8 (T + 1, 3, H, W), ACTION float32 (T, 2 O), OBJECT_MOVES int64 (T, O),
    OBJECT_MASKS uint8 (T + 1, H, W) and SEED int64 (). Workers of a DataLoader share the seeds: each comes once.

    Args:
        clips: how many; None goes on for ever.
        env: settings; None means `EnvConfig(name="grid_shapes")`.

    Raises:
        ConfigError: `env.action_dim` is not two for each object.

    Examples:
        >>> from torch.utils.data import DataLoader
        >>> loader = DataLoader(GridShapesStream(first=0, clips=8, steps=5), batch_size=4)
        >>> next(iter(loader))["pixels"].shape
        torch.Size([4, 6, 3, 64, 64])
    """

    def __init__(self, first: int = 0, clips: int | None = None, steps: int = 20, env: EnvConfig | None = None) -> None:
        super().__init__()
        self.first, self.clips, self.steps = first, clips, steps
        self.env = env or EnvConfig(name="grid_shapes")
        check_actions(self.env)

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        """Clips in the order of their seeds (of those that are this worker's)."""
        worker = get_worker_info()
        number, stride = (worker.id, worker.num_workers) if worker is not None else (0, 1)
        while self.clips is None or number < self.clips:
            end = number + stride * CLIPS_AT_ONCE
            seeds = [self.first + n for n in range(number, end if self.clips is None else min(end, self.clips), stride)]
            drawn = generate(seeds, self.steps, self.env)
            for i, seed in enumerate(seeds):
                yield {
                    keys.PIXELS: torch.from_numpy(drawn.frames[i]).movedim(-1, -3).contiguous(),
                    keys.ACTION: torch.from_numpy(drawn.actions[i]),
                    keys.OBJECT_MOVES: torch.from_numpy(drawn.moves[i]),
                    keys.OBJECT_MASKS: torch.from_numpy(drawn.masks[i]),
                    keys.FEATURE_SEED: torch.tensor(seed),
                }
            number = end
