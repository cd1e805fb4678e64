"""DreamerV3 as a learner of the online loop: TorchRL's model, actor and value losses on our networks.

A record of the replay is (a_{t-1}, o_t, r_t, is_first_t): TorchRL's rollout reads a_{t-1} at the root and o_t, r_t
under `next`, and the state it writes under `next` is that of o_t.

Shapes: B sequences of T frames, S and H widths of z and h.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.model_based.dreamer import DreamerEnv
from torchrl.modules import RSSMRolloutV3, WorldModelWrapper
from torchrl.objectives import DreamerV3ActorLoss, DreamerV3Loss, DreamerV3ModelLoss, DreamerV3ValueLoss, SoftUpdate
from torchrl.objectives.utils import ValueEstimators
from torchrl.trainers.algorithms import DreamerV3OptimizationStepper, DreamerV3Optimizer

from playslot_rl import keys
from playslot_rl.errors import ConfigError
from playslot_rl.losses.common import total_loss
from playslot_rl.methods.dreamer.method import DreamerConfig
from playslot_rl.methods.dreamer.networks import BINS, UNIMIX, DreamerNetworks, act, actor_module
from playslot_rl.methods.online.loop import OnlineTraining
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.training.compiling import require_compiler
from playslot_rl.training.record import StageRecord


def world_model(networks: DreamerNetworks) -> TensorDictSequential:
    """Encoder, RSSM over the sequence, decoder and reward head, on records [B, T]."""
    latent = [("next", "state"), ("next", "belief")]
    prior = TensorDictModule(
        networks.prior,
        in_keys=["state", "belief", keys.ACTION],
        out_keys=[("next", "prior_logits"), *latent],
    )
    posterior = TensorDictModule(
        networks.posterior,
        in_keys=[("next", "belief"), ("next", "encoded_latents")],
        out_keys=[("next", "posterior_logits"), ("next", "state")],
    )
    return TensorDictSequential(
        TensorDictModule(networks.encoder, [("next", keys.PIXELS)], [("next", "encoded_latents")]),
        RSSMRolloutV3(prior, posterior, reset_key=keys.IS_FIRST),
        TensorDictModule(networks.decoder, latent, [("next", "reco_pixels")]),
        TensorDictModule(networks.reward, latent, [("next", "reward_logits"), ("next", keys.REWARD)]),
    )


def imagination(networks: DreamerNetworks) -> DreamerEnv:
    dynamics = TensorDictModule(networks.prior, ["state", "belief", keys.ACTION], ["_", "state", "belief"])
    reward = TensorDictModule(networks.reward, ["state", "belief"], ["_", keys.REWARD])
    device = next(networks.parameters()).device
    env = DreamerEnv(
        WorldModelWrapper(dynamics, reward),
        prior_shape=(networks.state_dim,),
        belief_shape=(networks.belief_dim,),
        device=device,
    )
    env.observation_spec = Composite(
        state=Unbounded(networks.state_dim, device=device), belief=Unbounded(networks.belief_dim, device=device)
    )
    env.state_spec = env.observation_spec.clone()
    env.action_spec = Bounded(-1, 1, (networks.action_dim,), device=device)
    env.reward_spec = Unbounded((1,), device=device)
    return env


def build_loss(networks: DreamerNetworks, config: DreamerConfig) -> DreamerV3Loss:
    """The sum of all terms.

    Note: there is no continuation head. Our tasks end by their time limit only, so the source's would learn the
    constant that `gamma` is here.
    """
    model = DreamerV3ModelLoss(
        world_model(networks),
        lambda_reco=config.reconstruction_weight,
        kl_mode="separate",
        lambda_representation=config.representation_weight,
        unimix=UNIMIX,
        free_bits=config.free_nats,
        reco_symlog=False,
        num_reward_bins=BINS,
        detach_output=False,
    )
    model.set_keys(pixels=keys.PIXELS, reward=keys.REWARD)
    critic = TensorDictModule(networks.value, ["state", "belief"], ["state_value_logits", "state_value"])
    actor = DreamerV3ActorLoss(
        actor_module(networks.actor),
        critic,
        imagination(networks),
        imagination_horizon=config.horizon,
        entropy_bonus=config.entropy,
        use_reinforce=True,
    )
    # TorchRL 0.14.1 hands its estimator a TensorDict without batch size, whose time is then taken to be the last axis,
    # of length one: without `time_dim` the lambda returns are one-step returns.
    # Its vectorised returns wait for the lengths of episodes, so that no graph could hold them.
    returns = {"gamma": config.gamma, "lmbda": config.lmbda, "time_dim": -2, "vectorized": False}
    actor.make_value_estimator(ValueEstimators.TDLambda, **returns)
    value = DreamerV3ValueLoss(
        critic, value_loss="two_hot", num_value_bins=BINS, actor_loss=actor, slow_critic_regularization=1.0
    )
    loss = DreamerV3Loss(
        model,
        actor,
        value,
        replay_value_loss_weight=config.replay_value_weight,
        continuation_horizon=1 / (1 - config.gamma),
        lmbda=config.lmbda,
    )
    loss.set_keys(is_init=keys.IS_FIRST)
    return loss


def records(batch: TensorDictBase, networks: DreamerNetworks) -> TensorDict:
    """A batch of the replay [B, T] as TorchRL's losses take it. Sequences start from zero states.

    Note: the source keeps its latent states in the replay, to start a sequence within an episode from; here it starts
    from zero, which is exact where sequences are whole episodes.
    """
    blank = networks.blank(1).to(batch.device).unsqueeze(1).expand(*batch.batch_size)
    last = batch.get(keys.IS_LAST)
    return TensorDict(
        {
            "state": blank.get("state").contiguous(),
            "belief": blank.get("belief").contiguous(),
            keys.ACTION: batch.get(keys.ACTION),
            keys.IS_FIRST: batch.get(keys.IS_FIRST),
            "next": {
                keys.PIXELS: batch.get(keys.PIXELS),
                keys.REWARD: batch.get(keys.REWARD),
                "done": last,
                "terminated": torch.zeros_like(last),
            },
        },
        batch.batch_size,
    )


class DreamerLearner:
    """A `Learner` from pixels: world model, actor and critic in one update. `loss` holds the slow critic and the scale
    of the returns.
    """

    stored: tuple[str, ...] = (keys.PIXELS,)

    def __init__(self, networks: DreamerNetworks, config: DreamerConfig) -> None:
        self.networks, device = networks, next(networks.parameters()).device
        self._prepared = not require_device(config, device)
        self.loss = build_loss(networks, config).to(device)
        self._optimizer = DreamerV3Optimizer(self.loss.parameters(), lr=config.lr, warmup_steps=config.warmup)
        self._stepper = DreamerV3OptimizationStepper(
            self.loss,
            self._optimizer,
            SoftUpdate(self.loss.value_loss, tau=config.critic_rate),
            compile_train_step=config.compile_train_step,
            cudagraph=config.cudagraph,
        )
        self._slow = _Slow(self.loss)

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"networks": self.networks, "slow": self._slow}

    @property
    def optimizers(self) -> Mapping[str, torch.optim.Optimizer]:
        """The one optimiser of everything: LaProp with adaptive gradient clipping."""
        return {"all": self._optimizer}

    def initial(self, n: int) -> TensorDict:
        return self.networks.blank(n)

    def act(self, memory: TensorDictBase, generator: torch.Generator, explore: bool) -> TensorDictBase:
        return act(self.networks, memory, generator if explore else None)

    def update(self, batch: TensorDict, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        """One step; TorchRL draws from the global generators, which the loop has seeded. Of what it computes only the
        replayed returns wait for the device, and these not where they are compiled or recorded.
        """
        record = records(batch, self.networks)
        if not self._prepared:
            self._stepper.warmup(record)  # compiles and records; moves neither weights nor generators
            self._prepared = True
        values = self._stepper.step(None, record)
        numbers = {str(key): value.reshape(()) for key, value in values.items() if value.numel() == 1}
        return {"loss": total_loss(numbers), **numbers}


def require_device(config: DreamerConfig, device: torch.device) -> bool:
    """Whether a step is compiled or recorded; a ConfigError where that cannot be on a device.

    Note: TorchRL can compile it on a CPU, too, but seven minutes were not enough for networks of test size.
    """
    asked = [key for key in ("compile_train_step", "cudagraph") if getattr(config, key)]
    for key in asked:
        if device.type != "cuda":
            name = f"{config.group}{key}"
            raise ConfigError(f"{name}=true: got device {device.type}, expected cuda: leave {name} out")
    if config.compile_train_step:
        require_compiler(f"{config.group}compile_train_step")
    return bool(asked)


class _Slow(nn.Module):
    """What the objective holds beside the networks and changes slowly: the slow critic and the returns' percentiles."""

    def __init__(self, loss: DreamerV3Loss) -> None:
        super().__init__()
        self.critic = loss.value_loss.target_value_model_params
        self.returns = loss.actor_loss.retnorm


def training(record: StageRecord) -> OnlineTraining:
    config = record.config
    own: DreamerConfig = config.baselines.dreamer
    with global_seed(config.seed, 0, record.name):
        networks = DreamerNetworks(own, config.env).to(record.device)
        return OnlineTraining(DreamerLearner(networks, own), own, {"networks": networks})
