"""SOLD's trained networks (Mosbach et al., 2025, section 3.3): the dynamics, and reward, value and actor, each a
slot-aggregation transformer and a linear layer. SAVi, which is frozen, is not among them. And the policy at work.

    y_t = Transformer([S_1, o_1], ..., [S_t, o_t])[o_t],   logits(q, k) = q k / sqrt(d) - m_h (step(q) - step(k))

Shapes: n episodes, W frames of memory, slots (B, S, N, D) -> (B, S, dim), A action width. M = N + 1 tokens a step, the
last of them the output token o
(one learned vector). A token sees all tokens of its own and of earlier steps. Position is in the ALiBi bias alone
(Press et al., 2022), which is equal for all slots of a step: the result does not depend on their order, and sequences
may grow longer than in training. All take the past that they returned for the earlier steps, so a step of imagination
costs one step.

Scalars are categories on a symlog grid (Hafner et al., 2023):

    target: two-hot(symlog(x)),   p = softmax(l),   b_k evenly spaced in [-limit, limit]
    decoded, linear: x^ = sum_k p_k symexp(b_k)      decoded, symlog: x^ = symexp(sum_k p_k b_k)

Note: the linear mean is the source's and unbiased. On its grid of +-20, values of up to 4.9e8, TorchRL's
`SymExpTwoHot` is the same. But SOLD's actor is trained through decoded rewards and values, where the gradient of a bin
of 4.9e8 drowns all others. So either the grid ends where returns do, or the mean is taken in symlog, which stays of
the size of the value and is too low where the head is uncertain (between 10 and 200 it says 46, not 105).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.modules import TruncatedNormal, symexp, symlog
from torchrl.objectives import two_hot_cross_entropy, two_hot_decode

from playslot_rl import keys
from playslot_rl.acting.actor import Actor
from playslot_rl.config import EnvConfig, PredictorConfig
from playslot_rl.errors import ConfigError
from playslot_rl.methods.sold.method import NAME, SOLDConfig
from playslot_rl.modules.predictors.ocvp_seq import OCVPSeq
from playslot_rl.modules.savi import SAVi
from playslot_rl.modules.transformer import KeysValues, TransformerBlock
from playslot_rl.runs import Run
from playslot_rl.storage.checkpoints import StageCheckpoint
from playslot_rl.world_model import frame_parser_module, module_device


def alibi_slopes(heads: int) -> Tensor:
    """Slopes m_h (heads,) of Press et al., 2022: the geometric sequence 2^(-8/heads), 2^(-16/heads), ..., 2^-8."""
    return torch.tensor([2.0 ** (-8.0 * (head + 1) / heads) for head in range(heads)])


def alibi_bias(slopes: Tensor, new: int, past: int, tokens: int) -> Tensor:
    """Bias of the attention logits, causal over steps, of queries of `new` steps after `past` ones.

    Returns:
        (heads, new * M, (past + new) * M): -m_h times the steps between, minus infinity for later steps.
    """
    query = torch.arange(past, past + new, device=slopes.device).repeat_interleave(tokens)
    key = torch.arange(past + new, device=slopes.device).repeat_interleave(tokens)
    distance = query[:, None] - key[None, :]
    bias = -slopes[:, None, None] * distance
    return bias.masked_fill(distance < 0, float("-inf"))


class SlotAggregation(nn.Module):
    """Summarise the slots of all steps so far, at every step; a ValueError where `dim` is no multiple of `heads`.

    Example:
        >>> import torch
        >>> model = SlotAggregation(slot_dim=16, dim=32, layers=1, heads=4, mlp_dim=64)
        >>> model(torch.randn(2, 7, 5, 16))[0].shape
        torch.Size([2, 7, 32])
    """

    slopes: Tensor

    def __init__(self, slot_dim: int, dim: int, layers: int, heads: int, mlp_dim: int) -> None:
        super().__init__()
        if dim % heads:
            raise ValueError(f"heads: got {heads}, expected a divisor of dim {dim}")
        self.embed = nn.Linear(slot_dim, dim)
        self.output_token = nn.Parameter(torch.randn(dim) * 0.02)
        self.blocks = nn.ModuleList(TransformerBlock(dim, heads, dim // heads, mlp_dim) for _ in range(layers))
        self.norm = nn.LayerNorm(dim)
        self.register_buffer("slopes", alibi_slopes(heads), persistent=False)

    def forward(self, slots: Tensor, past: list[KeysValues] | None = None) -> tuple[Tensor, list[KeysValues]]:
        """Summaries (B, S, dim) of S new steps' slots (B, S, N, D), and the past for the next call."""
        b, s, n = slots.shape[:3]
        first = 0 if past is None else past[0][0].shape[2] // (n + 1)
        output = self.output_token.expand(b, s, 1, -1)
        x = torch.cat((self.embed(slots), output), dim=2).flatten(1, 2)
        bias = alibi_bias(self.slopes, s, first, n + 1).to(x.dtype)
        kept: list[KeysValues] = []
        last = len(self.blocks) - 1
        for i, block in enumerate(self.blocks):
            # Only the output tokens of the last layer are read.
            wanted = slice(n, None, n + 1) if i == last else slice(None)
            x, keys_values = block(x, bias, None if past is None else past[i], wanted)
            kept.append(keys_values)
        return self.norm(x), kept


