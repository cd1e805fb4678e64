"""The world model and the agent as bundles, and their TensorDictModules.

The modules under `playslot_rl.modules` take and return plain tensors; here each gets the TensorDict keys it reads and
writes (`playslot_rl.keys`), so that the same piece runs in the simulator, in imagination and in a loss.

Shapes: B batch, T frames, N slots, D slot width, Z latent-action width, A action width, C context frames,
H W image height and width. "[N,]" is there with one latent action per slot (InvDyn_M) and absent otherwise.
"""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import EnvConfig, InverseDynamicsConfig, ModelConfig, PolicyConfig, SAViConfig
from playslot_rl.errors import ConfigError
from playslot_rl.frames import normalise
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.inverse_dynamics import InverseDynamics
from playslot_rl.modules.policy import LatentPolicy, told_keys
from playslot_rl.modules.predictors import build_predictor
from playslot_rl.modules.savi import SAVi
from playslot_rl.runtime.captured import Captured


class WorldModel(nn.Module):
    """SAVi, InvDyn and the predictor: parse, infer latent actions, predict (paper, Figure "PlaySlot").

    Examples:
        >>> from playslot_rl.testing import tiny_config
        >>> config = tiny_config()
        >>> model = WorldModel(config.model, config.env).eval()
        >>> slots, state = model.savi(torch.rand(2, 5, 3, 64, 64))
        >>> slots.shape, model.inverse_dynamics(slots).z.shape
        (torch.Size([2, 5, 4, 32]), torch.Size([2, 4, 8]))
    """

    def __init__(self, config: ModelConfig, env: EnvConfig) -> None:
        super().__init__()
        self.config = config
        self.env = env
        self.savi = SAVi(config.savi, env.image_size)
        require_slots(config.inverse_dynamics, config.savi)
        self.inverse_dynamics = InverseDynamics(config.inverse_dynamics, config.savi.slot_dim, env.action_dim)
        self.predictor = build_predictor(
            config.predictor, config.savi.slot_dim, self.inverse_dynamics.latent_dim, self.inverse_dynamics.per_slot
        )
        self.next_slots = Captured(self._next_slots, self)
        """Slots (M, N, D) after histories of slots (M, W, N, D) and latent actions (M, W, [N,] Z), of whose frames the
        last (M,) are there."""
        self.futures = Captured(self._futures, self)
        """Slots (M, S, N, D) seen so far and latent actions (M, T, [N,] Z), S - 1 of them in the past, to the slots (M,
        T, N, D) after each action; those inside the seen frames come from parsed slots."""

    @property
    def slot_shape(self) -> tuple[int, int]:
        """(N, D)."""
        return (self.config.savi.n_slots, self.config.savi.slot_dim)

    def _next_slots(self, slots: Tensor, latents: Tensor, lengths: Tensor | None) -> Tensor:
        valid = None
        if lengths is not None:
            window = slots.shape[1]
            valid = torch.arange(window, device=slots.device) >= window - lengths[:, None]
        predicted: Tensor = self.predictor(slots, *self.inverse_dynamics.split(latents), valid=valid)[:, -1]
        return predicted

    def _futures(self, slots: Tensor, latents: Tensor) -> Tensor:
        return self.predictor.rollout(slots, *self.inverse_dynamics.split(latents))

    @property
    def latent_shape(self) -> tuple[int, ...]:
        """([N,] Z): shape of one step's latent action."""
        width = self.inverse_dynamics.latent_dim
        return (self.config.savi.n_slots, width) if self.inverse_dynamics.per_slot else (width,)


def require_slots(chooses: InverseDynamicsConfig | PolicyConfig, savi: SAViConfig) -> None:
    """Refuse numbers of slots that are not there, or that say nothing, by a ConfigError."""
    key, chosen = f"{chooses.group}slots", chooses.slots
    if chosen and max(chosen) > savi.n_slots:
        raise ConfigError(f"{key}: got {max(chosen)}, expected at most the {savi.n_slots} slots of SAVi")
    if chosen and savi.initial != "learned":
        raise ConfigError(
            f"{key}: got some with model.savi.initial=gaussian, whose slots change places from "
            "episode to episode, expected none, or a SAVi of initial=learned"
        )


