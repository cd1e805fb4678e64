"""A policy that is shown a goal image: it acts by it, in the simulator and in imagination, and learns by it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from playslot_rl import keys
from playslot_rl.acting.actor import Actor, ExpertActor, SlotActor, goal_slots
from playslot_rl.acting.agent import ImaginationActor, oracle_actor, playslot_actor
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.acting.episodes import Moment, TaskPool, run_episodes
from playslot_rl.acting.planning import policy_plan
from playslot_rl.api import PlaySlot
from playslot_rl.config import PolicyConfig
from playslot_rl.config.compose import compose
from playslot_rl.config.methods import METHODS, require_told
from playslot_rl.config.plain import to_dict
from playslot_rl.config.planning import PlanConfig
from playslot_rl.config.plugins import call
from playslot_rl.data.demonstrations import label_demonstrations, transitions
from playslot_rl.errors import ConfigError
from playslot_rl.evaluation.success import evaluate
from playslot_rl.play.session import PlaySession
from playslot_rl.play.starts import Start
from playslot_rl.runs import Run
from playslot_rl.studies.success.measure import check_success
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.training.demonstrated import moves
from playslot_rl.world_model import Agent
from tests.methods.told_examples import imagines_by
from tests.recipes.commands import refused, smoke
from tests.training.tiny_stages import videos

SHOWN = ("playslot", "slot_oracle", "slot_bc", "slot_vpt", "lapo_slots")


def of_goals(gain: float = 1.0) -> Agent:
    config = tiny_config(max_steps=3)
    policy = replace(config.model.policy, goal=True, gain=gain)
    return tiny_agent(replace(config, model=replace(config.model, policy=policy))).requires_grad_(False)


@pytest.fixture(scope="module")
def agent() -> Agent:
    return of_goals()


def pictures(count: int, seed: int = 0) -> torch.Tensor:
    draw = torch.Generator().manual_seed(seed)
    return torch.randint(256, (count, 3, 64, 64), dtype=torch.uint8, generator=draw)


@pytest.mark.parametrize("name", ["playslot", "oracle", "belief", "imagination"])
def test_it_acts_by_the_goal_that_its_first_frame_finds(agent: Agent, name: str) -> None:
    goals, frames = pictures(2), pictures(1, seed=1).expand(3, -1, -1, -1)
    make = {
        "playslot": lambda: playslot_actor(agent),
        "oracle": lambda: oracle_actor(agent),
        "belief": lambda: playslot_actor(of_goals(gain=0.5)),
        "imagination": lambda: ImaginationActor(agent, 3),
    }
    actor: Actor = make[name]().eval()
    actor.goals = lambda seeds: goals[[seed % 2 for seed in seeds]]
    loop = ClosedLoop(actor)
    loop.reset([0, 1, 2])
    seen = loop.step(TensorDict({keys.PIXELS: frames}, [3]))
    actions = seen[keys.ACTION]
    torch.testing.assert_close(actions[0], actions[2])
    assert (actions[0] - actions[1]).abs().max() > 1e-4
    if isinstance(actor, SlotActor):
        savi = agent.world_model.savi
        _, state = savi(frames[:1, None] / 255)
        found = seen[keys.GOAL_SLOTS].clone()
        torch.testing.assert_close(found[:1], goal_slots(savi, state, goals[:1], PlanConfig.looks))
        later = loop.step(TensorDict({keys.PIXELS: pictures(2, seed=2)}, [2]), rows=[1, 2])  # one has ended
        assert torch.equal(later[keys.GOAL_SLOTS], found[1:])


def test_imagination_is_towards_the_goal(agent: Agent) -> None:
    imagines_by(agent, keys.GOAL_SLOTS, torch.randn(2, 4, 32, generator=torch.Generator().manual_seed(1)))


def test_who_shows_no_goal_is_told_so(agent: Agent) -> None:
    with pytest.raises(ConfigError, match=r"model\.policy\.goal: got no goal images, expected some"):
        ClosedLoop(playslot_actor(agent)).act(torch.rand(1, 3, 64, 64))


def test_a_frame_is_a_goal_of_the_programming_interface(agent: Agent) -> None:
    model, frame = PlaySlot(agent.world_model, agent), pictures(1, seed=1)[0]
    first = []
    for goal in pictures(2):
        model.reset(goal)
        first.append(model.act(frame))
        model.reset()
        assert np.array_equal(model.act(frame), first[-1]), "the goal stays"
    assert np.abs(first[0] - first[1]).max() > 1e-5
    model.reset(pictures(1)[0].movedim(0, -1).numpy())
    assert np.array_equal(model.act(frame), first[0])
    with pytest.raises(ValueError, match=r"goal: got shape \(2, 3, 64, 64\), expected one image"):
        model.reset(pictures(2))
    with pytest.raises(ValueError, match=r"goal: got an image for a policy that is shown none, expected nothing"):
        PlaySlot.untrained().reset(frame)


def test_who_plays_marks_the_goal(agent: Agent) -> None:
    session = PlaySession(agent.world_model, agent)
    policy, slots = session.drivers["policy"], torch.randn(4, 32, generator=torch.Generator().manual_seed(0))
    session.begin(Start("", np.zeros((64, 64, 3), np.uint8), slots[None]))
    with pytest.raises(ValueError, match="goal: got none, expected a marked moment"):
        policy.choose(session)
    assert session.planner is not None
    session.planner.goal = slots.flip(0)
    torch.testing.assert_close(policy.choose(session), agent.policy(slots, slots.flip(0)))
    torch.testing.assert_close(policy_plan(agent, slots, 2, slots.flip(0))[0, 0], agent.policy(slots, slots.flip(0)))
    assert session.planner.choose(session).shape == agent.world_model.latent_shape


def test_an_evaluation_shows_where_the_expert_ends(agent: Agent, monkeypatch: pytest.MonkeyPatch) -> None:
    """The expert's last frame of the same episode, of whatever actor and protocol."""
    config = tiny_config(max_steps=3)
    shown: dict[int, torch.Tensor] = {}
    reset = Actor.reset

    def noted(self: Actor, seeds: list[int]) -> TensorDict:
        memory = reset(self, seeds)
        if self.shown_goals:
            shown.update(zip(seeds, memory[keys.GOAL_PIXELS], strict=True))
        return memory

    monkeypatch.setattr(Actor, "reset", noted)
    for protocol in ("simulation", "imagination"):
        shown.clear()
        found = evaluate(agent, config, protocol, 2, 0)
        assert sorted(shown) == sorted(found["seeds"])
    last: dict[int, np.ndarray] = {}

    def note(moment: Moment) -> None:
        last.update(zip(moment.episodes, moment.frames, strict=True))

    with TaskPool(config.env, config.render) as pool:
        run_episodes(pool, ExpertActor(), found["seeds"], note, stop=False)
    for i, seed in enumerate(found["seeds"]):
        assert torch.equal(shown[seed], torch.from_numpy(last[i]).movedim(-1, 0))


