"""Config of `playslot adopt` (the group `adopt` of the experiment's config)."""

from __future__ import annotations

from dataclasses import dataclass, field

from playslot_rl.config.roles import Checked, at_least, below_one


@dataclass(frozen=True)
class AdoptConfig(Checked):
    """What is tried and how the time is spent.

    Attributes:
        slots: numbers of slots that are tried; one of them is taken as it is.
        prototypes: size of the codebook in the trial that decides how many prototypes there are.
        tolerance: a smaller number of slots is taken where its error is at most this fraction above the least.
        patience: validations without a lower error after which a training ends.
    """

    group = "adopt."
    slots: tuple[int, ...] = field(default=(4, 6, 8), metadata=at_least(2, "numbers of slots from 2 on", 256))
    prototypes: int = field(default=16, metadata=at_least(4, largest=4096))
    tolerance: float = field(default=0.05, metadata=below_one())
    patience: int = field(default=3, metadata=at_least(1))

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.slots:
            raise ValueError("adopt.slots: got none, expected at least one number of slots, such as [4,6,8]")
