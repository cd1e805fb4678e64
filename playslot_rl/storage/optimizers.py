"""The state of optimisers as named tensors (never a pickle), whatever the optimiser.

Note: not by torch.distributed's `get_optimizer_state_dict`: where a parameter never had a gradient it steps with zeros
to make a state, which a resumed run would then have and an uninterrupted one would not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from playslot_rl.errors import CheckpointError


def optimizer_tensors(optimizer: torch.optim.Optimizer, names: Sequence[str] = ()) -> dict[str, Tensor]:
    """State as `PARAMETER/STATE` tensors, and `groupI/step` of groups that count their steps themselves.

    Parameters that never had a gradient have none.

    Args:
        optimizer: any that keeps tensors and numbers by parameter.
        names: of its parameters, in its order; empty takes their numbers.
    """
    stored = optimizer.state_dict()
    tensors = {
        f"{names[index] if names else index}/{key}": torch.as_tensor(value)
        for index, values in stored["state"].items()
        for key, value in values.items()
    }
    counted = {f"group{index}/step": group["step"] for index, group in enumerate(stored["param_groups"])
               if "step" in group}  # fmt: skip
    return tensors | {key: torch.tensor(value) for key, value in counted.items()}


def restore_optimizer(
    optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor], where: str, names: Sequence[str] = ()
) -> None:
    """Put `optimizer_tensors` back; settings such as the learning rate stay those of `optimizer`.

    Raises:
        CheckpointError: a tensor is unexpected, missing, or of another shape.
    """
    groups = optimizer.state_dict()["param_groups"]
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    index = {name: i for i, name in enumerate(names or map(str, range(len(parameters))))}
    state: dict[int, dict[str, Tensor]] = {}
    counters = {f"group{i}/step": group for i, group in enumerate(groups) if "step" in group}
    for key, value in tensors.items():
        owner, _, what = key.rpartition("/")
        if key in counters:
            counters[key]["step"] = int(value)
            continue
        if owner not in index:
            raise CheckpointError(f"{where} holds the unexpected tensor {key}: use another out= or delete it")
        shape = () if what == "step" else tuple(parameters[index[owner]].shape)
        if tuple(value.shape) != shape:
            raise CheckpointError(
                f"{where}: {key} has shape {tuple(value.shape)}, expected {shape}: delete that folder"
            )
        state.setdefault(index[owner], {})[what] = value
    expected = sorted({what for values in state.values() for what in values})
    for owner, i in index.items():
        if i in state and len(state[i]) < len(expected):
            raise CheckpointError(f"{where} misses a tensor of {owner}, expected {', '.join(expected)}: delete it")
    optimizer.load_state_dict({"state": state, "param_groups": groups})
