"""Colours: the Okabe-Ito palette, which colour-blind readers can tell apart, and the two themes of the charts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

OKABE_ITO: Final = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#7F7F7F")
LABEL: Final = "#767676"
"""Grey of labels on transparent pictures: legible on white and on the report's dark ground."""


@dataclass(frozen=True)
class Theme:
    """Colours of a chart on a light or a dark page; opaque, since files meet pages of other colours."""

    name: str
    ground: str
    text: str
    grid: str
    series: tuple[str, ...]


LIGHT: Final = Theme("light", "#ffffff", "#22262b", "#d8dbe0", OKABE_ITO)
DARK: Final = Theme(
    "dark",
    "#16181c",
    "#e4e6ea",
    "#3b4048",
    ("#4A97DE", "#E69F00", "#2FC79A", "#E39AC4", "#9AD1F3", "#F08A4B", "#F0E442", "#B5B5B5"),
)


@dataclass(frozen=True)
class MethodStyle:
    """How a method looks in every plot: index into a theme's series, and a matplotlib marker."""

    colour: int
    marker: str


METHOD_STYLES: Final = {
    "playslot": MethodStyle(0, "o"),
    "lapo": MethodStyle(5, "s"),
    "slot_oracle": MethodStyle(2, "^"),
    "resnet_oracle": MethodStyle(1, "v"),
    "dreamer": MethodStyle(3, "D"),
    "sold": MethodStyle(4, "P"),
}


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue in [0, 255] of `#rrggbb`."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
