"""What the lines of the report card are worth together: which say nothing, and whether the world model is usable.

A line built on something that is worth nothing (a control of a probe that finds nothing, slots that keep their places
while nothing of the motion is drawn) is not measured, however good its number looks. A bad one stays bad.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from playslot_rl.evaluation.card_lines import MEASURES, NO_NUMBERS, Line, judge
from playslot_rl.evaluation.latent_lines import NO_LATENTS, UNTOLD

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
COLLAPSED: Final = 0.98
"""Share of the transitions of one prototype, from which on the others are not in use."""


@dataclass(frozen=True)
class Conclusion:
    """Whether a world model is usable, with the reason that decides it."""

    usable: bool
    reason: str

    def __str__(self) -> str:
        return f"verdict: {'usable' if self.usable else 'not usable'}: {self.reason}"


def settle(lines: Sequence[Line]) -> list[Line]:
    """The lines, those that build on something worthless not measured."""
    known = {one.key: one for one in lines}
    return [_settled(one, known) for one in lines]


def _settled(one: Line, known: Mapping[str, Line]) -> Line:
    if one.verdict in ("bad", "not measured"):
        return one
    missing = next((g for g in NEEDS.get(one.key, ()) if not any(_worth(key, known) for key in g)), None)
    return one if missing is None else one.without_value(_words(missing, known))


def _worth(key: str, known: Mapping[str, Line]) -> bool:
    """Whether a line, and all that it builds on, is worth something; slots that cannot be judged are."""
    one = known.get(key)
    if one is None or one.value is None:
        return key in (part for group in APART for part in group)
    return not worthless(key, one.value) and all(any(_worth(k, known) for k in group) for group in NEEDS.get(key, ()))


def worthless(key: str, value: float) -> bool:
    """Whether a value of a measure says that there is nothing."""
    return value <= WORTHLESS[key] if key in WORTHLESS else judge(value, MEASURES[key].borders) == "bad"


def _words(missing: Sequence[str], known: Mapping[str, Line]) -> str:
    """What is wrong with a group: its first part that has words, and of that the part which is wrong itself."""
    key = next(key for key in missing if key in WORDS)
    deeper = next((g for g in NEEDS.get(key, ()) if not any(_worth(part, known) for part in g)), None)
    value = known[key].value if key in known else None
    if deeper is not None and value is not None and not worthless(key, value):
        return _words(deeper, known)
    return WORDS[key]


def concluded(result: Mapping[str, Any]) -> Conclusion:
    """The verdict of a stored card, also of one from before there were any."""
    return conclude(result["lines"], result["details"].get("code_counts", []))


def conclude(lines: Sequence[Mapping[str, Any]], code_counts: Sequence[int] = ()) -> Conclusion:
    """The verdict on a world model.

    Args:
        lines: settled, as plain values (`Line.plain`).
        code_counts: of each prototype, how many transitions have it; empty without prototypes.
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
    if told and max(told) <= 0:
        return Conclusion(False, f"{UNTOLD} (R² {max(told):.2f})")
    weak = [str(one["key"]) for one in lines if one["verdict"] == "bad"]
    return Conclusion(True, f"replay {values['replay']:.2f}" + (f"; weak: {', '.join(weak)}" if weak else ""))
