"""Demonstrations as the behaviour stage sees them: slots, inferred latents, predicted slots, and some real actions.

Shapes: M transitions of all demonstrations in a row, N slots, D slot width, Z latent-action width, A action width.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.data.source import EpisodeFrames
from playslot_rl.errors import DataError
from playslot_rl.world_model import WorldModel

BATCH = 64


@dataclass(frozen=True)
class Demonstrations:
    """Transitions of demonstrations.

    Attributes:
        slots: parsed slots (M, N, D).
        imagined: slots cOCVP predicts for the same moments (M, N, D), unfolded from each demonstration's first frame
            under the inferred latents; the first frame's are the parsed ones.
        latents: inferred latent actions (M, Z).
        actions: real actions (M, A) in [-1, 1], or None.
        episode: number of the demonstration of each transition, int64 (M,).
        lengths: transitions of each demonstration, int64 (E,).
    """

    slots: Tensor
    imagined: Tensor
    latents: Tensor
    actions: Tensor | None
    episode: Tensor
    lengths: Tensor

    def labelled(self, demos: int) -> Tensor:
        """Rows (int64) of the first `demos` demonstrations, the only ones whose actions the action decoder sees.

        Raises:
            DataError: there are fewer demonstrations.
        """
        if demos > len(self.lengths):
            raise DataError(
                f"behaviour.labelled_demos: got {demos}, expected at most the {len(self.lengths)} demonstrations "
                "there are: lower it or collect more"
            )
        return torch.nonzero(self.episode < demos)[:, 0]


@torch.no_grad()
def label_demonstrations(
    model: WorldModel, source: EpisodeFrames, slots: npt.NDArray[np.float32], device: torch.device | str = "cpu"
) -> Demonstrations:
    """Infer the latent actions of demonstration videos, and unfold each in imagination under them.

    Args:
        model: frozen world model, on `device`.
        source: the videos; its actions are carried along where it has some.
        slots: cached slots (F, N, D) of its frames.
        device: where to compute.

    Raises:
        DataError: no episode has two frames, mode `ground_truth` without actions, or actions of another width.
    """
    kept = np.nonzero(source.lengths >= 2)[0]
    if not len(kept):
        raise DataError("demonstrations: got no episode of two frames or more, expected videos: collect again")
    if source.actions is not None:
        source.require_actions(model.env.action_dim)
    parts: dict[int, tuple[Tensor, Tensor, Tensor]] = {}
    for length in np.unique(source.lengths[kept]):
        same = kept[source.lengths[kept] == length]
        for chosen in np.array_split(same, -(-len(same) // BATCH)):
            rows = source.starts[chosen][:, None] + np.arange(length)
            parsed = torch.from_numpy(slots[rows]).to(device)
            actions = None
            if model.inverse_dynamics.config.mode == "ground_truth":
                actions = torch.from_numpy(source.require_actions()[rows[:, :-1]]).to(device)
            latent = model.inverse_dynamics(parsed, actions)
            rolled = model.predictor.rollout(parsed[:, :1], latent.prototype, latent.variability)
            imagined = torch.cat((parsed[:, :1], rolled[:, :-1]), dim=1)
            for i, episode in enumerate(chosen):
                parts[int(episode)] = (parsed[i, :-1], imagined[i], latent.mean[i])
    order = [int(e) for e in kept]
    steps = torch.tensor([int(source.lengths[e]) - 1 for e in order])
    rows_of_steps = np.concatenate([source.starts[e] + np.arange(source.lengths[e] - 1) for e in order])
    labels = None if source.actions is None else torch.from_numpy(np.array(source.actions[rows_of_steps])).to(device)
    return Demonstrations(
        slots=torch.cat([parts[e][0] for e in order]),
        imagined=torch.cat([parts[e][1] for e in order]),
        latents=torch.cat([parts[e][2] for e in order]),
        actions=None if labels is None else labels.clamp(-1, 1),
        episode=torch.repeat_interleave(torch.arange(len(order)), steps).to(device),
        lengths=steps,
    )
