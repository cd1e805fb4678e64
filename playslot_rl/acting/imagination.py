"""The world model as an environment: `env.rollout(steps, policy)` is imagination.

The state is the past the predictor attends to: a right-aligned history of C frames of slots and of the latent actions
taken at them, and the number of frames that are there. Nothing is rendered and no real action is needed; the policy is
the module that also acts in the simulator (`playslot_rl.acting.simulation`).

Shapes: N slots, D slot width, Z latent-action width, C context frames, H W image height and width. "[N,]" is there
with one latent action per slot.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy.typing as npt
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs.model_based import ModelBasedEnvBase

from playslot_rl import keys
from playslot_rl.frames import as_numbers, normalise
from playslot_rl.world_model import WorldModel, dynamics_module, module_device

FirstSlots = Callable[[int], Tensor]
"""Draws the first slots of that many episodes: n -> (n, N, D)."""
Reward = Callable[[Tensor], Tensor]
"""Slots (..., N, D) to what coming to them is worth, (..., 1)."""


class ImaginationEnv(ModelBasedEnvBase):
    """cOCVP as a TorchRL environment whose action is LATENT_ACTION and whose observation is SLOTS.

    A reset takes the first slots from SLOTS (..., N, D) in the tensordict it gets, else parses PIXELS (..., 3, H, W) in
    it, else asks `first_slots`, else parses a mid-grey frame (which is there so that the specs can be checked, not to
    be learned from). `generator` is that of sampled initial slots. PlaySlot has no reward model: without `reward`, of
    the slots that a step leads to, there is no reward, and a loss that reads one fails where it would learn from zeros
    in silence.

    An episode is truncated after `horizon` steps, 0 never. `differentiable` keeps the graph, for learning through
    imagination. The histories are part of the state, so a rollout stores them at every step:
    `rollout.select(keys.SLOTS, keys.LATENT_ACTION, ("next", keys.SLOTS))` keeps what is wanted.

    Examples:
        >>> from playslot_rl.testing import tiny_agent
        >>> from playslot_rl.world_model import latent_policy_module
        >>> agent = tiny_agent()
        >>> env = ImaginationEnv(agent.world_model, batch_size=[2])
        >>> start = env.reset(TensorDict({"pixels": torch.rand(2, 3, 64, 64)}, [2]))
        >>> rollout = env.rollout(5, latent_policy_module(agent.policy), tensordict=start, auto_reset=False)
        >>> rollout["next", "slots"].shape, rollout["latent_action"].shape
        (torch.Size([2, 5, 4, 32]), torch.Size([2, 5, 8]))
    """

    def __init__(
        self,
        world_model: WorldModel,
        batch_size: Sequence[int] = (),
        first_slots: FirstSlots | None = None,
        horizon: int = 0,
        differentiable: bool = False,
        generator: torch.Generator | None = None,
        reward: Reward | None = None,
    ) -> None:
        if horizon < 0:
            raise ValueError(f"horizon: got {horizon}, expected 0 (none) or more steps")
        world_model.eval()
        device = module_device(world_model)
        super().__init__(
            dynamics_module(world_model),
            device=device,
            batch_size=torch.Size(batch_size),
        )
        self.savi, self.image_size = world_model.savi, world_model.env.image_size
        self.slot_shape, self.latent_shape = world_model.slot_shape, world_model.latent_shape
        self.context = world_model.config.predictor.context
        self.first_slots, self.horizon, self.differentiable = first_slots, horizon, differentiable
        self.generator, self.reward = generator, reward
        self._make_specs()

    def _make_specs(self) -> None:
        batch, device = self.batch_size, self.device

        def spec(shape: tuple[int, ...], dtype: torch.dtype = torch.float32) -> Unbounded:
            return Unbounded((*batch, *shape), dtype=dtype, device=device)

        self.observation_spec = Composite({keys.SLOTS: spec(self.slot_shape)}, shape=batch, device=device)
        self.state_spec = Composite(
            {
                keys.SLOT_HISTORY: spec((self.context, *self.slot_shape)),
                keys.ACTION_HISTORY: spec((self.context, *self.latent_shape)),
                keys.HISTORY_LENGTH: spec((1,), torch.int64),
                keys.STEP_COUNT: spec((1,), torch.int64),
            },
            shape=batch,
            device=device,
        )
        # What the state becomes is observed too: that is how a rollout hands it to the next step.
        self.observation_spec.update(self.state_spec.clone())
        self.action_spec = Composite({keys.LATENT_ACTION: spec(self.latent_shape)}, shape=batch, device=device)
        rewards = {} if self.reward is None else {"reward": spec((1,))}
        self.reward_spec = Composite(rewards, shape=batch, device=device)
        flag = Binary(1, (*batch, 1), dtype=torch.bool, device=device)
        self.done_spec = Composite(
            {name: flag.clone() for name in ("done", "terminated", "truncated")}, shape=batch, device=device
        )

    def _reset(self, tensordict: TensorDictBase | None, **_: Any) -> TensorDictBase:
        batch = self.batch_size if tensordict is None else tensordict.batch_size
        slots = self._first(tensordict, batch)
        if slots.shape != (*batch, *self.slot_shape):
            got, expected = tuple(slots.shape), (*batch, *self.slot_shape)
            raise ValueError(f"first slots: got shape {got}, expected {expected}; parse frames with this world model")
        history = slots.new_zeros(*batch, self.context, *self.slot_shape)
        history[..., -1, :, :] = slots
        actions = slots.new_zeros(*batch, self.context, *self.latent_shape)
        count = torch.zeros(*batch, 1, dtype=torch.int64, device=self.device)
        return TensorDict(
            {
                keys.SLOTS: slots,
                keys.SLOT_HISTORY: history,
                keys.ACTION_HISTORY: actions,
                keys.HISTORY_LENGTH: count + 1,
                keys.STEP_COUNT: count,
                **self._done(count, at=None),
            },
            batch,
            device=self.device,
        )

    def _first(self, tensordict: TensorDictBase | None, batch: torch.Size) -> Tensor:
        if tensordict is not None:
            given: Tensor | None = tensordict.get(keys.SLOTS, None)
            if given is not None:
                return given.to(self.device)
            pixels: Tensor | None = tensordict.get(keys.PIXELS, None)
            if pixels is not None:
                return self._parse(pixels, batch)
        if self.first_slots is not None:
            return self.first_slots(batch.numel()).to(self.device).reshape(*batch, *self.slot_shape)
        side = self.image_size
        return self._parse(torch.full((*batch, 3, side, side), 0.5, device=self.device), batch)

    @torch.no_grad()
    def _parse(self, pixels: Tensor, batch: torch.Size) -> Tensor:
        frames = normalise(pixels.to(self.device)).reshape(-1, 1, *pixels.shape[-3:])
        parsed: tuple[Tensor, Tensor] = self.savi(frames, generator=self.generator)
        return parsed[0][:, 0].reshape(*batch, *self.slot_shape)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        with torch.set_grad_enabled(self.differentiable and torch.is_grad_enabled()):
            out: TensorDictBase = super()._step(tensordict)
            if self.reward is not None:
                slots = out.get(keys.SLOTS)
                got, expected = self.reward(slots), (*slots.shape[:-2], 1)
                if got.shape != expected:
                    seen = f"got shape {tuple(got.shape)} of slots {tuple(slots.shape)}"
                    raise ValueError(f"reward: {seen}, expected {expected}")
                out.set("reward", got)
        count = tensordict.get(keys.STEP_COUNT) + 1
        out.set(keys.STEP_COUNT, count)
        out.update(self._done(count, at=self.horizon or None))
        return out

    @staticmethod
    def _done(count: Tensor, at: int | None) -> dict[str, Tensor]:
        """Flags of the incoming batch's shape; `at` is the step that truncates."""
        never = torch.zeros_like(count, dtype=torch.bool)
        truncated = never.clone() if at is None else count >= at
        return {"done": truncated.clone(), "terminated": never, "truncated": truncated}

    def _set_seed(self, seed: int | None) -> None:
        """Imagination is deterministic; only first frames parsed with sampled initial slots are not."""
        if self.generator is not None and seed is not None:
            self.generator.manual_seed(seed)


