"""Weights that others published, from a file: as torchvision stores them, or as safetensors."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from playslot_rl.errors import CheckpointError


def read_published(path: Path, key: str, network: str, cure: str) -> dict[str, Tensor]:
    """Tensors by name from a `.safetensors` file, or a `.pth` as published; of that tensors are read only, nothing is
    run.

    Args:
        key: config key that named it.
        network: whose weights are expected.
        cure: what to do without them, for the message.

    Raises:
        CheckpointError: it is missing or damaged.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        if path.suffix == ".safetensors":
            return load(path.read_bytes())
        state: dict[str, Tensor] = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, SafetensorError, pickle.UnpicklingError) as error:
        said = (str(error).splitlines() or [type(error).__name__])[0]  # an empty file says nothing
        raise CheckpointError(
            f"{key}={path}: got {said}, expected a file of {network}'s weights: check the path, or {cure}"
        ) from error
    return state


def pick_published(
    state: Mapping[str, Tensor], names: Mapping[str, str], shapes: Mapping[str, Tensor], where: str, cure: str
) -> dict[str, Tensor]:
    """The tensors a network of ours, with these shapes, takes; `names` are the published ones of each of ours. `where`
    (the key and the file) and `cure` (what to do without them) are for the message.

    Raises:
        CheckpointError: one is missing or of another shape.
    """
    wrong = sorted(old for own, old in names.items() if old not in state or state[old].shape != shapes[own].shape)
    if wrong:
        raise CheckpointError(f"{where}: got no tensor {wrong[0]} of its shape, expected another file: {cure}")
    return {own: state[old] for own, old in names.items()}
