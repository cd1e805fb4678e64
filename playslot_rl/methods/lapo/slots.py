"""LAPO's inverse and forward model on the slots of a frozen SAVi (after Klepach et al., 2025, "Object-Centric
Latent Action Learning"), and what acts in their latent actions.

    z_t = VQ(IDM(S_{t-1}, S_t, S_{t+1})),   S^_{t+1} = S_t + FDM(S_{t-1}, S_t, z_t)

Is it the slots, or PlaySlot's latents? The rest is as there: slots, policy, decoder, fine-tuning; but these latents are
not whitened, with which they do worse, and the policy sees no imagined slots (`behaviour.imagined`).

Note: a slot keeps its number over time, so that it is one token, its vectors in all frames beside each other. No
position code: z_t does not depend on the order of the slots, and the prediction follows it.

Shapes: B batch, F frames, N slots, D slot width, Z latent-action width.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor, nn

from playslot_rl.acting.actor import Actor, SlotActor
from playslot_rl.config import PolicyConfig
from playslot_rl.methods.decoded_policy import DecodedPolicy
from playslot_rl.methods.lapo.method import LatentConfig
from playslot_rl.methods.lapo.model import QuantisedInverse
from playslot_rl.methods.lapo.slots_method import MODEL, NAME, LAPOSlotsConfig
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.modules.transformer import SlotTokenEncoder, TransformerBlock
from playslot_rl.runs import Run
from playslot_rl.world_model import action_decoder_module, latent_policy_module


def over_time(slots: Tensor) -> Tensor:
    """Slots (B, F, N, D) to one token a slot (B, N, F D)."""
    return slots.transpose(1, 2).flatten(2)


class SlotSummary(nn.Module):
    """Slots (B, F, N, D) to (B, Z), by the policy's transformer."""

    def __init__(self, config: LatentConfig, sizes: PolicyConfig, slot_dim: int) -> None:
        super().__init__()
        width, of = config.frames * slot_dim, (sizes.dim, sizes.layers, sizes.heads, sizes.head_dim, sizes.mlp_dim)
        self.encoder = SlotTokenEncoder(width, *of)
        self.out = nn.Linear(sizes.dim, config.latent_dim)

    def forward(self, slots: Tensor) -> Tensor:
        out: Tensor = self.out(self.encoder(over_time(slots)))
        return out


class SlotInverse(QuantisedInverse):
    """IDM on slots (B, F, N, D)."""

    def __init__(self, config: LatentConfig, sizes: PolicyConfig, slot_dim: int) -> None:
        super().__init__(config, SlotSummary(config, sizes, slot_dim))


class SlotForward(nn.Module):
    """FDM on slots: transformer blocks; the latent enters at their input and at their middle."""

    def __init__(self, config: LatentConfig, sizes: PolicyConfig, slot_dim: int) -> None:
        super().__init__()
        width, of = (config.frames - 1) * slot_dim, (sizes.dim, sizes.heads, sizes.head_dim, sizes.mlp_dim)
        self.to_token = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, sizes.dim))
        self.to_input = nn.Linear(config.latent_dim, sizes.dim)
        self.to_middle = nn.Linear(config.latent_dim, sizes.dim)
        self.blocks = nn.ModuleList(TransformerBlock(*of) for _ in range(sizes.layers))
        self.out = nn.Linear(sizes.dim, slot_dim)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, past: Tensor, z: Tensor) -> Tensor:
        """Slots (B, F - 1, N, D) and latents (B, Z) to the next slots (B, N, D)."""
        x = self.to_token(over_time(past)) + self.to_input(z)[:, None]
        for number, block in enumerate(self.blocks):
            if number == len(self.blocks) // 2:
                x = x + self.to_middle(z)[:, None]
            x, _ = block(x)
        predicted: Tensor = past[:, -1] + self.out(x)
        return predicted


def load_actor(run: Run, device: torch.device | str = "cpu") -> Actor:
    """The actor of a finished run; a CheckpointError where a stage is missing, damaged, or of another parent."""
    done, savi = run.stage(NAME, "slots", MODEL.name), run.load_savi(device)
    own, width = done.group(LAPOSlotsConfig, NAME), savi.config.slot_dim
    model, env = done.sizes
    build = partial(LatentPolicy, model.policy, width, own.latent_dim, tasks=len(env.tasks))
    parts = DecodedPolicy.load(done, build, own.latent_dim, width, device)
    heads = latent_policy_module(parts.policy), action_decoder_module(parts.action_decoder)
    return SlotActor(savi, *heads, policy=parts.policy)