MIN_STD, MAX_STD = 0.1, 1.0
"""Range of the actor's standard deviation (DreamerV3's)."""
INITIAL_STD_LOGIT = 2.0
"""Added to the logit of the deviation: an untrained actor starts near MAX_STD and explores."""


def _backbone(config: SOLDConfig, slot_dim: int) -> SlotAggregation:
    return SlotAggregation(slot_dim, config.dim, config.head_layers, config.heads, config.mlp_dim)


class ScalarHead(nn.Module):
    """Reward or value of every step, as logits over a symlog grid; what lies beyond its ends is encoded as the end."""

    grid: Tensor

    def __init__(self, config: SOLDConfig, slot_dim: int) -> None:
        super().__init__()
        self.backbone, self.mean = _backbone(config, slot_dim), config.mean
        self.register_buffer("grid", torch.linspace(-config.limit, config.limit, config.bins), persistent=False)
        self.out = nn.Linear(config.dim, config.bins)
        # Zero logits decode to zero: an untrained head promises nothing (DreamerV3).
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, slots: Tensor) -> Tensor:
        """Logits (B, S, bins)."""
        logits: Tensor = self.out(self.backbone(slots)[0])
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


class ActorHead(nn.Module):
    """Distribution of the action of every step."""

    def __init__(self, config: SOLDConfig, slot_dim: int, action_dim: int) -> None:
        super().__init__()
        self.backbone = _backbone(config, slot_dim)
        self.out = nn.Linear(config.dim, 2 * action_dim)
        # Near zero: the first actions are centred whatever the slots are.
        nn.init.uniform_(self.out.weight, -1e-2, 1e-2)
        nn.init.zeros_(self.out.bias)

    def forward(self, slots: Tensor, past: list[KeysValues] | None = None) -> tuple[Tensor, Tensor, list[KeysValues]]:
        """Location (B, S, A) in [-1, 1], standard deviation (B, S, A) in [MIN_STD, MAX_STD], and the next past."""
        summary, past = self.backbone(slots, past)
        location, spread = self.out(summary).chunk(2, dim=-1)
        std = MIN_STD + (MAX_STD - MIN_STD) * torch.sigmoid(spread + INITIAL_STD_LOGIT)
        return torch.tanh(location), std, past


def sample_action(distribution: TruncatedNormal, generator: torch.Generator | None) -> Tensor:
    """Reparameterised sample (..., A) in [-1, 1] by the inverse distribution function of a uniform draw.

    TorchRL's own `rsample` takes no generator.
    """
    base = distribution.base_dist
    uniform = torch.rand(base.loc.shape, generator=generator, device=base.loc.device, dtype=base.loc.dtype)
    action: Tensor = base.icdf(uniform)
    return action


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


