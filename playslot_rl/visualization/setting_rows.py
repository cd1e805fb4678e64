"""Rows of settings that both kinds of report have."""

from __future__ import annotations

from playslot_rl.evaluation.success import hardware
from playslot_rl.world_model import WorldModel

Row = list[str]


def model_rows(model: WorldModel | None) -> list[Row]:
    """Slots, latent actions and prototypes of a world model; nothing without one."""
    if model is None:
        return []
    savi, inverse = model.config.savi, model.config.inverse_dynamics
    return [
        ["slots", f"{savi.n_slots} of width {savi.slot_dim}"],
        ["latent actions", f"{inverse.mode}, {inverse.variant}, width {model.latent_shape[-1]}"],
        ["prototypes", str(model.inverse_dynamics.n_prototypes)],
    ]


def machine_row() -> Row:
    """The machine that makes the report."""
    machine = hardware()
    gpu = f", {machine['gpu']}" if machine["gpu"] else ""
    return ["report made on", f"{machine['machine']}, {machine['cores']} cores{gpu}, torch {machine['torch']}"]
