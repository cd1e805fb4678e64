"""SOLD's update: dynamics and reward from replayed slots, actor and critic from imagination (Mosbach et al., 2025).

Shapes: B sequences of T frames, C context frames, H imagined steps, R rollouts, N slots, D slot width, A action width.

Each loss moves the weights of one network: gradients are asked for by name (`torch.autograd.grad`), so the actor's runs
through dynamics, reward and critic and leaves them as they are.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.modules import PercentileValueNorm

from playslot_rl import keys
from playslot_rl.frames import normalise
from playslot_rl.methods.online.loop import OnlineTraining
from playslot_rl.methods.sold import losses
from playslot_rl.methods.sold.acting import SOLDActor
from playslot_rl.methods.sold.method import SOLDConfig
from playslot_rl.methods.sold.networks import SOLDNetworks, build_networks, prior_steps
from playslot_rl.modules.savi import SAVi
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.training.record import StageRecord


class SOLDLearner:
    """SOLD as `playslot_rl.methods.online.acting.Learner`; SAVi is frozen, in evaluation mode. `frames` are those of an
    episode.
    """

    def __init__(self, savi: SAVi, networks: SOLDNetworks, config: SOLDConfig, action_dim: int, frames: int) -> None:
        self.savi, self.networks, self.config = savi, networks, config
        self.slow_critic = copy.deepcopy(networks.critic).requires_grad_(False)
        self.mean_actor = copy.deepcopy(networks.actor).requires_grad_(False)
        # The average of the returns' 5-95 percentile range; it starts at zero, as in DreamerV3.
        self.returns = PercentileValueNorm(rate=config.return_rate, min_scale=1.0).to(next(savi.parameters()).device)
        self.exploring = SOLDActor(savi, networks.actor, frames, action_dim)
        self.acting = SOLDActor(savi, self.mean_actor, frames, action_dim)
        self.stored: tuple[str, ...] = (keys.SLOTS,) if config.image_weight == 0 else (keys.SLOTS, keys.PIXELS)
        rates = {"actor": config.actor_lr, "critic": config.critic_lr}
        self._adam = {
            name: torch.optim.Adam(part.parameters(), lr=rates.get(name, config.model_lr))
            for name, part in networks.parts.items()
        }

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        slow = {"slow_critic": self.slow_critic, "mean_actor": self.mean_actor}
        return {**self.networks.parts, **slow, "returns": self.returns}

    @property
    def trained(self) -> Mapping[str, nn.Module]:
        """The four networks as a finished run keeps them: the actor is the average."""
        return {**self.networks.parts, "actor": self.mean_actor}

    @property
    def optimizers(self) -> Mapping[str, torch.optim.Optimizer]:
        return self._adam

    def initial(self, n: int) -> TensorDict:
        return self.acting.initial(n)

    def act(self, memory: TensorDictBase, generator: torch.Generator, explore: bool) -> TensorDictBase:
        """See `Learner.act`; explores with the actor's last weights, and evaluates the average of them.

        Note: the source does not average. Between updates a few of the last weights' most likely actions are far off.
        """
        return self.exploring.act(memory, generator, explore) if explore else self.acting(memory)

    def update(self, batch: TensorDict, generators: StepGenerators) -> Mapping[str, Tensor]:
        metrics = self._model(batch, generators)
        if generators.step >= self.config.world_model_updates:
            metrics |= self._behaviour(batch, generators)
        return metrics

    def _model(self, batch: TensorDict, generators: StepGenerators) -> dict[str, Tensor]:
        """Section 3.2: the autoregressive rollout from C frames, and the reward on parsed slots.

        Note: with `predicted_rewards` on predicted slots as well, of the same targets.
        """
        batch, c = self._window(batch, generators)
        slots, is_first = batch[keys.SLOTS], batch[keys.IS_FIRST].squeeze(-1)
        valid = losses.same_episode(is_first)
        predicted = self.networks.dynamics.rollout(slots[:, :c], batch[keys.ACTION][:, 1:])[:, c - 1 :]
        slot = losses.slot_loss(predicted, slots[:, c:], valid[:, c:])
        still = losses.slot_loss(slots[:, c - 1 : c].expand_as(slots[:, c:]), slots[:, c:], valid[:, c:])
        metrics = {"slot_mse": slot.detach(), "unexplained": slot.detach() / still.clamp(min=1e-12)}
        loss = self.config.slot_weight * slot
        if self.config.image_weight > 0:
            image = self._image_loss(predicted, batch[keys.PIXELS][:, c:], valid[:, c:], generators)
            loss, metrics["image_mse"] = loss + self.config.image_weight * image, image.detach()
        metrics["dynamics_grad_norm"] = self._step("dynamics", loss)

        head, seen = self.networks.reward, [slots]
        if self.config.predicted_rewards:
            seen.append(torch.cat((slots[:, :c], predicted), dim=1).detach())
        targets, arrived = batch[keys.REWARD].squeeze(-1).repeat(len(seen), 1), (valid & ~is_first)
        entropy = head.cross_entropy(head(torch.cat(seen)), targets)
        reward = losses.masked_mean(entropy, arrived.repeat(len(seen), 1))
        return metrics | {"loss_reward": reward.detach(), "reward_grad_norm": self._step("reward", reward)}

    def _window(self, batch: TensorDict, generators: StepGenerators) -> tuple[TensorDict, int]:
        """A window of C + H frames of each sequence (all of it, where it is shorter), and the frames c it starts
        from.
        """
        (b, t), device = batch.batch_size, torch.device(generators.device)
        frames = min(t, self.config.context + self.config.horizon)
        first = torch.randint(t - frames + 1, (b, 1), generator=generators.torch("window"), device=device)
        row = torch.arange(b, device=device)[:, None]
        window = batch[row, first + torch.arange(frames, device=device)]
        return window, self._context(generators, "context", frames - 1)

    def _image_loss(self, predicted: Tensor, pixels: Tensor, valid: Tensor, generators: StepGenerators) -> Tensor:
        """Mean squared error of decoded frames, through the frozen decoder."""
        count, frames = self.config.decoded_frames, predicted.shape[1]
        if 0 < count < frames:
            picked = torch.randperm(frames, generator=generators.torch("decoded"), device=predicted.device)[:count]
            predicted, pixels, valid = predicted[:, picked], pixels[:, picked], valid[:, picked]
        decoded = self.savi.decode(predicted).frames
        return losses.masked_mean((decoded - normalise(pixels)).square().mean(dim=(-3, -2, -1)), valid)

    def _behaviour(self, batch: TensorDict, generators: StepGenerators) -> dict[str, Tensor]:
        """Section 3.3: imagine, judge, improve."""
        config, networks = self.config, self.networks
        context, actions = self._starts(batch, generators)
        frames = context.shape[1]
        noise = generators.torch("imagination")
        imagined = losses.imagine(networks.dynamics, networks.actor, context, actions, config.horizon, noise)
        logits = networks.critic(imagined.slots)[:, frames - 1 :]
        values = networks.critic.decode(logits)
        rewards = networks.reward.decode(networks.reward(imagined.slots)[:, frames:])
        returns = losses.imagined_returns(rewards, values[:, 1:], config.gamma, config.lmbda)
        self.returns.update(returns.detach().unsqueeze(-1))
        weights = config.gamma ** torch.arange(config.horizon, device=returns.device, dtype=returns.dtype)
        actor = losses.actor_loss(
            imagined, returns, values[:, :-1], self.returns.scale(), weights, config.entropy, config.actor_gradient
        )
        with torch.no_grad():
            slow = self.slow_critic.decode(self.slow_critic(imagined.slots[:, :-1])[:, frames - 1 :])
        value = losses.value_loss(networks.critic, logits[:, :-1], returns, slow, weights, config.slow_weight)
        # Actor and critic share the critic's forward pass, so it is kept until both gradients are taken.
        norms = {
            "actor_grad_norm": self._step("actor", actor, keep=True),
            "critic_grad_norm": self._step("critic", value),
        }
        self._follow()
        return norms | {
            "loss_actor": actor.detach(),
            "loss_critic": value.detach(),
            "imagined_reward": rewards.detach().mean(),
            "imagined_return": returns.detach().mean(),
            "return_scale": self.returns.scale().detach().squeeze(),
            "entropy": imagined.entropies.detach().mean(),
            "action_size": imagined.locations.abs().mean(),
        }

    def _context(self, generators: StepGenerators, stream: str, most: int) -> int:
        """Frames c that rollouts start from.

        Note: the source always takes C, as `least_context` has it by default. An episode's first C - 1 decisions are
        then made on a history shorter than any that the actor learned on.
        """
        most = min(self.config.context, most)
        return int(generators.numpy(stream).integers(min(self.config.least_context, most), most + 1))

    def _starts(self, batch: TensorDict, generators: StepGenerators) -> tuple[Tensor, Tensor]:
        """Windows (R, c, N, D) of one episode each, and the actions (R, c - 1, A) between their frames.

        Note: drawn from all of the batch. The source takes the first C frames of each sequence, of which an episode has
        none among its last H.
        """
        first = batch[keys.IS_FIRST].squeeze(-1)
        t = first.shape[1]
        c = self._context(generators, "starts", t)
        ends = torch.ones_like(first)
        ends[:, : c - 1] = False
        for back in range(c - 1):  # no frame of the window but its first may start an episode
            ends[:, back:] &= ~first[:, : t - back]
        draw = generators.torch("start_frames")
        picked = torch.multinomial(ends.flatten().float(), self.config.starts, replacement=True, generator=draw)
        row, frames = picked[:, None] // t, picked[:, None] % t - c + 1 + torch.arange(c, device=picked.device)
        return batch[keys.SLOTS][row, frames], batch[keys.ACTION][row, frames[:, 1:]]

    def _step(self, name: str, loss: Tensor, keep: bool = False) -> Tensor:
        """Move one network by a loss; its gradient's norm before clipping. `keep` leaves the graph for another loss."""
        parameters = list(self.networks.parts[name].parameters())
        gradients = torch.autograd.grad(loss, parameters, retain_graph=keep)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        clip = self.config.dynamics_clip if name == "dynamics" else self.config.grad_clip
        norm: Tensor = nn.utils.clip_grad_norm_(parameters, clip)
        self._adam[name].step()  # one that is not finite spoils the weights, and the loop stops at the norm
        return norm.detach()

    @torch.no_grad()
    def _follow(self) -> None:
        """Move the slow critic towards the critic, and the mean actor towards the actor."""
        copies = (
            (self.slow_critic, self.networks.critic, self.config.critic_decay),
            (self.mean_actor, self.networks.actor, self.config.actor_average),
        )
        for copied, network, decay in copies:
            for slow, fast in zip(copied.parameters(), network.parameters(), strict=True):
                slow.lerp_(cast(Tensor, fast), 1 - decay)


def training(record: StageRecord) -> OnlineTraining:
    config, slots = record.config, record.parents["slots"]
    own: SOLDConfig = config.baselines.sold
    before = prior_steps(own, slots)
    with global_seed(config.seed, 0, record.name):
        networks = build_networks(own, slots, config.env.action_dim, config.env.max_steps).to(record.device)
    savi = record.world.load_savi(record.device)
    learner = SOLDLearner(savi, networks, own, config.env.action_dim, config.env.max_steps + 1)
    return OnlineTraining(learner, own, dict(learner.trained), before)
