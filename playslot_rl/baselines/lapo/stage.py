"""Training of LAPO's inverse and forward model on unlabelled videos: a `Stage` for `fit`.

    L = mean (o^_{t+1} - o_{t+1})^2 / mean (o_t - o_{t+1})^2 + L_VQ

Note: LAPO has the plain mean squared error. Most pixels of a scene stand still, so its scale says little; divided by
the error of predicting no change (a constant of the data set) it is 1 before training, whatever the task, and
`unexplained` is the fraction of the change that is not predicted.

Shapes: B batch, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from playslot_rl.baselines.lapo.model import ForwardModel, InverseModel
from playslot_rl.config import StageConfig
from playslot_rl.data.demonstrations import Transitions
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.windows import sample_windows, split_episodes, spread_windows
from playslot_rl.frames import normalise
from playslot_rl.modules.quantizer import usage
from playslot_rl.seeding import StepGenerators

VALIDATION_PAIRS = 256
BATCH = 64


class LAPOModelStage:
    """Inverse and forward model together.

    Args:
        inverse, forward: trained in place.
        source: unlabelled videos.
        config: batch, precision.
        validation: fraction of episodes held out.
        seed: of the split.
        device: where the models are.

    Raises:
        DataError: no episode of two frames.
    """

    def __init__(
        self,
        inverse: InverseModel,
        forward: ForwardModel,
        source: EpisodeFrames,
        config: StageConfig,
        *,
        validation: float,
        seed: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.inverse, self.forward, self.source, self.config, self.device = inverse, forward, source, config, device
        self.train_episodes, held_out = split_episodes(source.episodes, validation, seed)
        self.pairs = spread_windows(source.starts, source.lengths, 2, VALIDATION_PAIRS, held_out)
        seen = spread_windows(source.starts, source.lengths, 2, VALIDATION_PAIRS, self.train_episodes)
        self.still = max(1e-6, self._still(seen))

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Both models."""
        return {"inverse": self.inverse, "forward": self.forward}

    def loss(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        """Error of one batch of pairs."""
        rows = sample_windows(
            self.source.starts,
            self.source.lengths,
            2,
            self.config.batch_size,
            generators.numpy("pairs"),
            self.train_episodes,
        )
        first, second = self._frames(rows)
        with torch.autocast(first.device.type, torch.bfloat16, enabled=self.config.precision == "bf16"):
            inferred = self.inverse(first, second)
            predicted = self.forward(first, inferred.z)
        image = (predicted.float() - second).square().mean() / self.still
        used, perplexity = usage(inferred.code.detach(), self.inverse.config.codes)
        return {
            "loss": image + inferred.vq_loss,
            "loss_image": image,
            "loss_vq": inferred.vq_loss,
            "usage": used,
            "perplexity": perplexity,
        }

    def validate(self, step: int) -> Mapping[str, float]:  # noqa: ARG002
        """`unexplained`: error on held-out pairs over that of no change; `perplexity` of the codes (1 to K)."""
        errors, stills, codes = [], [], []
        for rows in np.array_split(self.pairs, -(-len(self.pairs) // BATCH)):
            first, second = self._frames(rows)
            inferred = self.inverse(first, second)
            errors.append(float((self.forward(first, inferred.z) - second).square().sum()))
            stills.append(float((first - second).square().sum()))
            codes.append(inferred.code)
        _, perplexity = usage(torch.cat(codes), self.inverse.config.codes)
        return {"unexplained": sum(errors) / max(1e-6, sum(stills)), "perplexity": float(perplexity)}

    def _frames(self, rows: npt.NDArray[np.int64]) -> tuple[Tensor, Tensor]:
        pixels = normalise(self.source.pixels(rows).to(self.device))
        return pixels[:, 0], pixels[:, 1]

    def _still(self, rows: npt.NDArray[np.int64]) -> float:
        first, second = self._frames(rows)
        return float((first - second).square().mean())


@torch.no_grad()
def infer_latents(
    inverse: InverseModel, source: EpisodeFrames, moves: Transitions, device: torch.device | str = "cpu"
) -> Tensor:
    """Quantised latent actions (M, Z) of transitions; the model in evaluation mode."""
    parts = []
    for rows in np.array_split(moves.rows, -(-len(moves.rows) // BATCH)):
        pixels = source.pixels(np.stack((rows, rows + 1), axis=1)).to(device)
        parts.append(inverse(pixels[:, 0], pixels[:, 1]).z)
    return torch.cat(parts)