class Agent(nn.Module):
    """A world model, the latent policy and the action decoder that were trained on it, and maybe the slot oracle: the
    policy's architecture on real actions, whose output is clamped to [-1, 1] in use.
    """

    def __init__(
        self,
        world_model: WorldModel,
        policy: LatentPolicy,
        action_decoder: ActionDecoder,
        oracle: LatentPolicy | None = None,
    ) -> None:
        super().__init__()
        self.world_model = world_model
        self.policy = policy
        self.action_decoder = action_decoder
        self.oracle = oracle

    @classmethod
    def untrained(cls, world_model: WorldModel, oracle: bool = True) -> Agent:
        """Fresh networks of the sizes in `world_model.config`, whose latent actions must be one per step."""
        if world_model.inverse_dynamics.per_slot:
            raise ConfigError(
                "model.inverse_dynamics.variant: got multi, expected single: the policy gives one latent action a "
                "step; train dynamics with variant=single"
            )
        config, env = world_model.config, world_model.env
        slot_dim, width = config.savi.slot_dim, world_model.inverse_dynamics.latent_dim
        tasks = len(env.tasks)
        return cls(
            world_model,
            LatentPolicy(config.policy, slot_dim, width, config.policy.whiten, tasks=tasks),
            ActionDecoder(config.action_decoder, width, env.action_dim, slot_dim),
            untrained_oracle(config.policy, slot_dim, env) if oracle else None,
        )


def untrained_oracle(sizes: PolicyConfig, slot_dim: int, env: EnvConfig) -> LatentPolicy:
    """The policy's network for real actions of an environment, told which of its tasks where it has several."""
    return LatentPolicy(sizes, slot_dim, env.action_dim, acts=True, tasks=len(env.tasks))


def module_device(module: nn.Module) -> torch.device:
    """Device of a module's parameters."""
    return next(module.parameters()).device


