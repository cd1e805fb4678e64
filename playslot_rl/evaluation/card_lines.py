"""The lines of the report card: what is measured, and which values are good and which are bad.

A verdict is a rule of thumb, not a test: `good` and `bad` each have a border, what lies between is `fair`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Literal

Verdict = Literal["good", "fair", "bad", "not measured"]
NO_NUMBERS: Final = "what the world model computes are not numbers (NaN or infinite)"


@dataclass(frozen=True)
class Measure:
    """One line of every card.

    Attributes:
        group: the section it belongs to.
        name: what is measured, in words.
        good, bad: which values are good and which are bad, in words.
        borders: the value from which on it is good, and up to which it is bad; if less is better, the other way round.
    """

    group: str
    name: str
    good: str
    bad: str
    borders: tuple[float, float]


LATENTS, ACTIONS, EFFECTS, SLOTS = "Latent actions", "The real action in the latent", "What latents do", "Slots"
MEASURES: Final[Mapping[str, Measure]] = {
    "codes_in_use": Measure(LATENTS, "codes in use, share of the prototypes", "all", "half or fewer", (0.99, 0.5)),
    "perplexity": Measure(
        LATENTS,
        "perplexity of the codes, share of the prototypes",
        "half of them or more in even use",
        "a quarter or less: few codes do all",
        (0.5, 0.25),
    ),
    "directions": Measure(
        LATENTS,
        "effective number of directions (participation ratio)",
        "2 or more",
        "1.3 or less: latents lie on a line",
        (2.0, 1.3),
    ),
    "linear_probe": Measure(ACTIONS, "recovered by a linear probe (R²)", "0.5 or more", "0.2 or less", (0.5, 0.2)),
    "mlp_probe": Measure(ACTIONS, "recovered by a two-layer network (R²)", "0.5 or more", "0.2 or less", (0.5, 0.2)),
    "above_frame": Measure(
        ACTIONS,
        "the better of these, above the better probe of the slots of the frame alone (R²)",
        "0.1 or more: the latent says what the scene does not",
        "0 or less: the scene alone says as much",
        (0.1, 0.0),
    ),
    "lag": Measure(
        ACTIONS,
        "lag: the better probe of the latent one transition later, above that of the action's own (R²)",
        "0 or less: an action shows at once",
        "0.1 or more: the robot follows late, and a latent shows the action before it",
        (0.0, 0.1),
    ),
    "shuffled_probe": Measure(
        ACTIONS,
        "control: latents paired with other actions (R²)",
        "0.05 or less: the probes invent nothing",
        "0.2 or more",
        (0.05, 0.2),
    ),
    "noise_size": Measure(
        ACTIONS,
        "control: size of the latent of one frame and the same with camera noise, share of a real one's",
        "0.1 or less: what stands still has no action",
        "0.4 or more: noise looks like an action",
        (0.1, 0.4),
    ),
    "noise_probe": Measure(
        ACTIONS,
        "control: recovered from such a noise latent (R²)",
        "0.1 or less",
        "0.3 or more: the latent tells the scene",
        (0.1, 0.3),
    ),
    "replay": Measure(
        EFFECTS,
        "latents replayed from their own frame: the slots move as they did (correlation)",
        "0.7 or more",
        "0.3 or less",
        (0.7, 0.3),
    ),
    "transfer": Measure(
        EFFECTS,
        "transfer: replayed from a frame of another episode (correlation with the motion they were taken from)",
        "0.5 or more",
        "0.2 or less: a latent means another thing elsewhere",
        (0.5, 0.2),
    ),
    "transfer_shuffled": Measure(
        EFFECTS, "control: with the motion of another window", "0.1 or less", "0.3 or more", (0.1, 0.3)
    ),
    "same_slot": Measure(
        EFFECTS,
        "transfer: the slot that moves most is the same, share of the windows",
        "0.8 or more",
        "0.4 or less",
        (0.8, 0.4),
    ),
    "constancy": Measure(
        EFFECTS,
        "constancy: share of the variance of held prototypes' effects that lies between prototypes",
        "0.5 or more: one means the same everywhere",
        "0.2 or less",
        (0.5, 0.2),
    ),
    "sensitivity": Measure(
        EFFECTS,
        "sensitivity: change of the imagined frame when the latents are exchanged, share of the real change",
        "0.5 or more",
        "0.1 or less: latents are ignored",
        (0.5, 0.1),
    ),
    "locality": Measure(
        EFFECTS,
        "locality: how far that change keeps to the slots that move (0: evenly spread, 1: entirely)",
        "0.6 or more",
        "0.2 or less: it is everywhere",
        (0.6, 0.2),
    ),
    "slots_in_use": Measure(
        SLOTS,
        "slots in use, share of them",
        "0.75 or more",
        "0.4 or less: few slots hold everything",
        (0.75, 0.4),
    ),
    "flicker": Measure(SLOTS, "flicker: exchanges of slots a transition", "0.02 or less", "0.1 or more", (0.02, 0.1)),
    "mask_entropy": Measure(
        SLOTS,
        "mask entropy, share of log N",
        "0.5 or less: each pixel has its slot",
        "0.95 or more: all share all",
        (0.5, 0.95),
    ),
    "moving_explained": Measure(
        SLOTS,
        "share of the moving pixels' change that is drawn",
        "0.6 or more",
        "0.3 or less: what moves is not seen",
        (0.6, 0.3),
    ),
}


@dataclass(frozen=True)
class Line:
    """A measure's value.

    Attributes:
        key: of `MEASURES`.
        group, measure, good, bad: its words.
        value: None where it was not measured.
        verdict: on the value.
        note: what the number was computed from, or why it was not measured.
    """

    key: str
    group: str
    measure: str
    value: float | None
    good: str
    bad: str
    verdict: Verdict
    note: str

    def plain(self) -> dict[str, Any]:
        """As JSON holds it."""
        return asdict(self)

    def without_value(self, why: str) -> Line:
        """The line where its value says nothing: not measured, and why."""
        told = "" if self.value is None else f"{self.value:.2f} says nothing, "
        return replace(self, value=None, verdict="not measured", note=f"{told}{why} ({self.note})")


def judge(value: float | None, borders: tuple[float, float]) -> Verdict:
    """On which side of the borders (good from, bad up to) a value is.

    Examples:
        >>> judge(0.6, (0.5, 0.2)), judge(0.3, (0.5, 0.2)), judge(0.3, (0.1, 0.3)), judge(None, (0.1, 0.3))
        ('good', 'fair', 'bad', 'not measured')
    """
    if value is None:
        return "not measured"
    good, bad = borders
    sign = 1.0 if good > bad else -1.0
    if sign * value >= sign * good:
        return "good"
    return "bad" if sign * value <= sign * bad else "fair"


def line(key: str, value: float | None, note: str = "") -> Line:
    """A line of the card.

    Args:
        key: of `MEASURES`.
        value: what was measured; None for nothing.
        note: what it was computed from, or why there is none.
    """
    m = MEASURES[key]
    if value is not None and not math.isfinite(value):
        value, note = None, NO_NUMBERS
    return Line(key, m.group, m.name, value, m.good, m.bad, judge(value, m.borders), note)