def latent_actions(world_model: WorldModel, given: npt.NDArray[Any] | Tensor, n_slots: int | None = None) -> Tensor:
    """Latent actions ([B,] P, [N,] Z) of some steps, given as they are or as integer ([B,] P, [N]) numbers of
    prototypes; `n_slots` is N, where it is not the world model's (`ImaginationSession.keep`). A TypeError for no
    numbers, a ValueError for another shape, or a prototype that does not exist.
    """
    values = as_numbers(given, "actions", "latent actions as floats, or prototypes by number")
    values = values.to(module_device(world_model))
    shape = world_model.latent_shape
    if n_slots is not None and world_model.inverse_dynamics.per_slot:
        shape = (n_slots, *shape[1:])
    if not values.is_floating_point():
        numbers, prototypes = values.long(), world_model.inverse_dynamics.prototypes
        if numbers.numel() and not 0 <= int(numbers.min()) <= int(numbers.max()) < len(prototypes):
            raise ValueError(f"actions: got prototypes {values.unique().tolist()}, expected 0 to {len(prototypes) - 1}")
        values = prototypes[numbers]
    steps = values.ndim - len(shape)
    if steps not in (1, 2) or tuple(values.shape[steps:]) != shape or values.shape[steps - 1] == 0:
        expected = ", ".join(map(str, shape))
        raise ValueError(f"actions: got shape {tuple(values.shape)}, expected ([B,] P, {expected})")
    return values.float()


