"""The lines of the report card: what is measured, which values are good and which are bad, and what the lines are worth
together: which say nothing, and whether the world model is usable.

A verdict is a rule of thumb, not a test: `good` and `bad` each have a border, what lies between is `fair`. A line built
on something that is worth nothing (a control of a probe that finds nothing, slots that keep their places while nothing
of the motion is drawn) is not measured, however good its number looks. A bad one stays bad.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Literal

Verdict = Literal["good", "fair", "bad", "not measured"]
NO_NUMBERS: Final = "what the world model computes are not numbers (NaN or infinite)"
NO_LATENTS: Final = "this world model has no latent actions (mode none)"
UNTOLD: Final = "no probe recovers the action from the latent"


@dataclass(frozen=True)
class Measure:
    """One line of every card.

    Attributes:
        group: the section it belongs to.
        name: what is measured.
        borders: the value from which on it is good, and up to which it is bad; if less is better, the other way round.
        good, bad: which values those are, as the reader is told; what begins with a colon follows the border.
    """

    group: str
    name: str
    borders: tuple[float, float]
    good: str = ":"
    bad: str = ":"

    def told(self, verdict: Literal["good", "bad"]) -> str:
        """Which values are good, or bad: `0.2 or less: a latent means another thing elsewhere`."""
        said = self.good if verdict == "good" else self.bad
        more = (self.borders[0] > self.borders[1]) == (verdict == "good")
        border = f"{self.borders[verdict == 'bad']:g} or {'more' if more else 'less'}"
        return f"{border}{said}".removesuffix(":") if said.startswith(":") else said


LATENTS, ACTIONS, EFFECTS, SLOTS = "Latent actions", "The real action in the latent", "What latents do", "Slots"
MEASURES: Final[Mapping[str, Measure]] = {
    "codes_in_use": Measure(LATENTS, "codes in use, share of the prototypes", (0.99, 0.5), "all", "half or fewer"),
    "perplexity": Measure(
        LATENTS,
        "perplexity of the codes, share of the prototypes",
        (0.5, 0.25),
        "half of them or more in even use",
        "a quarter or less: few codes do all",
    ),
    "directions": Measure(
        LATENTS, "effective number of directions (participation ratio)", (2.0, 1.3), bad=": latents lie on a line"
    ),
    "linear_probe": Measure(ACTIONS, "recovered by a linear probe (R²)", (0.5, 0.2)),
    "mlp_probe": Measure(ACTIONS, "recovered by a two-layer network (R²)", (0.5, 0.2)),
    "above_frame": Measure(
        ACTIONS,
        "the better of these, above the better probe of the slots of the frame alone (R²)",
        (0.1, 0.0),
        ": the latent says what the scene does not",
        ": the scene alone says as much",
    ),
    "lag": Measure(
        ACTIONS,
        "lag: the better probe of the latent one transition later, above that of the action's own (R²)",
        (0.0, 0.1),
        ": an action shows at once",
        ": the robot follows late, and a latent shows the action before it",
    ),
    "shuffled_probe": Measure(
        ACTIONS, "control: latents paired with other actions (R²)", (0.05, 0.2), ": the probes invent nothing"
    ),
    "noise_size": Measure(
        ACTIONS,
        "control: size of the latent of one frame and the same with camera noise, share of a real one's",
        (0.1, 0.4),
        ": what stands still has no action",
        ": noise looks like an action",
    ),
    "noise_probe": Measure(
        ACTIONS, "control: recovered from such a noise latent (R²)", (0.1, 0.3), bad=": the latent tells the scene"
    ),
    "telling_slots": Measure(
        ACTIONS,
        "share of the slots' change that is of slots whose change tells of the action",
        (0.6, 0.3),
        bad=": most of what changes is no action, and latents take it in",
    ),
    "replay": Measure(
        EFFECTS, "latents replayed from their own frame: the slots move as they did (correlation)", (0.7, 0.3)
    ),
    "transfer": Measure(
        EFFECTS,
        "transfer: replayed from a frame of another episode (correlation with the motion they were taken from)",
        (0.5, 0.2),
        bad=": a latent means another thing elsewhere",
    ),
    "transfer_shuffled": Measure(EFFECTS, "control: with the motion of another window", (0.1, 0.3)),
    "same_slot": Measure(EFFECTS, "transfer: the slot that moves most is the same, share of the windows", (0.8, 0.4)),
    "constancy": Measure(
        EFFECTS,
        "constancy: share of the variance of held prototypes' effects that lies between prototypes",
        (0.5, 0.2),
        ": one means the same everywhere",
    ),
    "sensitivity": Measure(
        EFFECTS,
        "sensitivity: change of the imagined frame when the latents are exchanged, share of the real change",
        (0.5, 0.1),
        bad=": latents are ignored",
    ),
    "locality": Measure(
        EFFECTS,
        "locality: how far that change keeps to the slots that move (0: evenly spread, 1: entirely)",
        (0.6, 0.2),
        bad=": it is everywhere",
    ),
    "slots_in_use": Measure(SLOTS, "slots in use, share of them", (0.75, 0.4), bad=": few slots hold everything"),
    "flicker": Measure(SLOTS, "flicker: exchanges of slots a transition", (0.02, 0.1)),
    "mask_entropy": Measure(
        SLOTS, "mask entropy, share of log N", (0.5, 0.95), ": each pixel has its slot", ": all share all"
    ),
    "moving_explained": Measure(
        SLOTS, "share of the moving pixels' change that is drawn", (0.6, 0.3), bad=": what moves is not seen"
    ),
}


@dataclass(frozen=True)
class Line:
    """A measure's value, None where it was not measured; its note says what it was computed from, or why not."""

    key: str
    group: str
    measure: str
    value: float | None
    good: str
    bad: str
    verdict: Verdict
    note: str

    def plain(self) -> dict[str, Any]:
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
    m = MEASURES[key]
    if value is not None and not math.isfinite(value):
        value, note = None, NO_NUMBERS
    return Line(key, m.group, m.name, value, m.told("good"), m.told("bad"), judge(value, m.borders), note)


