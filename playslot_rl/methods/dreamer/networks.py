"""DreamerV3's networks (Hafner et al. 2023, Fig. "training process"), TorchRL's parts put together.

    h_t = f(h_{t-1}, z_{t-1}, a_{t-1})    sequence model (block GRU)
    z_t ~ q(z_t | h_t, o_t)               posterior;   z^_t ~ p(z^_t | h_t)   prior
    o^_t = d(h_t, z_t)                    decoder
    r^_t, v_t, a_t from (h_t, z_t)        reward head, critic, actor

Shapes: n rows, S = categoricals x classes (z), H belief (h), A action dim, E embedding, F frame side.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.modules import (
    DreamerV3ImageDecoder,
    DreamerV3ImageEncoder,
    DreamerV3MLP,
    IndependentNormal,
    RSSMPosteriorV3,
    RSSMPriorV3,
    SymExpTwoHot,
)

from playslot_rl import keys
from playslot_rl.acting.actor import Actor
from playslot_rl.config import EnvConfig
from playslot_rl.errors import ConfigError
from playslot_rl.frames import quantise
from playslot_rl.methods.dreamer.method import NAME, DreamerConfig
from playslot_rl.runs import Run

UNIMIX = 0.01
"""Uniform share of every categorical, so that none becomes certain."""
BINS = 255
MIN_STD, MAX_STD = 0.1, 1.0


class ActorNetwork(nn.Module):
    """(z, h) to mean and standard deviation of a Gaussian action: tanh mean, deviation in [0.1, 1]."""

    def __init__(self, features: int, action_dim: int, config: DreamerConfig) -> None:
        super().__init__()
        self.mlp = DreamerV3MLP(features, 2 * action_dim, config.layers, config.units, outscale=0.01)

    def forward(self, state: Tensor, belief: Tensor) -> tuple[Tensor, Tensor]:
        """(..., S), (..., H) to mean and deviation, (..., A) each."""
        mean, spread = self.mlp(state, belief).chunk(2, -1)
        return mean.tanh(), (MAX_STD - MIN_STD) * torch.sigmoid(spread + 2.0) + MIN_STD


class TwoHotHead(nn.Module):
    """(z, h) to the logits of a scalar and the scalar they mean; zero at the start."""

    def __init__(self, features: int, layers: int, units: int) -> None:
        super().__init__()
        self.mlp = DreamerV3MLP(features, BINS, layers, units, outscale=0.0)
        self.two_hot = SymExpTwoHot(BINS)

    def forward(self, state: Tensor, belief: Tensor) -> tuple[Tensor, Tensor]:
        """(..., S), (..., H) to logits (..., 255) and scalar (..., 1)."""
        logits = self.mlp(state, belief)
        return logits, self.two_hot(logits)


class DreamerNetworks(nn.Module):
    """All networks; a ConfigError where the frame size does not divide, or does not fit the encoder's stages."""

    def __init__(self, config: DreamerConfig, env: EnvConfig) -> None:
        super().__init__()
        self.frame_size = config.frame_size or env.image_size
        stride = 2 ** len(config.mults)
        if env.image_size % self.frame_size or self.frame_size % stride:
            raise ConfigError(
                f"baselines.dreamer.frame_size: got {self.frame_size}, expected a divisor of env.image_size "
                f"({env.image_size}) and a multiple of {stride}, for {len(config.mults)} stages: change one of them"
            )
        self.state_dim, self.belief_dim = config.categoricals * config.classes, config.belief
        self.action_dim, features = env.action_dim, config.categoricals * config.classes + config.belief
        sizes = {"num_categoricals": config.categoricals, "num_classes": config.classes, "unimix": UNIMIX}
        frame = (3, self.frame_size, self.frame_size)
        self.encoder = DreamerV3ImageEncoder(3, config.depth, config.mults, config.kernel)
        self.prior = RSSMPriorV3(
            hidden_dim=config.hidden,
            rnn_hidden_dim=config.belief,
            action_dim=env.action_dim,
            action_shape=(env.action_dim,),
            recurrent_model="block_gru",
            num_blocks=config.blocks,
            **sizes,
        )
        self.posterior = RSSMPosteriorV3(
            hidden_dim=config.hidden,
            rnn_hidden_dim=config.belief,
            obs_embed_dim=self.encoder.output_features(frame),
            use_rms_norm=True,
            **sizes,
        )
        self.decoder = DreamerV3ImageDecoder(
            features, frame, config.depth, config.mults, config.kernel, num_blocks=config.blocks
        )
        self.reward = TwoHotHead(features, 1, config.units)
        self.actor = ActorNetwork(features, env.action_dim, config)
        self.value = TwoHotHead(features, config.layers, config.units)

    def reduce(self, pixels: Tensor) -> Tensor:
        """Frames (n, 3, H, W), uint8 or floats in [0, 1], averaged to uint8 (n, 3, F, F)."""
        frames, factor = quantise(pixels), pixels.shape[-1] // self.frame_size
        return frames if factor == 1 else F.avg_pool2d(frames.float(), factor).round().to(torch.uint8)

    def blank(self, n: int) -> TensorDict:
        """State and last action of n new episodes: zero, which is how every sequence of the replay starts too."""
        zeros = {"state": self.state_dim, "belief": self.belief_dim, keys.ACTION: self.action_dim}
        return TensorDict({key: torch.zeros(n, width) for key, width in zeros.items()}, [n])

    def filter(
        self, state: Tensor, belief: Tensor, action: Tensor, frames: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """The posterior state z_t, h_t after a frame o_t, uint8 (n, 3, F, F), from z_{t-1}, h_{t-1} and a_{t-1}.

        Note: TorchRL's modules draw z^ and z from the global generator; here z alone is drawn, from `generator`, or is
        the most likely one where that is None.
        """
        belief, posterior = self.prior.rnn(state, belief, action), self.posterior
        flat = posterior.obs_rnn_to_post_projector(torch.cat([belief, self.encoder(frames)], -1))
        logits = flat.unflatten(-1, (posterior.num_categoricals, posterior.num_classes))
        if generator is None:
            chosen = logits.argmax(-1)
        else:
            mixed = (1 - UNIMIX) * logits.softmax(-1) + UNIMIX / logits.shape[-1]
            drawn = torch.multinomial(mixed.flatten(0, -2), 1, generator=generator)
            chosen = drawn.view(logits.shape[:-1])
        return F.one_hot(chosen, logits.shape[-1]).to(belief.dtype).flatten(-2), belief


def actor_module(actor: ActorNetwork) -> ProbabilisticTensorDictSequential:
    """The actor as TorchRL's losses take it: writes `loc`, `scale` and a sampled `action`."""
    return ProbabilisticTensorDictSequential(
        TensorDictModule(actor, in_keys=["state", "belief"], out_keys=["loc", "scale"]),
        ProbabilisticTensorDictModule(
            in_keys=["loc", "scale"],
            out_keys=[keys.ACTION],
            distribution_class=IndependentNormal,
            default_interaction_type=InteractionType.RANDOM,
        ),
    )


def act(networks: DreamerNetworks, memory: TensorDictBase, generator: torch.Generator | None) -> TensorDict:
    """See a frame and choose an action; networks in eval mode, without a generator the most likely state and the mean.

    The memory is `state` (n, S), `belief` (n, H), ACTION (n, A) and PIXELS uint8 (n, 3, H, W), which come back anew,
    the
    frames reduced.
    """
    frames = networks.reduce(memory.get(keys.PIXELS))
    state, belief = networks.filter(
        memory.get("state"), memory.get("belief"), memory.get(keys.ACTION), frames, generator
    )
    mean, std = networks.actor(state, belief)
    action = mean
    if generator is not None:
        action = mean + std * torch.randn(mean.shape, generator=generator, device=mean.device)
    values = {"state": state, "belief": belief, keys.ACTION: action, keys.PIXELS: frames}
    return TensorDict(values, memory.batch_size)


class DreamerActor(Actor):
    """DreamerV3 without exploring. The memory: `state`, `belief` and the last ACTION."""

    def __init__(self, networks: DreamerNetworks) -> None:
        super().__init__(("state", "belief", keys.ACTION))
        self.networks = networks

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        return self.networks.blank(len(seeds)).to(self.device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """PIXELS (n, 3, H, W) and the memory -> ACTION (n, A) and the memory."""
        return tensordict.update(act(self.networks, tensordict, None).select(*self.out_keys))


def load_actor(run: Run, device: torch.device | str = "cpu") -> DreamerActor:
    """The trained actor of `RUN/dreamer/checkpoint`, in eval mode; a CheckpointError where there is none, or a damaged
    one.
    """
    done = run.stage(NAME)
    own, env = done.group(DreamerConfig, NAME), done.group(EnvConfig, "env")
    return DreamerActor(done.restore(lambda: DreamerNetworks(own, env), "networks", device))
