"""What acts: an observation and a memory in, an action and the memory anew out. Every method is an `Actor`.

    (a_t, m_{t+1}) = actor(o_t, m_t),    m_0 = actor.reset(seeds)

Shapes: n episodes side by side, T agent steps, N slots, D slot width, A action width, H W image height and width.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config.env import EnvConfig, in_turn
from playslot_rl.config.planning import PlanConfig
from playslot_rl.errors import ConfigError
from playslot_rl.frames import normalise
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.action_range import ActionRange, range_of
from playslot_rl.modules.policy import Decides, LatentPolicy
from playslot_rl.modules.savi import SAVi
from playslot_rl.world_model import action_decoder_module, frame_parser_module, observed_keys

RANDOM_STREAM: Final = 7
"""Keeps random actions apart from the environment's own stream of the same seed."""
OfEpisodes = Callable[[Sequence[int]], Tensor]
"""Seeds of n episodes to what is told of each, (n, ...)."""


class Actor(TensorDictModuleBase):
    """Observation to action, with a memory that travels in the tensordict, never on the module.

    Reads PIXELS (n, 3, H, W), uint8 [0, 255] or float [0, 1], or what `reads` names, and the keys of its `memory`;
    writes ACTION (n, A), in [-1, 1] but for what `executed` clips, and the memory's keys anew. In evaluation mode it is
    a function of these inputs, so that episodes in a batch do not touch each other. Where there are several `tasks` its
    memory has TASK (n, 1), which of them an episode is of, by its seed; where it is shown goals GOAL_PIXELS
    (n, 3, H, W), as `goals` gives them.

    Attributes:
        goals: goal images (n, 3, H, W) uint8 [0, 255], for who is shown one; whoever runs it sets them.
        tells: which of the tasks, int64 (n, 1); None: by the seeds.
        looks: at which frames: `always`, `first` (it never sees what its actions did) or `never`. Frames that nobody
            looks at need not be drawn.
    """

    looks: Literal["always", "first", "never"] = "always"
    goals: OfEpisodes | None = None
    tells: OfEpisodes | None = None

    def __init__(
        self, memory: Sequence[str] = (), reads: Sequence[str] = (keys.PIXELS,), tasks: int = 0, goal: bool = False
    ) -> None:
        super().__init__()
        self.tasks, self.shown_goals = tasks, goal
        self.memory_keys = (*memory, *([keys.TASK] if tasks else []), *([keys.GOAL_PIXELS] if goal else []))
        self.in_keys = [*reads, *self.memory_keys]
        self.out_keys = [keys.ACTION, *(key for key in self.memory_keys if key != keys.ACTION)]

    @property
    def device(self) -> torch.device:
        """Where its weights are."""
        first = next(self.parameters(), None)
        return torch.device("cpu") if first is None else first.device

    @property
    def action_range(self) -> ActionRange | None:
        """What its actions are in the robot's units; None where they are in [-1, 1] there, too."""
        agent = getattr(self, "agent", None)  # whose inverse dynamics may have a range, too
        return range_of(self if agent is None else agent.action_decoder)

    def executed(self, actions: Tensor) -> Tensor:
        """What a robot or a simulator gets for actions (n, A): clipped to [-1, 1], and in its units."""
        clipped, known = actions.clamp(-1, 1), self.action_range
        return clipped if known is None else known.from_unit(clipped)

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        """The memory of new episodes, batch size [len(seeds)]; whatever is drawn depends on the seeds alone."""
        memory = TensorDict({}, [len(seeds)], device=self.device)
        if self.tasks:
            memory[keys.TASK] = self.tells(seeds) if self.tells else told(seeds, self.tasks)
        if self.shown_goals:
            if self.goals is None:
                raise ConfigError(
                    "model.policy.goal: got no goal images, expected some for a policy that is shown them: use "
                    "evaluate, or set the actor's `goals`"
                )
            memory[keys.GOAL_PIXELS] = self.goals(seeds)
        return memory

    @abstractmethod
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """One agent step."""