def test_a_demonstration_ends_in_its_goal(agent: Agent) -> None:
    source = videos(64)
    model = agent.world_model
    source = replace(source, actions=np.zeros((len(source.frames), 4), np.float32))
    slots = torch.arange(len(source.frames), dtype=torch.float32)[:, None, None].expand(-1, *model.slot_shape).numpy()
    ends = [start + length - 1 for start, length in zip(source.starts, source.lengths, strict=True)]
    number = transitions(source).episode.tolist()
    demos = label_demonstrations(model, source, slots)
    assert demos.told is demos.goal is not None
    assert demos.goal[:, 0, 0].tolist() == [ends[i] for i in number]
    config = replace(tiny_config(), model=model.config)
    config = replace(config, behaviour=replace(config.behaviour, trim=0.0))
    seen = moves([(source, slots)] * 2, config, demos.slots.device)
    assert seen.told is not None
    assert seen.told[:, 0, 0].tolist() == [ends[i] for i in number] * 2


def test_others_are_refused_and_old_sizes_are_the_same() -> None:
    config = compose(["preset=smoke", "env=metaworld", "env.task=push", "model.policy.goal=true"])
    for name, method in METHODS.items():
        if name in SHOWN or not method.acts:
            require_told(config, name)
            continue
        with pytest.raises(ConfigError, match=rf"got true with method={name}, expected one .* goal images: playslot"):
            require_told(config, name)
    assert "goal" not in to_dict(PolicyConfig())
    assert to_dict(config.model.policy)["goal"] is True