PROBES: Final = ("linear_probe", "mlp_probe")
SEEN: Final = ("moving_explained",)
APART: Final = (SEEN, ("mask_entropy",), ("slots_in_use",))
CARRIED: Final = (("replay", *PROBES),)
NEEDS: Final[Mapping[str, tuple[tuple[str, ...], ...]]] = {
    "codes_in_use": CARRIED,
    "perplexity": CARRIED,
    "directions": CARRIED,
    "shuffled_probe": (PROBES,),
    "noise_size": CARRIED,
    "noise_probe": (PROBES,),
    "telling_slots": (SEEN,),
    "replay": APART,
    "transfer": (("replay",),),
    "transfer_shuffled": (("transfer",),),
    "same_slot": (("transfer",),),
    "constancy": (("replay",),),
    "sensitivity": (("replay",),),
    "locality": (("sensitivity",),),
    "slots_in_use": (SEEN,),
    "flicker": APART,
    "mask_entropy": (SEEN, ("slots_in_use",)),
}
"""Of each group of measures that a measure builds on, one at least has to be worth something."""
WORTHLESS: Final = {"moving_explained": 0.1, "linear_probe": 0.0, "mlp_probe": 0.0}
"""Values up to which a measure's own parts are nothing; of the others, those that are bad."""
WORDS: Final = {
    "moving_explained": "what moves is not drawn",
    "mask_entropy": "all slots share all pixels",
    "slots_in_use": "few slots hold everything",
    "replay": "replayed latents do not move the slots as these moved",
    "linear_probe": UNTOLD,
    "transfer": "latents do not move the slots of another episode as these moved",
    "sensitivity": "the future hardly depends on the latents",
}
ENOUGH: Final = 4
"""Tested episodes: of fewer a probe's R² is chance, and nothing that was measured is worth much."""
COLLAPSED: Final = 0.98
"""Share of the transitions of one prototype, from which on the others are not in use."""


