"""What acts on a frozen CADDY's states: a policy of moves, and an oracle's real actions.

    s_t = E(x_t)
    CADDY          (l_t, u_t) = f(s_t),   v_t = m + sigma u_t,   z_t = [onehot argmax l_t, v_t]       K + Z numbers
    CADDY Oracle   a_t = f(s_t)                                                                       A numbers

f is a trunk like A's and a linear layer, with weights of its own; z_t is what A says of two frames. The variability's
scale is free (a weight of 1e-4 holds it), so that f gives it in units of its deviation sigma in the demonstrations.

Note: PlaySlot's authors do not say what their heads look like, or what of E they read. Ours read the state s_t alone:
the map m_t, which A multiplies it by, hides what the agent does not move, such as the button that it is to press.

Shapes: B batch, M transitions, C channels of a state of H/8 x W/8, H W image height and width, K actions, Z latent
dim, A action dim.
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.acting.actor import Actor, ReactiveActor, latent_actor
from playslot_rl.config import EnvConfig
from playslot_rl.methods.caddy.action import Trunk, chosen
from playslot_rl.methods.caddy.method import CADDYConfig
from playslot_rl.methods.caddy.model import CADDY
from playslot_rl.methods.caddy.networks import Encoder, inside
from playslot_rl.methods.decoded_policy import DecodedPolicy
from playslot_rl.modules.action_range import ActionRange
from playslot_rl.runs import Run
from playslot_rl.storage.checkpoints import StageCheckpoint
from playslot_rl.world_model import oracle_module


class StateHead(nn.Module):
    """A trunk of A's form and a linear layer to K + Z numbers, or to A real actions with their `action_range`; of
    several `tasks` a learned row of each is added to the states.
    """

    def __init__(self, in_channels: int, out_dim: int, acts: bool = False, tasks: int = 0) -> None:
        super().__init__()
        self.tasks, self.told = tasks, nn.Embedding(tasks, in_channels) if tasks else None
        self.trunk = Trunk(in_channels, 2 * in_channels)
        self.to_out = nn.Linear(2 * in_channels, out_dim)
        if acts:
            self.action_range = ActionRange(out_dim)

    def forward(self, states: Tensor, *task: Tensor) -> Tensor:
        return self.outputs(self.features(states, *task))

    def features(self, observed: Tensor, *task: Tensor) -> Tensor:
        """States (B, C, H/8, W/8), and the task int64 (B, 1) where it is told, to the trunk's features, as one slot
        (B, 1, 2C).
        """
        h: Tensor = self.trunk(observed if self.told is None else observed + self.told(task[0][:, 0])[..., None, None])
        return h[:, None]

    def outputs(self, features: Tensor) -> Tensor:
        """What is cloned, from these."""
        out: Tensor = self.to_out(features[:, 0])
        return out


class MovesHead(StateHead):
    """A head whose outputs are moves: logits of the action, and the variability."""

    mean: Tensor
    scale: Tensor

    def __init__(self, in_channels: int, actions: int, latent_dim: int, tasks: int = 0) -> None:
        super().__init__(in_channels, actions + latent_dim, tasks=tasks)
        self.actions = actions
        self.register_buffer("mean", torch.zeros(latent_dim))
        self.register_buffer("scale", torch.ones(()))

    @torch.no_grad()
    def standardise(self, v: Tensor) -> None:
        """Take m and sigma, one for all dimensions, from variabilities (M, Z)."""
        self.mean.copy_(v.mean(dim=0))
        self.scale.copy_((v - self.mean).square().mean().sqrt().clamp(min=1e-6))

    def outputs(self, features: Tensor) -> Tensor:
        """Features (B, 1, 2C) to logits and variabilities (B, K + Z), float32."""
        out = super().outputs(features).float()
        return torch.cat((out[:, : self.actions], self.mean + self.scale * out[:, self.actions :]), dim=-1)

    def decide(self, features: Tensor, *task: Tensor) -> Tensor:  # noqa: ARG002
        """Moves (B, K + Z), of which only v hands a gradient on."""
        return as_moves(self.outputs(features), self.actions)


class OnFrames(nn.Module):
    def __init__(self, encoder: Encoder, head: StateHead) -> None:
        super().__init__()
        self.encoder, self.head, self.tasks = encoder, head, head.tasks

    def forward(self, pixels: Tensor, *task: Tensor) -> Tensor:
        """Frames (B, 3, H, W), uint8 or float [0, 1], to moves (B, K + Z), or to actions (B, A) of an oracle."""
        out: Tensor = self.head(states_of(self.encoder, pixels), *task)
        return as_moves(out, self.head.actions) if isinstance(self.head, MovesHead) else out

    def features(self, observed: Tensor, *task: Tensor) -> Tensor:
        return self.head.features(states_of(self.encoder, observed), *task)

    def decide(self, features: Tensor, *task: Tensor) -> Tensor:  # noqa: ARG002
        moves: Tensor = self.head.decide(features)  # type: ignore[operator]
        return moves


@torch.no_grad()
def states_of(encoder: Encoder, pixels: Tensor) -> Tensor:
    """States (B, C, H/8, W/8) of frames (B, 3, H, W), uint8 or float [0, 1]; no gradient goes to E."""
    s, _ = encoder(inside(pixels))
    states: Tensor = s.float()
    return states


def as_moves(outputs: Tensor, actions: int) -> Tensor:
    """Logits and variability (..., K + Z) to the most probable action as one-hot, and v.

    Example:
        >>> as_moves(torch.tensor([0.1, 0.9, 0.5, -3.0]), actions=3).tolist()
        [0.0, 1.0, 0.0, -3.0]
    """
    return torch.cat((chosen(outputs[..., :actions]), outputs[..., actions:]), dim=-1)


MODEL: Final = "caddy"
POLICY: Final = "caddy_policy"
ORACLE: Final = "caddy_oracle"


def load_model(done: StageCheckpoint, device: torch.device | str = "cpu") -> CADDY:
    """The CADDY of a finished stage, frozen; a CheckpointError where it is damaged."""
    own, size = done.group(CADDYConfig, MODEL), done.group(EnvConfig, "env").image_size
    return done.restore(lambda: CADDY(own, size), MODEL, device)


def load_video(run: Run, device: torch.device | str = "cpu") -> CADDY:
    return load_model(run.stage(MODEL), device)


def load_policy(run: Run, device: torch.device | str = "cpu") -> Actor:
    """CADDY's actor; a CheckpointError where a stage is missing, damaged, or of another model."""
    done, caddy = run.stage(POLICY, MODEL), load_video(run, device)
    own = caddy.config
    width, k, z = own.encoder[-1], own.actions, own.latent_dim
    tasks = len(done.group(EnvConfig, "env").tasks)
    parts = DecodedPolicy.load(done, lambda: MovesHead(width, k, z, tasks), k + z, 2 * width, device)
    return latent_actor(OnFrames(caddy.encoder, parts.policy), parts.action_decoder)


def load_oracle(run: Run, device: torch.device | str = "cpu") -> Actor:
    """The CADDY Oracle's actor, actions clamped to [-1, 1]; raises as `load_policy`."""
    done, caddy = run.stage(ORACLE, MODEL), load_video(run, device)
    env = done.group(EnvConfig, "env")
    width, tasks = caddy.config.encoder[-1], len(env.tasks)
    head = done.restore(lambda: StateHead(width, env.action_dim, True, tasks), "oracle", device)
    return ReactiveActor(oracle_module(OnFrames(caddy.encoder, head), keys.PIXELS), tasks)
