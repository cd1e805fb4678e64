"""Randomness as a pure function of (seed, step, stream): a resumed run needs no stored RNG state."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch


def derived_seed(seed: int, step: int, stream: str) -> int:
    """A 63-bit seed from (seed, step, stream); different streams are independent."""
    digest = hashlib.blake2b(f"{seed}/{step}/{stream}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def step_generator(seed: int, step: int, stream: str, device: torch.device | str = "cpu") -> torch.Generator:
    """Torch generator of one step and stream.

    Example:
        >>> a = torch.rand(3, generator=step_generator(0, 7, "noise"))
        >>> b = torch.rand(3, generator=step_generator(0, 7, "noise"))
        >>> torch.equal(a, b)
        True
    """
    return torch.Generator(device=device).manual_seed(derived_seed(seed, step, stream))


class StepRandom(np.random.Generator):
    """A NumPy generator that says which step it was made for: a shuffle buffer moves on with the steps."""

    step = 0


@dataclass(frozen=True)
class StepGenerators:
    """What the fit loop hands to a stage: generators of one step, made on demand by the name of their stream."""

    seed: int
    step: int
    device: torch.device | str = "cpu"

    def torch(self, stream: str, device: torch.device | str | None = None) -> torch.Generator:
        """Torch generator of a stream, on the run's device unless another is named."""
        return step_generator(self.seed, self.step, stream, self.device if device is None else device)

    def numpy(self, stream: str) -> np.random.Generator:
        """NumPy generator of a stream, `np.random.default_rng`'s, that knows its step."""
        generator = StepRandom(np.random.PCG64(derived_seed(self.seed, self.step, stream)))
        generator.step = self.step
        return generator


@contextlib.contextmanager
def global_seed(seed: int, step: int, stream: str = "global") -> Iterator[None]:
    """Seed torch's global generators inside the block, and put their states back after it.

    For what takes no generator, such as k-means and the revival of dead codes.
    """
    devices = list(range(torch.cuda.device_count())) if torch.cuda.is_initialized() else []
    with torch.random.fork_rng(devices=devices):
        value = derived_seed(seed, step, stream)
        torch.default_generator.manual_seed(value)
        if devices:
            torch.cuda.manual_seed_all(value)
        yield