class _ParseFrame(nn.Module):
    def __init__(self, savi: SAVi, generator: torch.Generator | None) -> None:
        super().__init__()
        self.savi = savi
        self.generator = generator

    def forward(self, pixels: Tensor, state: Tensor, age: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        batch = age.shape[:-1]
        frames, flat = normalise(pixels).reshape(-1, 1, *pixels.shape[-3:]), state.reshape(-1, *state.shape[-2:])
        fresh = age.reshape(-1) == 0
        slots, after = torch.empty_like(flat), torch.empty_like(flat)
        # An episode's first frame takes other initial slots and more iterations than a later one, so a batch that
        # mixes both (a partial reset) is parsed in two parts.
        for rows, start in ((fresh, None), (~fresh, flat)):
            if rows.any():
                parsed, next_state = self.savi(
                    frames[rows], None if start is None else start[rows], generator=self.generator
                )
                slots[rows], after[rows] = parsed[:, 0], next_state
        return slots.reshape(*batch, *slots.shape[1:]), after.reshape(*batch, *after.shape[1:]), age + 1


def frame_parser_module(savi: SAVi, generator: torch.Generator | None = None) -> TensorDictModule:
    """One frame with the recurrent state: PIXELS (..., 3, H, W), SLOT_STATE, SLOT_AGE to SLOTS, SLOT_STATE, SLOT_AGE.

    Where SLOT_AGE (..., 1) is 0 the state is not read: that frame is an episode's first.
    """
    return TensorDictModule(
        _ParseFrame(savi, generator),
        in_keys=[keys.PIXELS, keys.SLOT_STATE, keys.SLOT_AGE],
        out_keys=[keys.SLOTS, keys.SLOT_STATE, keys.SLOT_AGE],
    )


class _Step(nn.Module):
    """One step of the predictor on right-aligned histories: the arithmetic of the imagination environment."""

    def __init__(self, world_model: WorldModel) -> None:
        super().__init__()
        self.world_model = world_model

    def forward(
        self, z: Tensor, slot_history: Tensor, action_history: Tensor, length: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        batch, context = length.shape[:-1], slot_history.shape[len(length.shape) - 1]
        slots = slot_history.reshape(-1, *slot_history.shape[len(batch) :])
        actions = action_history.reshape(-1, *action_history.shape[len(batch) :])
        actions = torch.cat([actions[:, :-1], z.reshape(-1, 1, *z.shape[len(batch) :])], 1)
        predicted = self._predicted(slots, actions, length.reshape(-1))
        slots = torch.cat([slots[:, 1:], predicted[:, None]], 1)
        actions = torch.cat([actions[:, 1:], torch.zeros_like(actions[:, :1])], 1)
        return (
            predicted.reshape(*batch, *predicted.shape[1:]),
            slots.reshape(*batch, *slots.shape[1:]),
            actions.reshape(*batch, *actions.shape[1:]),
            (length + 1).clamp(max=context),
        )

    def _predicted(self, slots: Tensor, actions: Tensor, lengths: Tensor) -> Tensor:
        if slots.device.type == "cuda":
            return self.world_model.next_slots(slots, actions, lengths)
        # Frames before the longest episode's first carry nothing: leaving them out makes short imaginations cheap.
        window = int(lengths.max())
        whole = int(lengths.min()) == window
        return self.world_model._next_slots(slots[:, -window:], actions[:, -window:], None if whole else lengths)


def dynamics_module(world_model: WorldModel) -> TensorDictSequential:
    """One step of the world model, on root keys, as `ModelBasedEnvBase` wants it.

    Reads LATENT_ACTION (..., [N,] Z), SLOT_HISTORY (..., C, N, D), ACTION_HISTORY (..., C, [N,] Z) and
    HISTORY_LENGTH (..., 1); writes SLOTS (..., N, D) of the next frame and the histories moved on by one. The newest
    frame is the last of SLOT_HISTORY; its action, LATENT_ACTION, is not in ACTION_HISTORY yet. Past C frames the oldest
    is dropped and the window is computed anew, frame numbers starting at zero: the semantics of `Predictor.rollout`.
    """
    return TensorDictSequential(
        TensorDictModule(
            _Step(world_model),
            in_keys=[keys.LATENT_ACTION, keys.SLOT_HISTORY, keys.ACTION_HISTORY, keys.HISTORY_LENGTH],
            out_keys=[keys.SLOTS, keys.SLOT_HISTORY, keys.ACTION_HISTORY, keys.HISTORY_LENGTH],
        )
    )


def observed_keys(policy: object, observation: str = keys.SLOTS) -> list[str]:
    """What a policy reads: its observation, and what it is told."""
    return [observation, *told_keys(policy)]


def latent_policy_module(policy: nn.Module) -> TensorDictModule:
    """SLOTS (..., N, D), and what it is told, to LATENT_ACTION (..., [N,] Z). The same module acts in the
    simulator and in imagination.
    """
    return TensorDictModule(policy, in_keys=observed_keys(policy), out_keys=[keys.LATENT_ACTION])


def action_decoder_module(action_decoder: ActionDecoder, state: str = keys.SLOTS) -> TensorDictModule:
    """LATENT_ACTION (..., Z), and SLOTS (..., N, D) or another state if it reads one, to ACTION (..., A) in [-1, 1]."""
    read = [keys.LATENT_ACTION, state] if action_decoder.reads_slots else [keys.LATENT_ACTION]
    return TensorDictModule(action_decoder, in_keys=read, out_keys=[keys.ACTION])


def oracle_module(oracle: nn.Module, observation: str = keys.SLOTS) -> TensorDictSequential:
    """SLOTS (..., N, D), or another observation, and what it is told, to ACTION (..., A), clamped to [-1, 1]."""
    return TensorDictSequential(
        TensorDictModule(oracle, in_keys=observed_keys(oracle, observation), out_keys=[keys.ACTION]),
        TensorDictModule(nn.Hardtanh(), in_keys=[keys.ACTION], out_keys=[keys.ACTION]),
    )
