"""Small world models that ship with the package, with how they were made, and an episode of each one's task."""

from __future__ import annotations

from importlib.resources import files
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


def episode(env: str = "button_press") -> npt.NDArray[np.uint8]:
    """Frames of an episode that no training has seen, played by the shipped policy in the simulator until it ended.

    A ValueError for other tasks than `button_press`, `block_push_easy` and `block_push`.

    Returns:
        (T, 64, 64, 3).

    Examples:
        >>> episode("block_push").shape
        (26, 64, 64, 3)
    """
    import numpy as np
    from PIL import Image

    here: Any = files(__name__)
    path = here / f"{env}.png"
    if not path.is_file():
        shipped = sorted(entry.name.removesuffix(".png") for entry in here.iterdir() if entry.name.endswith(".png"))
        raise ValueError(f"env: got {env!r}, expected one of {', '.join(shipped)}")
    with path.open("rb") as stream, Image.open(stream) as strip:
        pixels = np.asarray(strip.convert("RGB"))
    side = pixels.shape[0]  # the frames stand side by side
    frames: npt.NDArray[np.uint8] = pixels.reshape(side, -1, side, 3).swapaxes(0, 1).copy()
    return frames
