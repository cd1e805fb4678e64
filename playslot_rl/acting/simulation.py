"""The simulator seen through the world model: slots in place of pixels, latent actions in place of real ones.

`make_simulation_env` wraps a task so that its observation is SLOTS and its action LATENT_ACTION, which is what
`playslot_rl.acting.imagination.ImaginationEnv` has too: one policy module runs in both.

Shapes: N slots, D slot width, Z latent-action width, A action width, H W image height and width.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Compose, EnvBase, StepCounter, Transform, TransformedEnv

from playslot_rl import keys
from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.savi import SAVi
from playslot_rl.world_model import WorldModel, frame_parser_module, module_device


class SlotTransform(Transform):
    """Adds SLOTS to each observation, parsing PIXELS with SAVi's recurrent state, on SAVi's device.

    The state travels in the tensordict (SLOT_STATE (..., N, D), SLOT_AGE (..., 1)), never on the transform, so that
    batched environments, partial resets and interleaved rollouts each keep their own.
    """

    def __init__(self, savi: SAVi, slot_shape: tuple[int, int], generator: torch.Generator | None = None) -> None:
        super().__init__(in_keys=[keys.PIXELS], out_keys=[keys.SLOTS, keys.SLOT_STATE, keys.SLOT_AGE])
        self.parser = frame_parser_module(savi, generator)
        self.slot_shape = slot_shape

    @torch.no_grad()
    def _parse(self, pixels: Tensor, state: Tensor, age: Tensor) -> dict[str, Tensor]:
        device = module_device(self.parser)
        slots, after, older = self.parser(pixels.to(device), state.to(device), age.to(device))
        found = {keys.SLOTS: slots, keys.SLOT_STATE: after, keys.SLOT_AGE: older}
        return {key: value.to(pixels.device) for key, value in found.items()}

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        # Episodes that a partial reset leaves alone are parsed as well; `EnvBase.reset` discards their values.
        pixels = tensordict_reset.get(keys.PIXELS)
        batch = pixels.shape[:-3]
        state = torch.zeros(*batch, *self.slot_shape, device=pixels.device)
        age = torch.zeros(*batch, 1, dtype=torch.int64, device=pixels.device)
        tensordict_reset.update(self._parse(pixels, state, age))
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        state, age = tensordict.get(keys.SLOT_STATE), tensordict.get(keys.SLOT_AGE)
        next_tensordict.update(self._parse(next_tensordict.get(keys.PIXELS), state, age))
        return next_tensordict

    def _specs(self, like: TensorSpec) -> dict[str, TensorSpec]:
        batch, device = like.shape, like.device
        return {
            keys.SLOT_STATE: Unbounded((*batch, *self.slot_shape), device=device),
            keys.SLOT_AGE: Unbounded((*batch, 1), dtype=torch.int64, device=device),
        }

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        state = self._specs(observation_spec)
        observation_spec.update({keys.SLOTS: state[keys.SLOT_STATE].clone(), **state})
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """The recurrent state is an input of the next step: batched environments pass on only what is declared."""
        state_spec.update(self._specs(state_spec))
        return state_spec


class ActionDecoderTransform(Transform):
    """Turns the policy's LATENT_ACTION ([N,] Z), with the SLOTS (N, D) it was chosen at, into the ACTION the task
    wants, on the way in, in the units that it was recorded in.
    """

    def __init__(
        self, action_decoder: ActionDecoder, latent_shape: tuple[int, ...], slot_shape: tuple[int, int]
    ) -> None:
        super().__init__(in_keys=[], out_keys=[], in_keys_inv=[keys.ACTION], out_keys_inv=[keys.LATENT_ACTION])
        self.action_decoder = action_decoder
        self.latent_shape, self.slot_shape = latent_shape, slot_shape

    @torch.no_grad()
    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        latent, slots = tensordict.get(keys.LATENT_ACTION, None), tensordict.get(keys.SLOTS, None)
        if latent is None:
            return tensordict
        device = module_device(self.action_decoder)
        action: Tensor = self.action_decoder(latent.to(device), None if slots is None else slots.to(device))
        action = self.action_decoder.action_range.from_unit(action)
        return tensordict.set(keys.ACTION, action.to(latent.device))

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """SLOTS are an input of the next step where the decoder reads them."""
        if self.action_decoder.reads_slots:
            state_spec[keys.SLOTS] = Unbounded((*state_spec.shape, *self.slot_shape), device=state_spec.device)
        return state_spec

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        spec = Unbounded((*action_spec.shape, *self.latent_shape), device=action_spec.device)
        return Composite({keys.LATENT_ACTION: spec}, shape=action_spec.shape, device=action_spec.device)


def latent_env(
    base: EnvBase,
    world_model: WorldModel,
    action_decoder: ActionDecoder,
    max_steps: int,
    generator: torch.Generator | None = None,
) -> TransformedEnv:
    """Wrap any TorchRL environment with PIXELS uint8 (..., 3, H, W) and ACTION (..., A), batched or not; an episode is
    truncated after `max_steps`. A ValueError where its frames or actions are not what the world model was made for.
    """
    side, width = world_model.env.image_size, world_model.env.action_dim
    frame = tuple(base.observation_spec[keys.PIXELS].shape[-3:])
    if frame != (3, side, side):
        raise ValueError(f"frames: got {frame}, expected {(3, side, side)}; set env.image_size to the world model's")
    action = base.full_action_spec[keys.ACTION].shape[-1]
    if action != width:
        raise ValueError(f"actions: got width {action}, expected {width}; set env.action_dim to the world model's")
    world_model.eval()
    action_decoder.eval()
    return TransformedEnv(
        base,
        Compose(
            SlotTransform(world_model.savi, world_model.slot_shape, generator),
            ActionDecoderTransform(action_decoder, world_model.latent_shape, world_model.slot_shape),
            StepCounter(max_steps=max_steps, step_count_key=keys.STEP_COUNT),
        ),
        auto_unwrap=True,
    )


def make_simulation_env(
    env_config: EnvConfig,
    render_config: RenderConfig,
    world_model: WorldModel,
    action_decoder: ActionDecoder,
    generator: torch.Generator | None = None,
) -> TransformedEnv:
    """The simulated task with SLOTS as observation and LATENT_ACTION as action, rendered as the training data were.

    The task's own keys stay (PIXELS, SUCCESS, reward, done). `action_decoder_module` on the rollout gives the real
    actions again, in [-1, 1]. Seed by `env.set_seed(seed)` before a reset; `generator` is that of sampled initial
    slots. The environment's tensors are on the CPU, the networks stay on their device. A ConfigError for an unknown
    environment, a RenderError without a GL backend, a ValueError for another frame size or action width than the world
    model's.

    Examples:
        >>> from playslot_rl.testing import tiny_agent, tiny_config
        >>> from playslot_rl.world_model import latent_policy_module
        >>> config = tiny_config(max_steps=3)
        >>> agent = tiny_agent(config)
        >>> env = make_simulation_env(config.env, RenderConfig(), agent.world_model, agent.action_decoder)
        >>> rollout = env.rollout(3, latent_policy_module(agent.policy))
        >>> rollout["slots"].shape, rollout["next", "success"].shape
        (torch.Size([3, 4, 32]), torch.Size([3, 1]))
        >>> env.close()
    """
    from playslot_rl.envs import make_torchrl_env

    base = make_torchrl_env(env_config, render_config)
    return latent_env(base, world_model, action_decoder, env_config.max_steps, generator)