class ImaginationSession:
    """Imagination one step at a time, for who plays in it or plans in it.

    Everything there is to know between two steps is `state`, a tensordict: keep it, and `restore` goes back to it.

    Examples:
        >>> from playslot_rl.testing import tiny_agent
        >>> session = ImaginationSession(tiny_agent().world_model)
        >>> session.reset(frames=torch.rand(1, 3, 64, 64)).shape
        torch.Size([1, 4, 32])
        >>> here = session.state
        >>> session.step(prototypes=[2]).shape
        torch.Size([1, 4, 32])
        >>> session.restore(here)
        >>> session.branch(6)
        >>> session.step(torch.randn(6, 8)).shape
        torch.Size([6, 4, 32])
    """

    def __init__(self, world_model: WorldModel, generator: torch.Generator | None = None) -> None:
        self.world_model, self._env = world_model, ImaginationEnv(world_model, generator=generator)
        self._state: TensorDictBase | None = None

    def reset(self, *, frames: Tensor | None = None, slots: Tensor | None = None) -> Tensor:
        """Start B episodes from their first frames (B, 3, H, W), uint8 [0, 255] or float [0, 1], or from slots (B, N,
        D), such as SAVi found in the middle of an episode; returns their slots. A ValueError where neither or both are
        given, or another shape.
        """
        if (frames is None) == (slots is None):
            raise ValueError("reset: got frames and slots, or neither, expected one of them")
        first = {keys.PIXELS: frames} if slots is None else {keys.SLOTS: slots}
        batch = [len(value) for value in first.values() if value is not None]
        self._state = self._env.reset(TensorDict(first, batch).to(self._env.device))
        return self.slots

    @property
    def state(self) -> TensorDictBase:
        """A copy of where the session stands, batch size [B]: SLOTS, the histories and their length."""
        return self._present().clone()

    def _present(self) -> TensorDictBase:
        """The state itself: a step replaces it and changes none of its tensors."""
        if self._state is None:
            raise ValueError("session: got no state, expected one: call reset(frames=...) or reset(slots=...) first")
        return self._state

    @property
    def slots(self) -> Tensor:
        """Present slots (B, N, D)."""
        slots: Tensor = self._present()[keys.SLOTS]
        return slots.clone()

    def restore(self, state: TensorDictBase) -> None:
        """Go back to a `state` of a session of the same world model."""
        self._state = state.clone()

    def branch(self, candidates: int) -> None:
        """Repeat each of the B episodes, to go on in as many ways: B * `candidates` rows, an episode's together."""
        self._state = self._present().repeat_interleave(candidates, dim=0)

    def put(self, slots: Tensor, *, forget: bool = False) -> None:
        """Put other slots (B, N, D) in the place of the present ones, as the newest frame that the predictor sees;
        `forget` drops the earlier frames too, which another scene would contradict. A ValueError for another shape.
        """
        state = self.state
        if slots.shape != state[keys.SLOTS].shape:
            got, expected = tuple(slots.shape), tuple(state[keys.SLOTS].shape)
            raise ValueError(f"put: got slots of shape {got}, expected {expected}")
        state[keys.SLOTS] = slots.clone()
        state[keys.SLOT_HISTORY][:, -1] = slots
        if forget:
            state[keys.SLOT_HISTORY][:, :-1] = 0
            state[keys.ACTION_HISTORY].zero_()
            state[keys.HISTORY_LENGTH].fill_(1)
        self._state = state

    def keep(self, rows: Sequence[int]) -> None:
        """Go on with some rows of the present slots only, in that order: the others have never been there. A ValueError
        for none, one twice, or one that is not there.
        """
        state = self.state
        n = state[keys.SLOTS].shape[1]
        if not rows or len(set(rows)) != len(rows) or not set(rows) <= set(range(n)):
            raise ValueError(f"keep: got slots {list(rows)}, expected at least one of 0 to {n - 1}, each once")
        index = torch.as_tensor(rows, device=self._env.device)
        state[keys.SLOTS] = state[keys.SLOTS][:, index]
        state[keys.SLOT_HISTORY] = state[keys.SLOT_HISTORY][:, :, index]
        if self.world_model.inverse_dynamics.per_slot:
            state[keys.ACTION_HISTORY] = state[keys.ACTION_HISTORY][:, :, index]
        self._state = state

    def step(self, latents: Tensor | None = None, *, prototypes: Sequence[int] | Tensor | None = None) -> Tensor:
        """One step of all episodes by latent actions (B, [N,] Z), or by numbers of prototypes (B, [N]), to slots (B, N,
        D). A ValueError where neither or both are given, another shape, or no such prototype.
        """
        if (latents is None) == (prototypes is None):
            raise ValueError("step: got latents and prototypes, or neither, expected one of them")
        state = self._present()
        n_slots = state[keys.SLOTS].shape[1]
        z = latent_actions(self.world_model, torch.as_tensor(prototypes) if latents is None else latents, n_slots)
        if z.shape[: -len(self.world_model.latent_shape)] != state.batch_size:
            raise ValueError(
                f"step: got actions of shape {tuple(z.shape)}, expected one for each of {len(state)} episodes"
            )
        self._state = self._env.step_mdp(self._env.step(state.copy().set(keys.LATENT_ACTION, z)))
        return self.slots
