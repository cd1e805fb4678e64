"""`compile`: parts of a stage's networks as kernels made by torch.compile."""

from __future__ import annotations

import functools
import importlib.util
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping
from typing import Any, Final

import torch
from torch import nn

from playslot_rl.errors import ConfigError, first_line

COMPILERS = ("g++", "gcc", "clang++", "clang")
LEAST_STEPS: Final = 2000
"""Steps that have to be left for what compiling takes, 10 to 60 seconds."""
COMPACT: Final = False
"""Whether SAVi with a strided encoder (`preset=compact`) is compiled unasked, too."""


def compiling_pays(device: torch.device, steps: int) -> bool:
    """Whether a training with so many steps left is to compile what is `worth_compiling` unasked."""
    able = has_compiler() and importlib.util.find_spec("triton") is not None
    return device.type == "cuda" and steps >= LEAST_STEPS and able and _compiles(device)


@functools.cache
def _compiles(device: torch.device) -> bool:
    """Whether a small function can be compiled there: a compiler may lack Python's headers, a GPU be too old."""
    try:
        torch.compile(lambda x: x.square().sum())(torch.ones(64, device=device))
    except Exception as error:  # noqa: BLE001  # whatever it is, nobody has asked for it
        said = first_line(error)
        warnings.warn(f"torch.compile does not work here, trained without: {said}", RuntimeWarning, stacklevel=3)
        return False
    return True


def worth_compiling(modules: Mapping[str, nn.Module]) -> dict[str, nn.Module]:
    """The networks that name methods for it, and are large."""

    def large(module: nn.Module) -> bool:
        return COMPACT or getattr(getattr(module, "config", None), "encoder", "full") == "full"

    return {name: module for name, module in modules.items() if hasattr(module, "compiled") and large(module)}


def has_compiler() -> bool:
    """Whether there is one for C++."""
    return bool(os.environ.get("CXX")) or any(map(shutil.which, COMPILERS))


def require_compiler(key: str) -> None:
    """Refuse a setting that compiles, by a ConfigError, where there is no C++ compiler."""
    if not has_compiler():
        raise ConfigError(
            f"{key}=true: got no C++ compiler, expected g++ or clang++ on the PATH: install one (Debian, Ubuntu: "
            f"apt-get install g++), or leave {key} out"
        )


def compile_parts(modules: Mapping[str, nn.Module], key: str) -> None:
    """Compile what the networks call step by step, in place; names stay: the methods that a network names in `compiled`
    (SAVi's encoder with keys and values, and its decoder), else its parts.

    Whole networks draw random numbers from generators, which torch.compile cannot trace; their parts do not. A
    ConfigError with the dotted name of the setting, `key`, where there is no C++ compiler.
    """
    require_compiler(key)
    for module, name in _parts(modules):
        setattr(module, name, torch.compile(getattr(module, name), dynamic=False if name != "forward" else None))


def release_parts(modules: Mapping[str, nn.Module]) -> None:
    """Have the networks run as they were written again."""
    for module, name in _parts(modules):
        vars(module).pop(name, None)


def _parts(modules: Mapping[str, nn.Module]) -> Iterator[tuple[nn.Module, str]]:
    for module in modules.values():
        named: Any = getattr(module, "compiled", None)
        if named is not None:
            yield from ((module, name) for name in named)
            continue
        for part in _called(module):
            if any(parameter.requires_grad for parameter in part.parameters()):
                yield part, "forward"


def _called(module: nn.Module) -> Iterator[nn.Module]:
    """The parts that are called as they are: lists and dictionaries of parts never are."""
    for part in module.children():
        if isinstance(part, nn.ModuleList | nn.ModuleDict):
            yield from _called(part)
        else:
            yield part