class SOLDActor(Actor):
    """SOLD: one step of acting, by the most likely action.

    Reads PIXELS (n, 3, H, W) uint8, SLOT_STATE, SLOT_AGE, SLOT_HISTORY (n, W, N, D), right-aligned, and
    HISTORY_LENGTH (n, 1); writes these anew but for the frame, SLOTS (n, N, D) and ACTION (n, A) in [-1, 1].

    Note: the window W is C, in imagination as here: each decision follows the last 1 to C frames, there predicted ones
    too. ALiBi lets it slide.
    """

    def __init__(self, savi: SAVi, actor: ActorHead, window: int, action_dim: int) -> None:
        super().__init__((keys.SLOT_STATE, keys.SLOT_AGE, keys.SLOT_HISTORY, keys.HISTORY_LENGTH, keys.ACTION))
        self.savi, self.actor, self.window, self.action_dim = savi, actor, window, action_dim

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        return self.initial(len(seeds))

    def initial(self, n: int) -> TensorDict:
        """The memory of n new episodes, batch size [n]."""
        device, shape = module_device(self.actor), (self.savi.config.n_slots, self.savi.config.slot_dim)
        return TensorDict(
            {
                keys.SLOT_STATE: torch.zeros(n, *shape, device=device),
                keys.SLOT_AGE: torch.zeros(n, 1, dtype=torch.long, device=device),
                keys.SLOT_HISTORY: torch.zeros(n, self.window, *shape, device=device),
                keys.HISTORY_LENGTH: torch.zeros(n, 1, dtype=torch.long, device=device),
                keys.ACTION: torch.zeros(n, self.action_dim, device=device),
            },
            batch_size=[n],
            device=device,
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The most likely action; sampled initial slots are the same in every episode."""
        return self.act(tensordict, torch.Generator(module_device(self.actor)).manual_seed(0), explore=False)

    def act(self, memory: TensorDictBase, generator: torch.Generator, explore: bool) -> TensorDictBase:
        """Parse, remember, choose; `explore` samples the action."""
        out = frame_parser_module(self.savi, generator)(memory.copy())
        history = torch.cat((memory[keys.SLOT_HISTORY][:, 1:], out[keys.SLOTS].unsqueeze(1)), dim=1)
        length = (memory[keys.HISTORY_LENGTH] + 1).clamp(max=self.window)
        location, std = self._last(history, length.squeeze(-1))
        action = sample_action(TruncatedNormal(location, std), generator) if explore else location
        return out.update({keys.SLOT_HISTORY: history, keys.HISTORY_LENGTH: length, keys.ACTION: action})

    def _last(self, history: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        """Location and deviation (n, A) at the newest frame of right-aligned histories.

        They are moved to the left: the actor is causal, so what pads the right end is never looked at.
        """
        window = int(length.max())
        steps = torch.arange(window, device=history.device)
        source = (steps + self.window - length[:, None]).clamp(max=self.window - 1)
        rows = torch.arange(len(history), device=history.device)
        location, std, _ = self.actor(history[rows[:, None], source])
        return location[rows, length - 1], std[rows, length - 1]


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


def load_actor(run: Run, device: torch.device | str = "cpu") -> SOLDActor:
    """SOLD's policy, in evaluation mode; a CheckpointError where a stage is missing, damaged, or of another SAVi."""
    done, slots = run.stage(NAME, "slots"), run.stage("slots")
    own, env = done.group(SOLDConfig, NAME), done.group(EnvConfig, "env")
    networks = done.restore(
        lambda: build_networks(own, slots, env.action_dim, env.max_steps),
        ("dynamics", "reward", "critic", "actor"),
        device,
    )
    actor = SOLDActor(run.load_savi(device), networks.actor, own.context, env.action_dim)
    actor.eval()
    return actor
