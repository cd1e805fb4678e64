"""Every method is one actor: a function of observation and memory, whose episodes do not touch each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.actor import Actor, ExpertActor, RandomActor, ReactiveActor, latent_actor
from playslot_rl.acting.agent import ImaginationActor, ReplayActor, oracle_actor, playslot_actor
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.config.compose import compose
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.world_model import Agent, oracle_module

STEPS = 4
FRAMES = torch.randint(256, (STEPS, 3, 3, 64, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))


def agent(initial: str = "learned") -> Agent:
    config = tiny_config()
    savi = replace(config.model.savi, initial=initial)  # type: ignore[arg-type]
    return tiny_agent(replace(config, model=replace(config.model, savi=savi)))


def resnet() -> Actor:
    from playslot_rl.methods.resnet_oracle.network import ResNetPolicy, resnet_actor

    return resnet_actor(ResNetPolicy(compose(["preset=smoke"]).model.policy, 64, 4))


def lapo() -> Actor:
    from playslot_rl.methods.lapo.model import LAPOPolicy
    from playslot_rl.modules.action_decoder import ActionDecoder

    config = compose(["preset=smoke"])
    own = config.baselines.lapo
    return latent_actor(LAPOPolicy(own, 64), ActionDecoder(config.model.action_decoder, own.latent_dim, 4))


def chunks(name: str) -> Actor:
    from playslot_rl.methods.lerobot_policy.actor import ChunkActor
    from playslot_rl.methods.lerobot_policy.policy import chunk_policy

    config = compose(["preset=smoke"])
    own = getattr(config.baselines, name)
    policy = chunk_policy(own, config.env, own.sized(8))
    policy.give(torch.randn(9, 4))
    return ChunkActor(policy, 64)


def caddy(oracle: bool) -> Actor:
    from playslot_rl.methods.caddy.heads import MovesHead, OnFrames, StateHead
    from playslot_rl.methods.caddy.model import CADDY
    from playslot_rl.modules.action_decoder import ActionDecoder

    config = compose(["preset=smoke"])
    encoder, width = CADDY(config.baselines.caddy, 64).encoder, config.baselines.caddy.encoder[-1]
    if oracle:
        return ReactiveActor(oracle_module(OnFrames(encoder, StateHead(width, 4)), keys.PIXELS))
    return latent_actor(OnFrames(encoder, MovesHead(width, 3, 2)), ActionDecoder(config.model.action_decoder, 5, 4))


def dreamer() -> Actor:
    from playslot_rl.methods.dreamer.networks import DreamerActor, DreamerNetworks

    config = compose(["preset=smoke"])
    return DreamerActor(DreamerNetworks(config.baselines.dreamer, config.env))


def sold() -> Actor:
    from playslot_rl.methods.sold.acting import SOLDActor
    from playslot_rl.methods.sold.networks import SOLDNetworks

    config = compose(["preset=smoke"]).baselines.sold
    savi = agent().world_model.savi
    return SOLDActor(savi, SOLDNetworks(config, savi.config.slot_dim, 4, 5).actor, frames=2, action_dim=4)


def performance(seeds: Sequence[int]) -> tuple[torch.Tensor, torch.Tensor]:
    """Videos that hang on their seed alone."""
    drawn = [torch.Generator().manual_seed(seed) for seed in seeds]
    frames = [torch.randint(256, (21, 3, 64, 64), generator=g, dtype=torch.uint8) for g in drawn]
    return torch.stack(frames), torch.zeros(len(seeds), 20, 4)


ACTORS: dict[str, Callable[[], Actor]] = {
    "playslot": lambda: playslot_actor(agent()),
    "imagination": lambda: ImaginationActor(agent(), STEPS),
    "replay": lambda: ReplayActor(agent(), performance),
    "slot_oracle": lambda: oracle_actor(agent()),
    "resnet_oracle": resnet,
    "act": lambda: chunks("act"),
    "diffusion": lambda: chunks("diffusion"),
    "lapo": lapo,
    "caddy_policy": lambda: caddy(oracle=False),
    "caddy_oracle": lambda: caddy(oracle=True),
    "dreamer": dreamer,
    "sold": sold,
    "random": lambda: RandomActor(STEPS, 4),
    "expert": ExpertActor,
}


def play(actor: Actor, seeds: Sequence[int], rows: Sequence[int]) -> list[Tensor]:
    """Actions of the episodes in `rows`, which are those of `FRAMES`."""
    loop = ClosedLoop(actor)
    loop.reset(seeds)
    expert = torch.linspace(-1, 1, 12).view(3, 4)
    return [
        loop.step(TensorDict({keys.PIXELS: frames[rows], keys.EXPERT_ACTION: expert[rows]}, [len(rows)]))[keys.ACTION]
        for frames in FRAMES
    ]


@pytest.mark.integration
@pytest.mark.parametrize("name", ACTORS)
def test_an_actor_is_a_function_of_its_inputs_and_its_episodes_are_apart(name: str) -> None:
    torch.manual_seed(0)
    actor = ACTORS[name]()
    actor.eval()
    memory = actor.reset([5, 6, 7])
    assert memory.batch_size == torch.Size([3])
    assert set(memory.keys()) == set(actor.memory_keys)
    together = play(actor, [5, 6, 7], [0, 1, 2])
    assert all(action.shape == (3, 4) for action in together)
    torch.rand(5)  # the global generator is none of its business
    for first, second in zip(together, play(actor, [5, 6, 7], [0, 1, 2]), strict=True):
        assert torch.equal(first, second), "it forgets at a reset, and repeats itself"
    for whole, one in zip(together, play(actor, [6], [1]), strict=True):
        torch.testing.assert_close(whole[1:2], one, atol=1e-5, rtol=1e-4)


def test_the_memory_is_what_the_module_reads_and_writes() -> None:
    actor = playslot_actor(agent())
    memory = actor.reset([1, 2])
    assert set(memory.keys()) == {keys.SLOT_STATE, keys.SLOT_AGE}
    out = actor(memory.clone().set(keys.PIXELS, torch.zeros(2, 3, 64, 64, dtype=torch.uint8)))
    assert out[keys.ACTION].shape == (2, 4)
    assert out[keys.SLOT_AGE].flatten().tolist() == [1, 1]
    assert not torch.equal(out[keys.SLOT_STATE], memory[keys.SLOT_STATE])


@pytest.mark.parametrize("initial", ["learned", "gaussian"])
@pytest.mark.parametrize("oracle", [False, True])
def test_the_agent_acts_as_its_modules_called_by_hand_also_when_episodes_end(initial: str, oracle: bool) -> None:
    model = agent(initial)
    loop = ClosedLoop(oracle_actor(model) if oracle else playslot_actor(model))
    loop.reset([5, 6, 7])
    generator, state = torch.Generator().manual_seed(5), None
    for step, rows in enumerate([[0, 1, 2], [0, 1, 2], [0, 2], [2]]):
        pixels = FRAMES[step][rows]
        acted = loop.step(TensorDict({keys.PIXELS: pixels}, [len(rows)]), rows)[keys.ACTION]
        with torch.no_grad():
            begun = None if state is None else state[rows]
            slots, after = model.world_model.savi(pixels[:, None] / 255, begun, generator=generator)
            state = after if state is None else state.index_copy(0, torch.tensor(rows), after)
            if oracle:
                assert model.oracle is not None
                expected = model.oracle(slots[:, 0]).clamp(-1, 1)
            else:
                expected = model.action_decoder(model.policy(slots[:, 0]))
        torch.testing.assert_close(acted, expected, atol=1e-6, rtol=1e-5)


def test_an_agent_without_an_oracle_has_no_oracle_actor() -> None:
    model = agent()
    model.oracle = None
    with pytest.raises(ValueError, match="without a slot oracle"):
        oracle_actor(model)
