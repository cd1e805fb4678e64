"""Which transitions of a video say something: those in which something moves, and a few after them.

    m_t = sqrt(mean (S_{t+1} - S_t)^2),   kept_t = m_t > threshold, or m_u > threshold for some t - margin <= u < t

An expert that holds still once the task is solved fills half of the rows with the one action of doing nothing. Nothing
but the videos is looked at.

Shapes: M transitions of all episodes in a row, T steps of an episode, F frames, N slots, D slot width.
"""

from __future__ import annotations

from torch import Tensor

from playslot_rl.errors import DataError


def slot_motion(slots: Tensor) -> Tensor:
    """RMS change of the slots from one frame to the next: (..., T + 1, N, D) to (..., T), in units of the slots."""
    return (slots[..., 1:, :, :] - slots[..., :-1, :, :]).square().mean(dim=(-2, -1)).sqrt()


def moving_rows(motion: Tensor, step: Tensor, threshold: float, margin: int, key: str = "behaviour.trim") -> Tensor:
    """Transitions in which something moves, and `margin` still ones after each stretch of them: mask bool (M,).

    Args:
        motion: of each transition (M,), the episodes one after the other.
        step: number of each in its episode, int64 (M,).
        key: of the threshold, for the error.

    Raises:
        DataError: nothing moves.
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
