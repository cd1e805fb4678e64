"""Looking at a data set: one HTML page, or the rerun viewer.

Shapes: T frames of an episode, H W frame height and width, A width of a vector.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from playslot_rl import keys
from playslot_rl.data.contents import Contents, Span
from playslot_rl.data.frames import rgb_frames
from playslot_rl.data.metadata import is_depth
from playslot_rl.data.tables import Array, Episode
from playslot_rl.data.windows import spread_evenly
from playslot_rl.datasets.info import info
from playslot_rl.datasets.verify import require_sound
from playslot_rl.errors import ConfigError
from playslot_rl.frames import png
from playslot_rl.storage.atomic import write_text
from playslot_rl.storage.folders import by_name, require_outside
from playslot_rl.visualization.charts import DARK, LIGHT, curve_figure, figure_bytes
from playslot_rl.visualization.document import Block, Document, Picture, Section, Table, Text, to_html
from playslot_rl.visualization.grid import animation, image_grid

FEATURES: Final = {
    keys.FEATURE_STATE: "state of the robot",
    keys.FEATURE_ACTION: "action",
    keys.FEATURE_LATENT: "latent action",
    keys.FEATURE_CODE: "number of the latent action's prototype",
    keys.FEATURE_REWARD: "reward",
    keys.FEATURE_SUCCESS: "success",
    keys.FEATURE_DONE: "end of the episode",
    keys.FEATURE_SEED: "seed of the episode",
    keys.FEATURE_LAST: "last observation",
}
CAMERA: Final = "observation.images."
STRIP: Final = 8  # frames of the strip: the first, the last, and some between
SHOWN_SIDE: Final = 128  # frames are stored about this large: small ones enlarged pixel for pixel, large ones reduced
ENLARGED: Final = 3  # how many times larger the page shows an animation
ANIMATED: Final = 60  # at most this many frames of an animation


@dataclass(frozen=True)
class Clip:
    """An episode as it is shown: frames uint8 (T, H, W, 3) of each camera."""

    span: Span
    episode: Episode
    frames: dict[str, npt.NDArray[np.uint8]]


def view(root: Path, *, episodes: int, out: Path | None, rerun: bool) -> list[str]:
    """`write_page` or `show_in_rerun`; returns what to tell people."""
    if rerun:
        return [f"rerun shows episodes {show_in_rerun(root, episodes)} of {root}"]
    return [f"page: {write_page(root, out, episodes)}"]


def write_page(root: str | Path, out: str | Path | None = None, episodes: int = 6) -> Path:
    """Write one HTML file about a data set; styles and pictures are inside it.

    Args:
        out: file to write, replaced if it exists; None means `ROOT.html` beside the data set, never in it.
        episodes: episodes to show, evenly spread.

    Raises:
        ConfigError: fewer than one episode.
        DataError: the data set is damaged.
        OutputError: the file lies in a data set, or cannot be written.
    """
    contents = require_sound(root)
    here = by_name(contents.root)
    target = Path(out) if out is not None else here.with_name(f"{here.name}.html")
    require_outside(target, [contents.root], "--out ", "file")
    chosen = spread(len(contents.spans), episodes)
    summary = info(root)
    about = Table(["what", "value"], summary.facts())
    rows = [[feature_text(name), f"`{name}`", kind] for name, kind in summary.features.items()]
    features = Table(["feature", "name in the data set", "type and shape"], rows)
    sections = [Section("Data set", [about, features])]
    sections += [_episode_section(contents, clip) for clip in _clips(contents, chosen, SHOWN_SIDE)]
    lead = f"{summary.episodes} episodes, {summary.frames} frames at {summary.fps:g} fps; shown: {_names(chosen)}."
    write_text(target, to_html(Document(f"Data set {here.name}", lead, sections)))
    return target


def show_in_rerun(root: str | Path, episodes: int = 6) -> str:
    """Open the rerun viewer on some episodes; returns their numbers, in words.

    Raises:
        ConfigError: rerun is not installed, or fewer than one episode.
        DataError: the data set is damaged.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise ConfigError(
            "--rerun: got no module rerun, expected the viewer: run `pip install rerun-sdk`, or leave --rerun out for "
            "an HTML page"
        ) from error
    contents = require_sound(root)
    chosen = spread(len(contents.spans), episodes)
    rr.init(f"playslot dataset {by_name(contents.root).name}", spawn=True)
    for clip in _clips(contents, chosen):
        where = f"episode_{clip.span.index}"
        for t in range(clip.span.length):
            rr.set_time("frame_index", sequence=t)
            rr.set_time("timestamp", duration=t / contents.fps)
            for camera, frames in clip.frames.items():
                rr.log(f"{where}/{camera}", rr.Image(frames[t]))
            for name in _curves(contents):
                rr.log(f"{where}/{name}", rr.Scalars(np.atleast_1d(contents.columns[name][clip.span.start + t])))
    return _names(chosen)


def spread(total: int, wanted: int) -> list[int]:
    """`wanted` numbers below `total`, evenly spread, first and last among them; a ConfigError for less than 1."""
    if wanted < 1:
        raise ConfigError(f"--episodes: got {wanted}, expected at least 1")
    chosen: list[int] = spread_evenly(np.arange(total), wanted).tolist()
    return chosen


