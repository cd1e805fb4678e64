"""What the parts of a world model hold: slots as masks and objects, action prototypes by what they do; and imagined
futures beside what happens when their actions are executed.

Shapes: E episodes, T frames or agent steps, N slots, K prototypes, P predicted frames, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.agent import ImaginationActor, playslot_actor, show_goals
from playslot_rl.acting.episodes import Moment, Outcome, TaskPool, record
from playslot_rl.colours import segmentation
from playslot_rl.frames import to_float, to_uint8
from playslot_rl.visualization.grid import film_strip, image_grid
from playslot_rl.world_model import Agent, WorldModel, module_device

Frames = npt.NDArray[np.uint8]


@torch.no_grad()
def slot_cells(model: WorldModel, frames: Frames) -> Frames:
    """Rows of pictures (3 + N, T, H, W, 3) of a clip (T, H, W, 3): frame, reconstruction, segmentation, then the frame
    as each slot sees it (its colours weighted by its mask, on white).
    """
    decoded = model.savi.decode(model.savi.parse(to_float(frames, module_device(model))[None])[0])
    objects = decoded.rgb.clamp(0, 1) * decoded.masks + (1 - decoded.masks)
    rows = [frames, to_uint8(decoded.frames), segmentation(to_uint8(decoded.frames), decoded.masks.cpu().numpy())]
    rows += [to_uint8(objects[:, n]) for n in range(objects.shape[1])]
    return np.stack(rows)


def draw_slots(model: WorldModel, frames: Frames) -> Image.Image:
    """Grid for six frames spread evenly over a clip (T, H, W, 3)."""
    cells = slot_cells(model, frames)
    labels = ["frame", "reconstruction", "segmentation", *(f"slot {n + 1}" for n in range(cells.shape[0] - 3))]
    return film_strip(cells, labels, columns=6)


@torch.no_grad()
def prototype_frames(model: WorldModel, frame: Frames, steps: int = 15) -> Frames:
    """Frames (K, P, H, W, 3) imagined from a frame (H, W, 3) while each prototype is held for P steps, by every slot,
    with zero variability; a ValueError where the latent-action mode has no prototypes.
    """
    mode = model.config.inverse_dynamics.mode
    if mode not in ("hybrid", "discrete"):
        raise ValueError(f"prototypes: got latent-action mode {mode}, expected hybrid or discrete")
    slots = model.savi.parse(to_float(frame, module_device(model))[None, None])
    prototypes = model.inverse_dynamics.prototypes
    k = len(prototypes)
    p = prototypes[:, None].expand(k, steps, -1)
    if model.inverse_dynamics.per_slot:
        p = p[:, :, None].expand(k, steps, slots.shape[2], -1)
    predicted = model.predictor.rollout(slots.expand(k, -1, -1, -1), p, torch.zeros_like(p))
    return to_uint8(model.savi.decode(predicted).frames)


def draw_prototypes(model: WorldModel, frame: Frames, steps: int = 15) -> Image.Image:
    """Rows are prototypes, columns the first frame and imagined frames up to `steps`; last, the change since t = 0."""
    imagined = prototype_frames(model, frame, steps)
    first = np.broadcast_to(frame, (len(imagined), 1, *frame.shape))
    clips = np.concatenate([first, imagined], 1)
    shown = np.unique(np.linspace(0, steps, min(8, steps + 1)).round().astype(int))
    change = change_map(clips[:, 1], clips[:, -1])[:, None]
    cells = np.concatenate([clips[:, shown], change], 1)
    return image_grid(cells, [f"code {k}" for k in range(len(cells))], [*(f"t = {t}" for t in shown), "change"])


def change_map(before: Frames, after: Frames) -> Frames:
    """Where pictures (K, H, W, 3) differ: blue what left, orange what came, on white (by change in brightness).

    The first *imagined* frame is the reference, so that the decoder's blur is not shown as motion.
    """
    difference = after.astype(np.float32).mean(-1) - before.astype(np.float32).mean(-1)
    strength = np.clip(np.abs(difference) / 48.0, 0, 1)[..., None]
    blue, orange = np.array([0, 114, 178], np.float32), np.array([213, 94, 0], np.float32)
    colour = np.where(difference[..., None] > 0, orange, blue)
    picture: Frames = (255 * (1 - strength) + colour * strength).astype(np.uint8)
    return picture


@torch.no_grad()
def run_rollouts(agent: Agent, pool: TaskPool, seeds: Sequence[int]) -> tuple[Frames, list[Outcome], list[Outcome]]:
    """The same episodes as frames (E, 3, T + 1, H, W, 3), decoded from the unfolded slots, of the imagined actions in
    the simulator, and of the agent observing every frame; and how the last two ended.
    """
    unfolded: list[Tensor] = []

    def keep_imagined(moment: Moment) -> None:
        if moment.step == 0 and moment.seen is not None:
            unfolded.append(moment.seen.get(keys.PREDICTED_SLOTS))

    imagining, observing = ImaginationActor(agent, pool.env.max_steps), playslot_actor(agent)
    with TaskPool(pool.env, pool.render) as stage:
        for actor in (imagining, observing):
            show_goals(actor, stage)
        executed, executed_outcome = record(pool, imagining, seeds, keep_imagined)
        closed, closed_outcome = record(pool, observing, seeds)
    imagined = np.stack([to_uint8(agent.world_model.savi.decode(s).frames) for s in torch.cat(unfolded)])
    return np.stack([imagined, executed, closed], 1), executed_outcome, closed_outcome
