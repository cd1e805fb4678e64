"""How far colours are apart for the eye, by the published formula."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from playslot_rl.config.env import COLOURS, Rgb

_TO_XYZ = (
    (0.4124564, 0.3575761, 0.1804375),
    (0.2126729, 0.7151522, 0.0721750),
    (0.0193339, 0.1191920, 0.9503041),
)
_WHITE = (0.95047, 1.0, 1.08883)
"""Illuminant D65, 2 degrees."""


def lab(rgb: Rgb) -> npt.NDArray[np.float64]:
    """CIE L*a*b* (D65) of an sRGB colour [0, 255]: (3,)."""
    value = np.asarray(rgb, np.float64) / 255.0
    linear = np.where(value > 0.04045, ((value + 0.055) / 1.055) ** 2.4, value / 12.92)
    ratio = np.asarray(_TO_XYZ) @ linear / np.asarray(_WHITE)
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio * (29 / 6) ** 2 / 3 + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def ciede2000(first: npt.NDArray[np.float64], second: npt.NDArray[np.float64]) -> float:
    """CIEDE2000 colour difference of two L*a*b* colours (3,), at least 0.

    After G. Sharma, W. Wu and E. Dalal, "The CIEDE2000 Color-Difference Formula", Color Research and Application 30(1),
    2005, with k_L = k_C = k_H = 1; the names are theirs.
    """
    (L1, a1, b1), (L2, a2, b2) = first, second
    mean_C = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    G = 0.5 * (1 - np.sqrt(mean_C**7 / (mean_C**7 + 25.0**7)))
    a1, a2 = (1 + G) * a1, (1 + G) * a2
    C1, C2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    apart, grey = h2 - h1, C1 * C2 == 0
    turn = 0.0 if grey else apart - 360 * np.sign(apart) * (abs(apart) > 180)
    dL, dC, dH = L2 - L1, C2 - C1, 2 * np.sqrt(C1 * C2) * np.sin(np.radians(turn / 2))
    L, C, h = (L1 + L2) / 2, (C1 + C2) / 2, (h1 + h2) / 2
    if grey:
        h = h1 + h2
    elif abs(apart) > 180:
        h += 180 if h1 + h2 < 360 else -180
    T = 1 - 0.17 * _cos(h - 30) + 0.24 * _cos(2 * h) + 0.32 * _cos(3 * h + 6) - 0.20 * _cos(4 * h - 63)
    S_L = 1 + 0.015 * (L - 50) ** 2 / np.sqrt(20 + (L - 50) ** 2)
    S_C, S_H = 1 + 0.045 * C, 1 + 0.015 * C * T
    theta = 30 * np.exp(-(((h - 275) / 25) ** 2))
    R_T = -2 * np.sqrt(C**7 / (C**7 + 25.0**7)) * np.sin(np.radians(2 * theta))
    x, y, z = dL / S_L, dC / S_C, dH / S_H
    return float(np.sqrt(x**2 + y**2 + z**2 + R_T * y * z))


def _cos(degrees: float) -> float:
    return float(np.cos(np.radians(degrees)))


def redness(rgb: Rgb) -> float:
    """CIEDE2000 difference from pure red: 0 for red, larger for less red."""
    return ciede2000(lab(rgb), lab(COLOURS["red"]))
