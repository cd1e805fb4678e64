"""A session written down: an animation, and a LeRobot v3.0 data set of one episode.

Shapes: T steps, N slots, Z latent-action width, A action width, H W image height and width.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from playslot_rl import keys
from playslot_rl.collectors.image_set import ImageSetWriter, feature, finalising, new_set
from playslot_rl.errors import DataError
from playslot_rl.frames import png
from playslot_rl.play.pictures import session_animation
from playslot_rl.play.session import PlaySession
from playslot_rl.play.timeline import SceneMoment
from playslot_rl.runtime.progress import quiet_datasets
from playslot_rl.storage.atomic import explain_write_errors, write_bytes, write_json
from playslot_rl.storage.folders import new_folder
from playslot_rl.storage.locks import locked

Shown = Literal["imagined", "true"]

LOCK: Final = ".lock"


def record(session: PlaySession, parent: Path, shown: Shown = "imagined", camera: str = keys.FEATURE_IMAGE) -> Path:
    """Write the path from the session's start to its present moment: a new folder `recording-NNN` in `parent`, whole or
    not there, with `session.gif`, `session.json` and the data set in `dataset`. Its frames are the imagined ones or
    those of the simulator; `camera` is the model's own feature, so that the recording goes with its data.

    A DataError where there is no step yet, or there are no true frames.
    """
    path = session.timeline.path()
    if not any(moment.latent is not None for moment in path):
        raise DataError("record: got no step yet, expected at least one: press a prototype first")
    if shown == "true" and any(moment.true is None for moment in path):
        raise DataError("record: got a session without a simulator, expected one: record the imagined frames")
    with explain_write_errors(parent):
        parent.mkdir(parents=True, exist_ok=True)
    # Another `playslot play` may record into the same folder: one after the other, each its number.
    with locked(parent / LOCK), new_folder(final := _free(parent)) as folder:
        write_bytes(folder / "session.gif", session_animation(path, session.start.fps))
        _write_set(folder / "dataset", session, path, shown, camera)
        about = {
            "start": session.start.title,
            "frames": shown,
            "moments": [{"label": moment.label, "error": moment.error} for moment in path],
        }
        write_json(folder / "session.json", about)
    return final


def _free(parent: Path) -> Path:
    taken = [int(found.name[10:]) for found in parent.glob("recording-*") if found.name[10:].isdigit()]
    return parent / f"recording-{max([0, *taken]) + 1:03d}"


def columns(
    session: PlaySession, path: Sequence[SceneMoment], shown: Shown, camera: str = keys.FEATURE_IMAGE
) -> dict[str, npt.NDArray[Any]]:
    """LeRobot features of a path with T steps, (T + 1, ...): row t is a frame and the actions that followed it.

    A touch makes no row: the frame before the next step is the touched one. The last row's actions are padding.
    """
    steps = [moment for moment in path if moment.latent is not None]
    moments = session.timeline.moments
    seen = [moments[moment.parent] for moment in steps if moment.parent is not None] + [path[-1]]
    frames = [moment.frame if shown == "imagined" else moment.true for moment in seen]
    index, n = np.arange(len(steps) + 1), session.world_model.slot_shape[0]
    latents, codes = [], []
    for moment in steps:
        assert moment.latent is not None
        assert moment.code is not None
        latent, code = moment.latent.cpu().numpy().copy(), moment.code.cpu().numpy().reshape(-1).copy()
        if session.per_slot:
            gone = [slot for slot in range(n) if slot not in moment.present]
            latent[gone], code[gone] = 0.0, -1
        latents.append(latent.reshape(-1))
        codes.append(code)
    found = {
        camera: np.stack([frame for frame in frames if frame is not None]),
        keys.FEATURE_LATENT: _padded(np.stack(latents).astype(np.float32)),
        keys.FEATURE_CODE: _padded(np.stack(codes).astype(np.int64)),
        keys.FEATURE_DONE: (index >= len(steps) - 1)[:, None],
        keys.FEATURE_LAST: (index == len(steps))[:, None],
    }
    actions = [moment.action for moment in steps if moment.action is not None]
    if actions:
        found[keys.FEATURE_ACTION] = _padded(np.stack(actions))
    return found


def _padded(rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.concatenate([rows, np.zeros_like(rows[:1])])


def _write_set(root: Path, session: PlaySession, path: Sequence[SceneMoment], shown: Shown, camera: str) -> None:
    values = columns(session, path, shown, camera)
    kinds = {name: "image" if name == camera else str(column.dtype) for name, column in values.items()}
    features = {name: feature(kinds[name], *column.shape[1:]) for name, column in values.items()}
    with quiet_datasets():
        fps, robot = max(1, round(session.start.fps)), session.world_model.env.name
        dataset = new_set("playslot_rl/played", root, fps, robot, features)
        frames = values.pop(camera)
        with (
            finalising(dataset),
            contextlib.closing(ImageSetWriter(dataset.meta, dataset.root, session.start.task)) as writer,
        ):
            writer.add(values, frames, [png(frame) for frame in frames])
