"""Demonstrations as the behaviour stage sees them: slots, inferred latents, predicted slots, and some real actions; and
which of their transitions say something, those in which something moves and a few after them. A frozen world model
labels them: latent actions, and slots as they are imagined.

    m_t = sqrt(mean (S_{t+1} - S_t)^2),   kept_t = m_t > threshold, or m_u > threshold for some t - margin <= u < t

An expert that holds still once the task is solved fills half of the rows with the one action of doing nothing.

Shapes: M transitions of all demonstrations in a row, N slots, D slot width, Z latent-action width, A action width,
B episodes of T transitions, F frames, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.config import DataConfig
from playslot_rl.data.agreement import say_once
from playslot_rl.data.cache import note_read
from playslot_rl.data.neighbours import Ends, in_batches
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.tasks import told_tasks
from playslot_rl.data.views import acting_first, drawn_demonstrations, episode_range, first_demonstrations
from playslot_rl.errors import DataError
from playslot_rl.frames import normalise
from playslot_rl.modules.action_range import ActionRange
from playslot_rl.world_model import WorldModel

FRAMES_AT_ONCE = 1024
EPISODES_AT_ONCE = 64  # that are labelled
BY_ROW: Final = ("slots", "imagined", "latents", "actions", "episode", "step", "task", "goal")
"""Parts of `Demonstrations` that have a row a transition."""
MotionOf = Callable[[npt.NDArray[np.int64]], Tensor]  # the motion (M,) of the transitions from some rows (M,)


@dataclass(frozen=True)
class Demonstrations:
    """Transitions of demonstrations.

    Attributes:
        imagined: slots cOCVP predicts for the same moments (M, N, D), unfolded from each demonstration's first frame
            under the inferred latents; the first frame's are the parsed ones.
        latents: inferred latent actions (M, Z).
        actions: real actions (M, A) in [-1, 1], or None.
        episode: number of the demonstration of each transition, int64 (M,); a shifted copy's is its original's, and
            all views of one have the same.
        step: number of the transition in its demonstration, int64 (M,).
        lengths: transitions of each demonstration as it was recorded, int64 (R,).
        task: which of several tasks it is of, int64 (M, 1); None where there is one.
        goal: slots of the frame in which it ends (M, N, D); None where no policy is shown goals.
    """

    slots: Tensor
    imagined: Tensor
    latents: Tensor
    actions: Tensor | None
    episode: Tensor
    step: Tensor
    lengths: Tensor
    task: Tensor | None = None
    goal: Tensor | None = None

    @property
    def told(self) -> Tensor | None:
        """What a policy is told of what to do."""
        return self.task if self.goal is None else self.goal

    def take(self, rows: Tensor) -> Demonstrations:
        """Some transitions, by an index int64 (M',) or a mask bool (M,); `lengths` stays."""
        there = [name for name in BY_ROW if getattr(self, name) is not None]
        return replace(self, **{name: getattr(self, name)[rows] for name in there})

    def require_actions(self) -> Tensor:
        """The real actions (M, A); a DataError where there are none."""
        if self.actions is None:
            raise DataError("action decoder: got demonstrations without actions, expected the feature `action`")
        return self.actions

    def labelled(self, demos: int) -> Tensor:
        """Rows (int64) of the first `demos` demonstrations and their copies, whose actions the action decoder sees; a
        DataError where there are fewer, or trimming has left no row of them."""
        require_labelled(demos, len(self.lengths))
        return labelled_rows(self.episode, demos)


def labelled_rows(episode: Tensor | npt.NDArray[np.int64], demos: int) -> Tensor:
    """Rows (int64) of the first `demos` demonstrations, by the demonstration of each row (M,); a DataError where
    trimming has left none."""
    rows = torch.nonzero(torch.as_tensor(episode < demos))[:, 0]
    if not len(rows):
        raise DataError(
            f"behaviour.labelled_demos={demos}: got demonstrations in which nothing moves, expected some that do: "
            "label more of them, or lower behaviour.trim and behaviour.trim_pixels"
        )
    return rows


def require_labelled(labelled: int, demos: int) -> None:
    """Refuse more labelled demonstrations than there are by a DataError."""
    if labelled > demos:
        raise DataError(
            f"behaviour.labelled_demos: got {labelled}, expected at most the {demos} demonstrations "
            "there are: lower it or collect more"
        )


@dataclass(frozen=True)
class DemonstrationSplit:
    """Which demonstrations of a data set are trained on, and which only measure.

    Attributes:
        parsed: what SAVi parses at once, so that one cache serves every number of them.
        held_out: the last ones; None where nothing is beyond those that are trained on.
    """

    trained: EpisodeFrames
    parsed: EpisodeFrames
    held_out: EpisodeFrames | None


def split_demonstrations(
    source: EpisodeFrames, demos: int | None, kept: int, measured: int, draw: int | None = None, acted: bool = False
) -> DemonstrationSplit:
    """Train on the first demonstrations, those with actions before those without, and measure on the last ones.

    Args:
        demos: how many are trained on; None for all but the last `kept`.
        measured: at most so many beyond those that are trained on measure, if more than `kept`.
        draw: seed that decides which are the first ones, the same whatever `demos`; None keeps their order. The last
            ones, which may measure (half of the set at most, beyond `kept`), are not drawn.
        acted: the first ones of those with actions, as who learns from all demonstrations is shown them.

    Raises:
        DataError: there are fewer episodes than `demos`, or none that is not kept.
    """
    count = source.recordings
    free = free_demonstrations(count, kept)
    trained = first_demonstrations(source, free if demos is None else demos)
    parsed = first_demonstrations(source, max(free, trained.recordings))
    among = drawn_among(count, kept, measured)
    last = max(kept, measured) if draw is None else count - among
    rest = count - min(last, count - trained.recordings)
    drawn = source if draw is None else drawn_demonstrations(source, draw, among)
    if acted:
        drawn = acting_first(drawn, among)
    trained = acting_first(first_demonstrations(drawn, trained.recordings))
    usable = bool((source.lengths[source.numbers >= rest] >= 2).any())
    return DemonstrationSplit(trained, parsed, episode_range(source, rest, count) if usable else None)


def free_demonstrations(count: int, kept: int) -> int:
    """How many demonstrations are not kept; a DataError where it is none."""
    if count <= kept:
        raise DataError(
            f"data.held_out: got {kept}, expected less than the {count} demonstrations there are: lower it "
            "or collect more"
        )
    return count - kept


def drawn_among(episodes: int, kept: int, measured: int) -> int:
    """Of how many episodes of a set a draw takes its demonstrations: all but the last ones, which may measure."""
    return episodes - max(kept, min(measured, episodes // 2))


@dataclass(frozen=True)
class Transitions:
    """Transitions of some episodes, in order: the row they start from (row + 1 is the frame after it), the number of
    their recorded episode among those with one, and theirs in it, int64 (M,) each; and how many each recorded episode
    had, int64 (R,)."""

    rows: npt.NDArray[np.int64]
    episode: npt.NDArray[np.int64]
    step: npt.NDArray[np.int64]
    lengths: npt.NDArray[np.int64]

    def trimmed(self, motion: MotionOf, threshold: float, margin: int, key: str) -> Transitions:
        """Without the stretches in which nothing moves (`moving_rows`); all of them where `threshold` is 0.

        `motion` is asked for some rows at a time: what it reads of a large data set would not fit.
        """
        if not threshold:
            return self
        moved = torch.cat([motion(rows) for rows in in_batches(self.rows, FRAMES_AT_ONCE)])
        kept = moving_rows(moved, torch.from_numpy(self.step), threshold, margin, key).numpy()
        return replace(self, rows=self.rows[kept], episode=self.episode[kept], step=self.step[kept])


def slot_motion(slots: Tensor) -> Tensor:
    """RMS change of the slots from one frame to the next: (..., T + 1, N, D) to (..., T), in units of the slots."""
    return (slots[..., 1:, :, :] - slots[..., :-1, :, :]).square().mean(dim=(-2, -1)).sqrt()


def moving_rows(motion: Tensor, step: Tensor, threshold: float, margin: int, key: str = "behaviour.trim") -> Tensor:
    """Transitions in which something moves, and `margin` still ones after each stretch of them: mask bool (M,).

    Args:
        motion: of each transition (M,), the episodes one after the other.
        step: number of each in its episode, int64 (M,).
        key: of the threshold, for the DataError where nothing moves.
    """
    moving = motion > threshold
    if not bool(moving.any()):
        raise DataError(
            f"{key}: got {threshold:g}, which leaves none of {len(motion)} transitions, expected less than "
            f"their largest motion, {float(motion.max()):.3g}: lower it, or change data.held_out if they are held out"
        )
    kept = moving.clone()
    for after in range(1, min(margin, len(moving) - 1) + 1):
        kept[after:] |= moving[:-after] & (step[after:] >= after)
    return kept


def moving_frames(source: EpisodeFrames, threshold: float, margin: int) -> Transitions:
    """Transitions of a data set in which its frames move: RMS change of the pixels, in [0, 1], above `threshold`. A
    DataError where nothing is left."""

    def motion(rows: npt.NDArray[np.int64]) -> Tensor:
        pairs = normalise(source.pixels(np.stack((rows, rows + 1), axis=1)))
        return (pairs[:, 1] - pairs[:, 0]).square().mean(dim=(-3, -2, -1)).sqrt()

    return transitions(source).trimmed(motion, threshold, margin, "behaviour.trim_pixels")


def ends_in(source: EpisodeFrames, slots: npt.NDArray[np.float32], moves: Transitions) -> Tensor:
    """Slots (M, N, D) of the frame in which the episode of each transition ends: a goal that was reached."""
    return torch.from_numpy(slots[Ends.of(source).last[moves.rows]])


def moving_slots(moves: Transitions, slots: npt.NDArray[np.float32], threshold: float, margin: int) -> Transitions:
    """Those transitions in which the slots (F, N, D) move: `slot_motion` above `threshold`. A DataError where nothing
    is left."""

    def motion(rows: npt.NDArray[np.int64]) -> Tensor:
        pairs = slots[np.stack((rows, rows + 1), axis=1)]
        note_read(pairs.nbytes)
        return slot_motion(torch.from_numpy(pairs))[:, 0]

    return moves.trimmed(motion, threshold, margin, "behaviour.trim")


def transitions(source: EpisodeFrames) -> Transitions:
    """All transitions of a data set; episodes of one frame are left out. A DataError where there are no others."""
    kept = np.nonzero(source.lengths >= 2)[0]
    if not len(kept):
        raise DataError("demonstrations: got no episode of two frames or more, expected videos: collect again")
    _, first, number = np.unique(source.numbers[kept], return_index=True, return_inverse=True)
    steps = source.lengths[kept] - 1
    step = np.concatenate([np.arange(n) for n in steps])
    rows = np.repeat(source.starts[kept], steps) + step
    return Transitions(rows, np.repeat(number, steps), step, steps[first])


def say_averaged(data: DataConfig) -> None:
    """Say that a stride averages actions, which absolute targets are not made for."""
    if data.stride > 1 and data.stride_action == "mean":
        say_once(
            f"note: data.stride={data.stride}: actions are the mean of so many; for absolute targets, grippers or "
            "angles that wrap take the last by data.stride_action=last"
        )


def real_actions(source: EpisodeFrames, rows: npt.NDArray[np.int64], width: int) -> Tensor:
    """Real actions (M, A) of transitions, in [-1, 1] by the range of the data set; what lies outside is clipped. A
    DataError where there are none, or some of another width."""
    return _unit_actions(source, source.require_actions(width)[rows]).clamp(-1, 1)


def probed_actions(source: EpisodeFrames, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float32] | None:
    """Real actions (M, A) of transitions for a measure, scaled as they are learned; NaN where they are not known. None
    where none is."""
    if source.actions is None or not np.isfinite(source.actions[rows]).all(axis=1).any():
        return None
    scaled: npt.NDArray[np.float32] = _unit_actions(source, source.actions[rows]).numpy()
    return scaled


def _unit_actions(source: EpisodeFrames, actions: npt.NDArray[np.float32]) -> Tensor:
    found = torch.from_numpy(np.array(actions))
    if source.limits is None:
        return found
    known = ActionRange(actions.shape[-1])
    source.limits.give(known)
    return known.to_unit(found)


def require_finite(demos: DemonstrationSplit, labelled: int | None = None) -> None:
    """Refuse demonstrations whose actions are learned (of the first `labelled`; None: all), and that have none, or are
    learned or measured, and are no numbers."""
    for source, shown in ((demos.trained, labelled), (demos.held_out, None)):
        if source is None or source.actions is None:
            continue
        moves = transitions(source)
        actions, read = source.actions[moves.rows], moves.episode < (source.recordings if shown is None else shown)
        acted = np.logical_or(~np.isnan(actions).all(axis=1), not source.unlabelled)
        if source is demos.trained and not acted[read].all():
            some = len(np.unique(moves.episode[acted]))
            raise DataError(
                f"{source.unlabelled}: got no actions, expected some in all {len(np.unique(moves.episode[read]))} "
                f"demonstrations whose actions are learned: {some} have any; name those alone in data.demos, or set "
                f"behaviour.labelled_demos={some} or less and behaviour.oracle=false"
            )
        read &= acted
        bad = int((~np.isfinite(actions[read])).any(axis=1).sum())
        if bad:
            raise DataError(
                f"{source.name}: got NaN or infinite actions in {bad} of {read.sum()} transitions that are learned "
                "from or measured on, expected finite numbers: leave those episodes out, or lower "
                "behaviour.labelled_demos and set behaviour.oracle=false"
            )


@torch.no_grad()
def label_demonstrations(
    model: WorldModel,
    source: EpisodeFrames,
    slots: npt.NDArray[np.float32],
    device: torch.device | str = "cpu",
    trim: float = 0.0,
    margin: int = 0,
) -> Demonstrations:
    """Infer the latent actions of demonstration videos, and unfold each in imagination under them.

    Stretches in which nothing moves are left out (`moving_rows`), and never held: the labels of 260,000 transitions of
    eight slots are 1.1 GB.

    Args:
        trim: motion of the slots up to which a transition is still; 0 keeps every one.
        margin: still ones kept after each stretch of motion.

    Raises:
        DataError: no episode has two frames, nothing moves, mode `ground_truth` without actions, or actions of another
            width.
    """
    moving = moving_slots(transitions(source), slots, trim, margin)
    # Where the transition of each row goes; -1: nowhere.
    of_kept = np.full(int((source.starts + source.lengths).max()), -1)
    of_kept[moving.rows] = np.arange(len(moving.rows))
    actions = None if source.actions is None else real_actions(source, moving.rows, model.env.action_dim).to(device)
    task, labels = told_tasks(source, moving, model.env), tuple[Tensor, ...]()
    goal = ends_in(source, slots, moving).to(device) if model.config.policy.goal else None
    for length in np.unique(source.lengths[source.lengths >= 2]):
        for chosen in in_batches(np.nonzero(source.lengths == length)[0], EPISODES_AT_ONCE):
            frames = source.starts[chosen][:, None] + np.arange(length)
            places = torch.from_numpy(of_kept[frames[:, :-1]])
            found, kept = _label(model, source, slots, frames, device), places >= 0
            # Filled in: pieces that are joined in the end would need twice the memory.
            labels = labels or tuple(part.new_empty(len(moving.rows), *part.shape[2:]) for part in found)
            for whole, part in zip(labels, found, strict=True):
                whole[places[kept]] = part[kept]
    parsed, imagined, latents = labels
    return Demonstrations(
        slots=parsed,
        imagined=imagined,
        latents=latents,
        actions=actions,
        episode=torch.from_numpy(moving.episode).to(device),
        step=torch.from_numpy(moving.step).to(device),
        lengths=torch.from_numpy(moving.lengths),
        task=None if task is None else task.to(device),
        goal=goal,
    )


def _label(
    model: WorldModel,
    source: EpisodeFrames,
    slots: npt.NDArray[np.float32],
    frames: npt.NDArray[np.int64],
    device: torch.device | str,
) -> tuple[Tensor, Tensor, Tensor]:
    """Parsed and imagined slots (B, T, N, D) and latents (B, T, Z) of episodes of equal length, frames (B, T + 1)."""
    read = slots[frames]
    note_read(read.nbytes)
    parsed, actions = torch.from_numpy(read).to(device), None
    if model.inverse_dynamics.config.mode == "ground_truth":
        actions = torch.from_numpy(source.require_actions()[frames[:, :-1]]).to(device)
    latent = model.inverse_dynamics(parsed, actions)
    rolled = model.predictor.rollout(parsed[:, :1], latent.prototype, latent.variability)
    return parsed[:, :-1], torch.cat((parsed[:, :1], rolled[:, :-1]), dim=1), latent.mean


def with_copies(demos: Sequence[Demonstrations]) -> Demonstrations:
    """Demonstrations, and shifted copies of them after them, as one set."""
    first, *copies = demos
    if not copies:
        return first
    there = [name for name in BY_ROW if getattr(first, name) is not None]
    return replace(first, **{name: torch.cat([getattr(copy, name) for copy in demos]) for name in there})