def put_rows(tensordict: TensorDictBase, rows: int | Tensor, found: Mapping[str, Tensor]) -> None:
    """Renew some rows of a memory; its tensors are others' too, and stay as they are."""
    for key, value in found.items():
        whole = tensordict.get(key).clone()
        whole[rows] = value.to(whole.device)
        tensordict.set(key, whole)


def with_present(history: Tensor, present: Tensor, step: Tensor) -> Tensor:
    """The last F of what is seen (n, F, ...), with the present (n, ...), which fills it where `step` (n, 1) is 0."""
    now, begins = present.unsqueeze(1), (step == 0).view(-1, *[1] * (history.dim() - 1))
    return torch.where(begins, now, torch.cat((history[:, 1:], now), dim=1))


def told(seeds: Sequence[int], tasks: int) -> Tensor:
    """Which of several tasks episodes are of, int64 (n, 1), as `EnvConfig.of_episode`."""
    return torch.tensor([[in_turn(seed, tasks)] for seed in seeds])


def told_as(env: EnvConfig, said: Sequence[str]) -> OfEpisodes:
    """Which of the tasks episodes are of, by what is said of each, or of all (`EnvConfig.number_of`); a ValueError for
    another number of them."""
    numbers = torch.tensor([[env.number_of(task)] for task in said])

    def tells(seeds: Sequence[int]) -> Tensor:
        if len(numbers) not in (1, len(seeds)):
            raise ValueError(f"task: got {len(numbers)} for {len(seeds)} episodes, expected one, or one of each")
        return numbers.expand(len(seeds), 1)

    return tells


@torch.no_grad()
def goal_slots(savi: SAVi, state: Tensor, goal: Tensor, looks: int = 1) -> Tensor:
    """Slots (n, N, D) of goal images (n, 3, H, W) as SAVi would track them: parsed as the frame after the first one,
    with the state (n, N, D) that it left. Parsed as a first frame they lie five times as far from the tracked ones. The
    image is shown `looks` times; a far goal may take the slots more than one correction to reach.
    """
    clip = normalise(goal)[:, None].expand(-1, looks, -1, -1, -1)
    slots: Tensor = savi(clip, state)[0]
    return slots[:, -1]


def put_goals(savi: SAVi, seen: TensorDictBase, fresh: Tensor, looks: int) -> None:
    """Find GOAL_SLOTS of the rows, bool (n,), whose first frame SAVi has just seen."""
    state, goal = seen.get(keys.SLOT_STATE)[fresh], seen.get(keys.GOAL_PIXELS)[fresh]
    put_rows(seen, fresh, {keys.GOAL_SLOTS: goal_slots(savi, state, goal, looks)})


class SlotActor(Actor):
    """Frame to slots by SAVi, whose recurrent state is the memory; slots (n, N, D) to ACTION (n, A) by the heads.

    Note: initial slots that are sampled (SAVi with `initial: gaussian`) come from one generator, which `reset` seeds
    with the first episode's seed; learned ones draw nothing.

    Args:
        policy: which of the heads may be told something: GOAL_SLOTS (n, N, D) are found at an episode's first frame.
    """

    def __init__(
        self, savi: SAVi, *heads: TensorDictModuleBase, policy: LatentPolicy, memory: Sequence[str] = ()
    ) -> None:
        own = [keys.GOAL_SLOTS] if policy.goal else []
        super().__init__((keys.SLOT_STATE, keys.SLOT_AGE, *own, *memory), tasks=policy.tasks, goal=policy.goal)
        self._slots = (savi.config.n_slots, savi.config.slot_dim)
        self.parser = frame_parser_module(savi)
        self.heads = TensorDictSequential(*heads)

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        """No frame seen: SLOT_STATE (n, N, D) zeros, not read while SLOT_AGE (n, 1) is 0."""
        self.parser.module.generator = torch.Generator(self.device).manual_seed(seeds[0])
        memory = super().reset(seeds)
        memory[keys.SLOT_STATE] = torch.zeros(len(seeds), *self._slots)
        memory[keys.SLOT_AGE] = torch.zeros(len(seeds), 1, dtype=torch.long)
        if self.shown_goals:
            memory[keys.GOAL_SLOTS] = torch.zeros(len(seeds), *self._slots)
        return memory

    def see(self, tensordict: TensorDictBase) -> TensorDictBase:
        """SLOTS of the present frame, and of the goal image where there is one and the frame is an episode's first."""
        seen: TensorDictBase = self.parser(tensordict)
        fresh = seen.get(keys.SLOT_AGE).squeeze(-1) == 1
        if self.shown_goals and bool(fresh.any()):
            put_goals(self.parser.module.savi, seen, fresh, PlanConfig.looks)
        return seen

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.heads(self.see(tensordict))


