"""Cameras by name: the short one, `top` of `observation.images.top`, is taken wherever it is unique."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.weights import data_roots
from playslot_rl.data.metadata import CAMERAS, read_info
from playslot_rl.errors import DataError


def full_name(wanted: str, cameras: Sequence[str], where: str) -> str:
    """The feature that a name means: itself, or the only one that ends with it after a dot.

    Raises:
        DataError: none or several are called so.

    Examples:
        >>> full_name("top", ["observation.images.top", "observation.images.side"], "data/mine")
        'observation.images.top'
    """
    if wanted in cameras:
        return wanted
    called = [name for name in cameras if wanted and name.endswith(f".{wanted}")]
    if len(called) == 1:
        return called[0]
    if called:
        raise DataError(
            f"data.camera={wanted}: {where} has {len(called)} cameras of that name, expected one: say which of "
            f"{', '.join(called)}"
        )
    raise DataError(
        f"data.camera={wanted}: {where} has no such camera, expected one of: {', '.join(cameras) or 'none'}"
    )


def camera_list(text: str) -> list[str]:
    """The names in a text such as `top,side`."""
    return [name.strip() for name in text.split(",") if name.strip()]


def cameras_of(features: Mapping[str, Mapping[str, Any]]) -> list[str]:
    return [name for name, feature in features.items() if feature["dtype"] in CAMERAS]


def with_full_cameras(config: ExperimentConfig) -> ExperimentConfig:
    """The config with the full names of `data.camera`, as a run stores it.

    Names stay as they were typed where the data sets are not there (yet) to be asked, or do not know them: whoever
    reads them says what is wrong.
    """
    data = config.data
    typed = camera_list(data.camera)
    for root in () if not typed else (*data_roots(data.root), *data_roots(data.demos)):
        with contextlib.suppress(DataError):
            known = cameras_of(read_info(Path(root.path).expanduser())["features"])
            names = ",".join(full_name(name, known, root.path) for name in typed)
            return config if names == data.camera else replace(config, data=replace(data, camera=names))
    return config