def test_a_comparison_without_an_expert_who_reaches_them_is_refused() -> None:
    typed = ["preset=smoke", "env=gym", "env.id=FetchReach-v4", "data.demos=x", "env.action_dim=4"]
    config = compose([*typed, "model.policy.goal=true", "methods=playslot"], "compare")
    with pytest.raises(ConfigError, match=r"env\.expert: got nothing with env\.id=FetchReach-v4"):
        check_success(config)


MADE = {
    "one": ("env=button_press", "env.max_steps=3", "collect.expert_steps=3"),
    "two": ("env=metaworld", "env.task=drawer-open+push", "env.max_steps=3", "collect.expert_steps=3"),
}


@pytest.fixture(scope="module", params=MADE)
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, Path]:
    """Demonstrations of a task, or of two, and a world model of them."""
    base = tmp_path_factory.mktemp("goals")
    run, demos = base / "run", base / "demos"
    smoke("collect", *MADE[request.param], "policy=expert", "episodes=7", f"out={demos}")
    smoke("train-slots", *MADE[request.param], f"data.root={demos}", "data.held_out=2", f"out={run}")
    smoke("train-dynamics", f"run={run}")
    return request.param, run, demos


@pytest.mark.integration
@pytest.mark.slow
@pytest.mark.parametrize("method", SHOWN)
def test_commands_from_videos_to_goals(method: str, recorded: tuple[str, Path, Path], tmp_path: Path) -> None:
    (name, run, demos), own, out = recorded, METHODS[method], tmp_path / "run"
    typed = [
        "preset=smoke",
        f"data.root={demos}",
        f"data.demos={demos}",
        "demos=4",
        "data.held_out=2",
        f"out={out}",
        *MADE[name],
    ]
    typed += [f"run={run}", *(["behaviour.labelled_demos=2"] if own.some_labelled else []), "model.policy.goal=true"]
    smoke("train-policy" if method == "playslot" else "train-baseline", *typed, f"method={method}")
    assert Run.open(out).own(own.last.name).sizes[0].policy.goal
    for protocol in ("simulation", *(["imagination", "replay"] if method == "playslot" else [])):
        smoke("evaluate", f"run={out}", "episodes=2", f"protocol={protocol}")
    if method == "playslot":
        assert (out / "report.md").is_file()
    done = smoke("evaluate", f"run={out}", "protocol=actions", f"data.demos={demos}")
    assert "R²" in done.out or "r2" in done.out.lower()
    actor, (goals, frame) = call(own.load.actor, Run(out), torch.device("cpu")), (pictures(2), pictures(1, seed=1))
    actor.goals = lambda seeds: goals[[seed % 2 for seed in seeds]]
    loop = ClosedLoop(actor)
    loop.reset([0, 1, 2])
    actions = loop.step(TensorDict({keys.PIXELS: frame.expand(3, -1, -1, -1)}, [3]))[keys.ACTION]
    assert not torch.equal(actions[0], actions[1])
    torch.testing.assert_close(actions[0], actions[2])
    if name == "one" and method == "playslot":
        refused("export", f"run={out}", f"out={tmp_path / 'new'}", message=r"model\.policy\.goal: got true")
        smoke("plan", f"run={out}", "episodes=2", "planner=cem", "proposal=policy", "goals=ahead", "plan.ahead=5",
              "plan.near=1e-6")  # fmt: skip
