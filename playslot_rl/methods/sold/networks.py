"""SOLD's trained networks (Mosbach et al., 2025, section 3.3): the dynamics, and reward, value and actor, each a
slot-aggregation transformer and a head with one hidden layer. SAVi, which is frozen, is not among them.

    head(y) = W SiLU(RMSNorm(V y))

Shapes: B sequences, S steps, slots (B, S, N, D), A action width, K bins.

Scalars are categories on a symlog grid (Hafner et al., 2023), b_k evenly spaced in [-limit, limit]:

    target: two-hot(symlog(x)),   p = softmax(l),   decoded, symlog: x^ = symexp(sum_k p_k b_k)
                                                    decoded, linear: x^ = sum_k p_k symexp(b_k)

The source averages in symlog, on a grid of +-20. The linear mean (DreamerV3's later one, TorchRL's `SymExpTwoHot`) is
unbiased, but the actor is trained through decoded rewards and values, and there the gradient of a bin of 4.9e8 drowns
all others: it wants a grid that ends where returns do. The symlog mean is too low where the head is uncertain (between
10 and 200 it says 46, not 105).

The action is normal, its mean in +-0.76:  a ~ N(tanh(clamp(mu, -1, 1)), s),  s = 0.1 + 0.9 sigmoid(sigma + 2)

Imagination takes it as it is drawn; what is executed and stored is clamped to [-1, 1].

Note: the last layers start at zero (scalars) or near it (actor), as DreamerV3's; the source's are torch's default. Else
an untrained head promises what its grid holds.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torchrl.modules import symexp, symlog
from torchrl.objectives import two_hot_cross_entropy, two_hot_decode

from playslot_rl.config import PredictorConfig
from playslot_rl.errors import ConfigError
from playslot_rl.methods.sold.aggregation import SlotAggregation
from playslot_rl.methods.sold.method import SOLDConfig
from playslot_rl.modules.predictors.ocvp_seq import OCVPSeq
from playslot_rl.modules.transformer import KeysValues
from playslot_rl.storage.checkpoints import StageCheckpoint

MIN_STD, MAX_STD = 0.1, 1.0
"""Range of the actor's standard deviation (DreamerV3's)."""
INITIAL_STD_LOGIT = 2.0
"""Added to the logit of the deviation: an untrained actor starts near MAX_STD and explores."""


class _Head(nn.Module):
    """The summary of every step, and what follows from it."""

    def __init__(self, config: SOLDConfig, slot_dim: int, outputs: int) -> None:
        super().__init__()
        self.backbone = SlotAggregation(slot_dim, config.dim, config.head_layers, config.heads, config.mlp_dim)
        self.hidden = nn.Sequential(
            nn.Linear(config.dim, config.mlp_dim), nn.RMSNorm(config.mlp_dim, eps=1e-6), nn.SiLU()
        )
        self.out = nn.Linear(config.mlp_dim, outputs)


class ScalarHead(_Head):
    """Reward or value of every step, as logits over a symlog grid; what lies beyond its ends is encoded as the end."""

    grid: Tensor

    def __init__(self, config: SOLDConfig, slot_dim: int) -> None:
        super().__init__(config, slot_dim, config.bins)
        self.mean = config.mean
        self.register_buffer("grid", torch.linspace(-config.limit, config.limit, config.bins), persistent=False)
        # Zero logits decode to zero: an untrained head promises nothing (DreamerV3).
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, slots: Tensor) -> Tensor:
        """Logits (B, S, bins)."""
        logits: Tensor = self.out(self.hidden(self.backbone(slots)[0]))
        return logits

    def decode(self, logits: Tensor) -> Tensor:
        """Logits (..., bins) to values (...)."""
        values: Tensor = (
            two_hot_decode(logits, symexp(self.grid))
            if self.mean == "linear"
            else symexp(two_hot_decode(logits, self.grid))
        )
        return values

    def cross_entropy(self, logits: Tensor, values: Tensor) -> Tensor:
        """Logits (..., bins) and targets (...) to the loss (...); no gradient runs into the targets."""
        loss: Tensor = two_hot_cross_entropy(logits, symlog(values.detach()), self.grid)
        return loss


class ActorHead(_Head):
    """Distribution of the action of every step, which follows from all steps so far."""

    def __init__(self, config: SOLDConfig, slot_dim: int, action_dim: int) -> None:
        super().__init__(config, slot_dim, 2 * action_dim)
        # Near zero: the first actions are centred whatever the slots are.
        nn.init.uniform_(self.out.weight, -1e-2, 1e-2)
        nn.init.zeros_(self.out.bias)

    def forward(self, slots: Tensor, past: list[KeysValues] | None = None) -> tuple[Tensor, Tensor, list[KeysValues]]:
        """Mean and standard deviation (B, S, A) in [MIN_STD, MAX_STD], and the past of the next call."""
        summary, past = self.backbone(slots, past)
        return *self._moments(summary), past

    def step(self, slots: Tensor, kept: Tensor, age: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean and deviation (B, A) at one frame more, (B, N, D), and what is kept (`SlotAggregation.step`)."""
        summary, kept = self.backbone.step(slots, kept, age)
        return *self._moments(summary), kept

    def _moments(self, summary: Tensor) -> tuple[Tensor, Tensor]:
        mean, spread = self.out(self.hidden(summary)).chunk(2, dim=-1)
        std = MIN_STD + (MAX_STD - MIN_STD) * torch.sigmoid(spread + INITIAL_STD_LOGIT)
        return torch.tanh(mean.clamp(-1, 1)), std


