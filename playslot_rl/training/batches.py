"""The loss and the gradients of one global batch, whatever number of processes and micro-batches it is computed in.

    L = 1/n sum_i L_i,   n = processes x `optim.accumulate`

Each share of the rows is computed by itself (`playslot_rl.runtime.shares`); gradients and numbers of all processes are
averaged by one flat sum, between the backward pass and the clipping. With one share nothing is added to the plain loop.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import torch
from torch import Tensor, nn

from playslot_rl.config import StageConfig
from playslot_rl.errors import ConfigError
from playslot_rl.modules.quantizer import ActionQuantizer
from playslot_rl.runtime.processes import copied, here, summed
from playslot_rl.runtime.shares import Share, global_norms, sharing
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.training.stage import Stage, step_loss


class GlobalBatches:
    """One process's part in the batches of a stage, whose BatchNorm layers are made global where there are other
    processes, and whose weights are made equal; `key` is its dotted config group, for messages. A stage whose network
    normalises `by_batch` cannot accumulate.

    Raises:
        ConfigError: the shares do not divide the batch, or the stage cannot accumulate.
    """

    def __init__(self, stage: Stage, config: StageConfig, parameters: Mapping[str, nn.Parameter], key: str) -> None:
        self.stage, self.parameters, self.micros = stage, parameters, config.optim.accumulate
        self.count = here().world * self.micros
        if config.batch_size % self.count:
            raise ConfigError(
                f"{key}.batch_size: got {config.batch_size}, expected a multiple of {self.count} ({here().world} "
                f"processes, {key}.optim.accumulate={self.micros}), so that every share has equally many rows"
            )
        modules = [part for module in stage.modules.values() for part in module.modules()]
        self.by_batch = any(isinstance(part, nn.modules.batchnorm._BatchNorm) for part in modules)
        if self.micros > 1 and self.by_batch:
            raise ConfigError(
                f"{key}.optim.accumulate: got {self.micros}, expected 1: this network normalises by its whole batch "
                "(BatchNorm), which micro-batches do not have; start more processes instead"
            )
        self._quantizers = [part for part in modules if isinstance(part, ActionQuantizer)]

    def meet(self) -> None:
        """Begin together: every process has the first one's weights and buffers."""
        if here().world == 1:
            return
        for module in self.stage.modules.values():
            global_norms(module)
            copied([*module.parameters(), *module.buffers()])

    @property
    def shares(self) -> list[Share]:
        """Those that this process computes, one after the other."""
        first = here().rank * self.micros
        return [Share(first + micro, self.count, micro, self.micros) for micro in range(self.micros)]

    @property
    def begins(self) -> bool:
        """Whether codebooks start from the whole of the next batch, before its first micro-batch is quantised."""
        return self.micros > 1 and any(quantizer.starts_from_a_batch for quantizer in self._quantizers)

    def backward(self, step: int, generators: StepGenerators) -> dict[str, Tensor]:
        """Gradients of the global batch into the parameters; its loss and the other numbers of it.

        Raises:
            PeerError: another process ended.
        """
        if self.begins:
            with global_seed(generators.seed, step):
                self._rehearse(step, generators)
                return self.combined([self._share(step, generators, own) for own in self.shares])
        numbers = []
        for own in self.shares:  # each draws the global batch's noise anew, so that all slice the same
            with global_seed(generators.seed, step):
                numbers.append(self._share(step, generators, own))
        return self.combined(numbers)

    def gradients(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> dict[str, Tensor]:
        """Of a share's batch, within `sharing`, into the parameters' or added to them; its numbers."""
        losses = self.stage.loss(batch, step, generators)
        (losses["loss"] if self.micros == 1 else losses["loss"] / self.micros).backward()
        return {key: value.detach() for key, value in losses.items()}

    def combined(self, shares: Iterable[dict[str, Tensor]]) -> dict[str, Tensor]:
        """The numbers of the global batch, of those of the own shares, and its gradients in place of the own ones."""
        first, *others = shares
        means = first
        if others:
            means = {key: torch.stack([part[key].float() for part in (first, *others)]).mean() for key in first}
        return self._averaged(means) if here().world > 1 else means

    def _share(self, step: int, generators: StepGenerators, own: Share) -> dict[str, Tensor]:
        with sharing(own):
            return self.gradients(self.stage.batch(step, generators), step, generators)

    @torch.no_grad()
    def _rehearse(self, step: int, generators: StepGenerators) -> None:
        """Show the first global batch to codebooks that start from it, before its first micro-batch is quantised."""
        for own in self.shares:
            with sharing(replace(own, rehearsal=True)):
                step_loss(self.stage, step, generators)

    def _averaged(self, numbers: Mapping[str, Tensor]) -> dict[str, Tensor]:
        parameters = list(self.parameters.values())
        parts = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        scalars = torch.stack([value.to(parts[0].dtype) for value in numbers.values()])
        flat = torch.cat([*(part.flatten() for part in parts), scalars])
        flat = summed(flat) / here().world
        *grads, scalars = flat.split([*(part.numel() for part in parts), len(numbers)])
        for parameter, grad in zip(parameters, grads, strict=True):
            if parameter.grad is not None:
                parameter.grad.copy_(grad.view_as(parameter))
        return dict(zip(numbers, scalars.unbind(), strict=True))
