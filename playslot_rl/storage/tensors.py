"""Modules to safetensors and back, with errors that name the tensor."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from playslot_rl.errors import CheckpointError, first_line
from playslot_rl.storage.atomic import write_bytes


@runtime_checkable
class SometimesStored(Protocol):
    """A part of a module whose buffers are stored only where they say something, such as the range of actions."""

    def expect(self, stored: bool) -> None:
        """Learn whether they were."""

    def named_buffers(self) -> Iterator[tuple[str, Tensor]]:
        """Of `nn.Module`."""


def module_tensors(modules: Mapping[str, nn.Module]) -> dict[str, Tensor]:
    """Parameters and persistent buffers of all modules as `MODULE.NAME` tensors."""
    return {f"{name}.{key}": value for name, module in modules.items() for key, value in module.state_dict().items()}


def tensor_bytes(tensors: Mapping[str, Tensor]) -> bytes:
    """The content of a safetensors file. Tensors are copied, because it refuses those that share memory."""
    from safetensors.torch import save

    return save({key: value.detach().to("cpu", copy=True).contiguous() for key, value in tensors.items()})


def save_tensors(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write tensors to a safetensors file, atomically. Raises OutputError: full disk."""
    # Serialised in memory and written by us: safetensors' own writer hides the errno of a full disk.
    write_bytes(path, tensor_bytes(tensors))


def load_tensors(path: Path) -> dict[str, Tensor]:
    """Read a safetensors file onto the CPU; a CheckpointError where it is missing, truncated, or of another kind."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return load_file(path)
    except FileNotFoundError as error:
        raise CheckpointError(f"{path} is missing, expected a checkpoint's weights: train that stage again") from error
    except (SafetensorError, LookupError) as error:
        raise CheckpointError(
            f"{path} is damaged ({first_line(error)}), expected a whole safetensors file: "
            "delete its folder and run the same command again"
        ) from error


def load_modules(modules: Mapping[str, nn.Module], tensors: Mapping[str, Tensor], where: str) -> None:
    """Copy `MODULE.NAME` tensors into the modules (`load_into`); those `SometimesStored` learn if they were."""
    expected, parts = module_tensors(modules), dict[SometimesStored, bool]()
    for name, module in modules.items():
        for path, part in module.named_modules(prefix=name):
            if not isinstance(part, SometimesStored):
                continue
            own = {f"{path}.{key}": value for key, value in part.named_buffers()}
            parts[part] = stored = not own.keys().isdisjoint(tensors)
            expected = {key: value for key, value in expected.items() if key not in own} | (own if stored else {})
    load_into(expected, tensors, where)
    for part, stored in parts.items():
        part.expect(stored)


def load_into(expected: Mapping[str, Tensor], tensors: Mapping[str, Tensor], where: str) -> None:
    """Copy tensors into others of the same names and shapes; nothing is changed unless everything fits, else a
    CheckpointError.
    """
    missing, unexpected = sorted(set(expected) - set(tensors)), sorted(set(tensors) - set(expected))
    if missing or unexpected:
        kind, names = ("misses", missing) if missing else ("holds the unexpected", unexpected)
        more = f" and {len(names) - 1} more" if len(names) > 1 else ""
        raise CheckpointError(
            f"{where} {kind} tensor {names[0]}{more}, expected the {len(expected)} tensors of its config: "
            "train that stage again, or use the version of playslot_rl that wrote it"
        )
    for key, value in expected.items():
        if value.shape != tensors[key].shape:
            raise CheckpointError(
                f"{where}: tensor {key} has shape {tuple(tensors[key].shape)}, expected {tuple(value.shape)}: "
                "the config does not belong to these weights; train that stage again"
            )
        if not torch.isfinite(tensors[key]).all() and torch.isfinite(value).all():
            raise CheckpointError(
                f"{where}: tensor {key} holds values that are NaN or infinite, expected numbers: train that stage "
                "again, or download the weights again"
            )
    with torch.no_grad():
        for key, value in expected.items():
            value.copy_(tensors[key])


def weights_fingerprint(path: Path) -> str:
    """First 16 hex digits of the SHA-256 of a weights file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def cached(url: str) -> Path:
    """Where torch's cache keeps the file of an address, there or not."""
    return Path(torch.hub.get_dir()) / "checkpoints" / Path(url).name


def load_published(
    module: nn.Module,
    path: Path,
    key: str,
    network: str,
    cures: tuple[str, str],
    names: Mapping[str, str] | None = None,
    note: str = "",
) -> None:
    """Give a module the tensors of a `network` that others published: a `.safetensors` file, or a `.pth` as torchvision
    stores them, of which tensors are read only, nothing is run. `names` are the published ones of each of its own. A
    CheckpointError, with the config's `key`, where the file is missing or damaged (check the path, or the second cure),
    or a tensor is missing or of another shape (the first cure, or the second; `note` says more of the file).
    """
    import pickle

    from safetensors import SafetensorError
    from safetensors.torch import load

    other, cure = cures
    try:
        if path.suffix == ".safetensors":
            state = load(path.read_bytes())
        else:
            state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, SafetensorError, pickle.UnpicklingError) as error:
        said = (str(error).splitlines() or [type(error).__name__])[0]  # an empty file says nothing
        raise CheckpointError(
            f"{key}={path}: got {said}, expected a file of {network}'s weights: check the path, or {cure}"
        ) from error
    expected = module.state_dict()
    names = names or {name: name for name in expected}
    wrong = sorted(old for own, old in names.items() if old not in state or state[old].shape != expected[own].shape)
    if wrong:
        raise CheckpointError(
            f"{key}={path}{note}: got no tensor {wrong[0]} of its shape, expected another file: {other}, or {cure}"
        )
    module.load_state_dict({own: state[old] for own, old in names.items()})