@dataclass(frozen=True)
class Conclusion:
    usable: bool
    reason: str

    def __str__(self) -> str:
        return f"verdict: {'usable' if self.usable else 'not usable'}: {self.reason}"


def settle(lines: Sequence[Line]) -> list[Line]:
    """The lines, those that build on something worthless not measured."""
    known, settled = {one.key: one for one in lines}, []
    for one in lines:
        missing = None if one.verdict in ("bad", "not measured") else _missing(one.key, known)
        settled.append(one if missing is None else one.without_value(_words(missing, known)))
    return settled


def _missing(key: str, known: Mapping[str, Line]) -> Sequence[str] | None:
    """The first group that a measure builds on and that is worth nothing."""
    return next((g for g in NEEDS.get(key, ()) if not any(_worth(part, known) for part in g)), None)


def _worth(key: str, known: Mapping[str, Line]) -> bool:
    """Whether a line, and all that it builds on, is worth something; slots that cannot be judged are."""
    one = known.get(key)
    if one is None or one.value is None:
        return key in (part for group in APART for part in group)
    return not worthless(key, one.value) and _missing(key, known) is None


def worthless(key: str, value: float) -> bool:
    """Whether a value of a measure says that there is nothing."""
    return value <= WORTHLESS[key] if key in WORTHLESS else judge(value, MEASURES[key].borders) == "bad"


def _words(missing: Sequence[str], known: Mapping[str, Line]) -> str:
    """What is wrong with a group: its first part that has words, and of that the part which is wrong itself."""
    key = next(key for key in missing if key in WORDS)
    deeper = _missing(key, known)
    value = known[key].value if key in known else None
    if deeper is not None and value is not None and not worthless(key, value):
        return _words(deeper, known)
    return WORDS[key]


def concluded(result: Mapping[str, Any]) -> Conclusion:
    """The verdict of a stored card, also of one from before there were any."""
    tested = len(result.get("episodes_tested", range(ENOUGH)))
    return conclude(result["lines"], result["details"].get("code_counts", []), tested)


def conclude(lines: Sequence[Mapping[str, Any]], code_counts: Sequence[int] = (), tested: int = ENOUGH) -> Conclusion:
    """The verdict, from settled lines as plain values (`Line.plain`), how many transitions each prototype has, and how
    many episodes were tested: below `ENOUGH` no probe decides.
    """
    values = {str(one["key"]): one["value"] for one in lines}
    notes = {str(one["key"]): str(one["note"]) for one in lines}
    if NO_NUMBERS in notes.values():
        return Conclusion(False, NO_NUMBERS)
    if notes.get("replay") == NO_LATENTS:
        return Conclusion(False, NO_LATENTS)
    for key in ("moving_explained", "mask_entropy", "slots_in_use"):
        if (value := values.get(key)) is not None and worthless(key, value):
            return Conclusion(False, f"{WORDS[key]} ({key} {value:.2f})")
    total = sum(code_counts)
    if len(code_counts) > 1 and max(code_counts) >= COLLAPSED * total:
        return Conclusion(
            False, f"one of {len(code_counts)} prototypes holds {max(code_counts) / total:.0%} of the transitions"
        )
    for key in ("replay", "sensitivity"):
        value = values.get(key)
        if value is not None and worthless(key, value):
            return Conclusion(False, f"{WORDS[key]} ({key} {value:.2f})")
        if value is None and key == "replay":
            return Conclusion(False, f"replay could not be measured: {notes.get(key, 'no such line')}")
    told = [values[key] for key in PROBES if values.get(key) is not None]
    if told and max(told) <= 0 and tested >= ENOUGH:
        return Conclusion(False, f"{UNTOLD} (R² {max(told):.2f})")
    weak = [str(one["key"]) for one in lines if one["verdict"] == "bad"]
    few = f"; too few episodes to tell: {tested} tested, expected {ENOUGH} or more" if tested < ENOUGH else ""
    return Conclusion(True, f"replay {values['replay']:.2f}{few}" + (f"; weak: {', '.join(weak)}" if weak else ""))
