"""LeRobot's policies as actors: a chunk is predicted, so much of it executed, and the next one predicted.

As their `select_action`, whose queues are the memory here.

Shapes: n episodes side by side, F frames, E actions executed of a chunk, A action dim, S proprioception.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from tensordict import TensorDict, TensorDictBase

from playslot_rl import keys
from playslot_rl.acting.actor import Actor, with_present
from playslot_rl.config import EnvConfig
from playslot_rl.frames import normalise
from playslot_rl.methods.lerobot_policy.method import ACTConfig, ChunkConfig, DiffusionConfig
from playslot_rl.methods.lerobot_policy.policy import ChunkPolicy, Observation, chunk_policy
from playslot_rl.runs import Run
from playslot_rl.seeds.draws import derived_seed


class ChunkActor(Actor):
    """Reads PIXELS (n, 3, W, W) and perhaps STATE (n, S); its memory has the last F of them, the actions of the last
    chunk, steps and seeds.
    """

    def __init__(self, policy: ChunkPolicy, image_size: int) -> None:
        memory = (keys.FRAME_HISTORY, keys.PLANNED_ACTIONS, keys.STEP_COUNT, keys.NOISE_SEED)
        reads = (keys.PIXELS, keys.STATE) if policy.state_dim else (keys.PIXELS,)
        super().__init__((*memory, *([keys.STATE_HISTORY] if policy.state_dim else [])), reads, policy.tasks)
        self.policy, self.image_size = policy, image_size

    def reset(self, seeds: Sequence[int]) -> TensorDict:
        memory, n, side = super().reset(seeds), len(seeds), self.image_size
        memory[keys.FRAME_HISTORY] = torch.zeros(n, self.policy.frames, 3, side, side)
        if self.policy.state_dim:
            memory[keys.STATE_HISTORY] = torch.zeros(n, self.policy.frames, self.policy.state_dim)
        memory[keys.PLANNED_ACTIONS] = torch.zeros(n, self.policy.executed, self.policy.statistics.shape[1])
        memory[keys.STEP_COUNT] = torch.zeros(n, 1, dtype=torch.long)
        memory[keys.NOISE_SEED] = torch.tensor([[seed] for seed in seeds], dtype=torch.long)
        return memory

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The chunk's next action; episodes whose chunk is used up predict another."""
        step, states = tensordict.get(keys.STEP_COUNT), None
        frames = with_present(tensordict.get(keys.FRAME_HISTORY), normalise(tensordict.get(keys.PIXELS)), step)
        if self.policy.state_dim:
            states = with_present(tensordict.get(keys.STATE_HISTORY), tensordict.get(keys.STATE).float(), step)
            tensordict.set(keys.STATE_HISTORY, states)
        plan, at = tensordict.get(keys.PLANNED_ACTIONS), (step % self.policy.executed).squeeze(-1)
        due = torch.nonzero(at == 0).squeeze(-1)
        if len(due):
            drawn = zip(tensordict.get(keys.NOISE_SEED)[due, 0].tolist(), step[due, 0].tolist(), strict=True)
            seeds = [derived_seed(seed, number, "noise") for seed, number in drawn]
            task = tensordict.get(keys.TASK)[due] if self.tasks else None
            seen = Observation(frames[due], None if states is None else states[due], task)
            plan = plan.index_copy(0, due, self.policy.plan(seen, seeds))
        action = plan[torch.arange(len(plan), device=plan.device), at]
        return tensordict.update(
            {
                keys.ACTION: action,
                keys.FRAME_HISTORY: frames,
                keys.PLANNED_ACTIONS: plan,
                keys.STEP_COUNT: step + 1,
            }
        )


def _load(name: str, kind: type[ChunkConfig], run: Run, device: torch.device | str = "cpu") -> Actor:
    """The actor of a finished run; a CheckpointError where it is missing or damaged, a ConfigError where Diffusion
    Policy's diffusers is.
    """
    done = run.stage(name)
    own, env = done.group(kind, name), done.group(EnvConfig, "env")
    chunk, state = int(done.meta["chunk"]), int(done.meta.get("state", 0))
    policy = done.restore(lambda: chunk_policy(own, env, chunk, state), "policy", device)
    return ChunkActor(policy, env.image_size)


load_act, load_act_state = partial(_load, "act", ACTConfig), partial(_load, "act_state", ACTConfig)
load_diffusion = partial(_load, "diffusion", DiffusionConfig)
load_diffusion_state = partial(_load, "diffusion_state", DiffusionConfig)