def sample_action(mean: Tensor, std: Tensor, generator: torch.Generator | None) -> Tensor:
    """Reparameterised sample (..., A), not clamped."""
    noise = torch.randn(mean.shape, generator=generator, device=mean.device, dtype=mean.dtype)
    return mean + std * noise


class SOLDNetworks(nn.Module):
    """Dynamics, reward, critic and actor; `frames` are those of the longest sequence the dynamics learn from."""

    def __init__(self, config: SOLDConfig, slot_dim: int, action_dim: int, frames: int) -> None:
        super().__init__()
        c = config
        sizes = PredictorConfig(
            kind="ocvp_seq",
            dim=c.dim,
            layers=c.dynamics_layers,
            heads=c.heads,
            head_dim=c.dim // c.heads,
            mlp_dim=c.mlp_dim,
            residual=True,
            context=max(frames, c.context + c.horizon),
        )
        self.dynamics = OCVPSeq(sizes, slot_dim, action_dim)
        self.reward = ScalarHead(c, slot_dim)
        self.critic = ScalarHead(c, slot_dim)
        self.actor = ActorHead(c, slot_dim, action_dim)

    @property
    def parts(self) -> Mapping[str, nn.Module]:
        return {"dynamics": self.dynamics, "reward": self.reward, "critic": self.critic, "actor": self.actor}


def build_networks(config: SOLDConfig, slots: StageCheckpoint, action_dim: int, max_steps: int) -> SOLDNetworks:
    """Fresh networks for the slots of a finished SAVi; a `sequence` of 0 takes an episode of `max_steps` whole."""
    slot_dim = slots.sizes[0].savi.slot_dim
    return SOLDNetworks(config, slot_dim, action_dim, config.sequence or max_steps + 1)


def prior_steps(config: SOLDConfig, slots: StageCheckpoint) -> int:
    """Agent steps of the data that SAVi was trained on, which count as SOLD's own.

    `savi_steps` of the config if given; else what the checkpoint says. One written before it said so names its episodes
    only: their number times `env.max_steps`, as `playslot pipeline` records. A ConfigError where it says neither.
    """
    if config.savi_steps is not None:
        return config.savi_steps
    steps, episodes = slots.meta.get("agent_steps"), slots.meta.get("episodes")
    if steps is not None:
        return int(steps)
    if episodes is None:
        raise ConfigError(
            f"baselines.sold.savi_steps: got nothing, and {slots.path}/meta.json names neither agent_steps nor "
            "episodes: say how many agent steps SAVi's data hold"
        )
    return int(episodes) * slots.sizes[1].max_steps