def ordinal(number: int) -> str:
    """A number from 1 on as 1st, 2nd, 3rd, 4th, 11th, 21st, ..."""
    ending = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{ending}"


def _names(chosen: Sequence[int]) -> str:
    return ", ".join(map(str, chosen))


def _curves(contents: Contents) -> list[str]:
    """Features worth a curve: actions, states and whatever else was observed as numbers, rewards and success."""
    observed = [name for name in contents.columns if name.startswith("observation.")]
    wanted = (keys.FEATURE_ACTION, *observed, keys.FEATURE_REWARD, keys.FEATURE_SUCCESS, "reward", "success")
    columns = {name: contents.numbers(name) for name in wanted}
    return [name for name, values in columns.items() if values is not None and values.ndim <= 2]


def _clips(contents: Contents, chosen: Sequence[int], side: int = 0) -> Iterator[Clip]:
    """One after the other: minutes of several cameras would not fit side by side."""
    cameras = [c for c in contents.cameras if not is_depth(contents.features[c])]
    for n in chosen:
        frames = {camera: episode_frames(contents, camera, n, side) for camera in cameras}
        yield Clip(contents.spans[n], contents.episodes[n], frames)


def episode_frames(contents: Contents, camera: str, number: int, side: int = 0) -> npt.NDArray[np.uint8]:
    """Frames of one episode of a sound data set: uint8 (T, H, W, 3), large ones reduced to about `side` pixels unless
    that is 0; a DataError where one cannot be decoded.
    """
    small = []
    for _, frame in rgb_frames(contents, camera, [contents.spans[number]]):
        step = max(1, max(frame.shape[:2]) // side) if side else 1
        small.append(frame[::step, ::step].copy())
    return np.stack(small)


def _episode_section(contents: Contents, clip: Clip) -> Section:
    blocks: list[Block] = [Text(_caption(contents, clip))]
    for camera, frames in clip.frames.items():
        blocks += _camera_pictures(contents, clip, camera, frames)
    return Section(f"Episode {clip.span.index}", [*blocks, *_curve_pictures(contents, clip)])


def _caption(contents: Contents, clip: Clip) -> str:
    rows = slice(clip.span.start, clip.span.stop)
    parts = [
        f"{clip.span.length} frames, {clip.span.length / contents.fps:.1f} s",
        *(task.rstrip(".") for task in clip.episode.tasks),
    ]
    seeds, solved = contents.numbers(keys.FEATURE_SEED), contents.numbers(keys.FEATURE_SUCCESS)
    if seeds is not None:
        parts.append(f"seed {int(seeds[clip.span.start])}")
    if solved is not None:
        first = np.flatnonzero(solved[rows])
        parts.append(f"success at step {int(first[0]) + 1}" if len(first) else "no success")
    return "; ".join(parts) + "."


def _camera_pictures(contents: Contents, clip: Clip, camera: str, frames: npt.NDArray[np.uint8]) -> list[Picture]:
    scale = max(1, SHOWN_SIDE // max(frames.shape[1:3]))
    every = -(-len(frames) // ANIMATED)
    moving = [image_grid(frame[None, None], scale=scale) for frame in frames[::every]]
    still = png(moving[0])
    at = spread(len(frames), STRIP)
    strip = png(image_grid(frames[at][None], columns=[str(t) for t in at], scale=scale))
    name, rate = f"episode-{clip.span.index}-{camera}", contents.fps / every
    shown = f"{contents.fps:g} fps" if every == 1 else f"every {ordinal(every)} frame"
    alt = f"Episode {clip.span.index} from {camera}"
    width = ENLARGED * moving[0].width
    words = feature_text(camera)
    alt_strip = f"Frames {_names(at)} of episode {clip.span.index} from {camera}"
    return [
        Picture(
            name, animation(moving, rate), alt, f"{words[:1].upper()}{words[1:]}, {shown}", still=still, width=width
        ),
        Picture(f"{name}-strip", strip, alt_strip, "Frames by their numbers in the episode"),
    ]


def feature_text(name: str) -> str:
    """A data set's feature in words, or its name where we do not know it."""
    if name.startswith(CAMERA):
        return f"camera {name.removeprefix(CAMERA)}"
    return FEATURES.get(name, name)


def _curve_pictures(contents: Contents, clip: Clip) -> list[Picture]:
    rows = slice(clip.span.start, clip.span.stop)
    panels: dict[str, dict[str, Array]] = {}
    for name in _curves(contents):
        values = contents.columns[name][rows].astype(np.float64).reshape(clip.span.length, -1)
        labels = contents.features[name].get("names") or []
        labels = labels if isinstance(labels, list) and len(labels) == values.shape[1] else []
        parts = itertools.zip_longest(labels, values.T)
        panels[feature_text(name)] = {str(label or number): line for number, (label, line) in enumerate(parts)}
    if not panels:
        return []
    alt = f"{', '.join(panels)} of episode {clip.span.index} over its frames"
    light, dark = (figure_bytes(curve_figure(panels, theme), theme) for theme in (LIGHT, DARK))
    return [Picture(f"episode-{clip.span.index}-curves", light, alt, "Over the numbers of the frames", dark=dark)]