class ReactiveActor(Actor):
    """Observation to action by a module that reads PIXELS (n, 3, H, W) or what its `in_keys` say, and remembers nothing
    but its task.
    """

    def __init__(self, module: TensorDictModuleBase, tasks: int = 0) -> None:
        super().__init__(reads=[key for key in module.in_keys if key != keys.TASK], tasks=tasks)
        self.module = module

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.module(tensordict)


class _Choice(nn.Module):
    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, pixels: Tensor, *task: Tensor) -> tuple[Tensor, Tensor]:
        features = self.policy.features(pixels, *task)
        return self.policy.decide(features, *task), features


def latent_actor(policy: Decides, decoder: ActionDecoder) -> Actor:
    """The actor of a policy from frames (n, 3, H, W) to latent actions (n, Z), which a decoder turns into real ones."""
    reads, tasks = observed_keys(policy, keys.PIXELS), policy.tasks
    choose = TensorDictModule(_Choice(policy), in_keys=reads, out_keys=[keys.LATENT_ACTION, keys.FEATURES])
    return ReactiveActor(TensorDictSequential(choose, action_decoder_module(decoder, keys.FEATURES)), tasks)


class ExpertActor(Actor):
    """The scripted expert, which sees the simulator's state: hands on EXPERT_ACTION (n, A)."""

    looks = "never"

    def __init__(self) -> None:
        super().__init__(reads=(keys.EXPERT_ACTION,))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(keys.ACTION, tensordict.get(keys.EXPERT_ACTION))


class PlannedActor(Actor):
    """Executes a plan, PLANNED_ACTIONS (n, T, A), that lies in its memory beside STEP_COUNT (n, 1)."""

    looks: Literal["always", "first", "never"] = "never"

    def __init__(
        self,
        steps: int,
        action_dim: int,
        memory: Sequence[str] = (),
        reads: Sequence[str] = (),
        tasks: int = 0,
        goal: bool = False,
    ) -> None:
        super().__init__((keys.PLANNED_ACTIONS, keys.STEP_COUNT, *memory), reads, tasks, goal)
        self.steps, self.action_dim = steps, action_dim

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        """A plan of zeros at step 0."""
        memory = super().reset(seeds)
        memory[keys.PLANNED_ACTIONS] = torch.zeros(len(seeds), self.steps, self.action_dim)
        memory[keys.STEP_COUNT] = torch.zeros(len(seeds), 1, dtype=torch.long)
        return memory

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The step's action; past the plan's end, its last one."""
        step, plan = tensordict.get(keys.STEP_COUNT), tensordict.get(keys.PLANNED_ACTIONS)
        rows = torch.arange(len(step), device=step.device)
        action = plan[rows, step.squeeze(-1).clamp(max=plan.shape[1] - 1)]
        return tensordict.set(keys.ACTION, action).set(keys.STEP_COUNT, step + 1)


class RandomActor(PlannedActor):
    """Uniform actions in [-1, 1]; an episode's actions depend on its seed alone.

    Examples:
        >>> actor = RandomActor(steps=20, action_dim=4)
        >>> actor(actor.reset([0, 1]))["action"].shape
        torch.Size([2, 4])
    """

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        """Draw all actions of each episode."""
        memory, size = super().reset(seeds), (self.steps, self.action_dim)
        drawn = [np.random.default_rng([seed, RANDOM_STREAM]).uniform(-1, 1, size) for seed in seeds]
        memory[keys.PLANNED_ACTIONS] = torch.from_numpy(np.stack(drawn).astype(np.float32))
        return memory
