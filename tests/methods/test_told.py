"""A policy of several tasks is told which: it acts by it, in the simulator and in imagination, and learns by it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from playslot_rl import PlaySlot, keys
from playslot_rl.acting.agent import ImaginationActor, oracle_actor, playslot_actor
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.acting.episodes import Outcome
from playslot_rl.config import BehaviourStageConfig, EnvConfig, OptimConfig, PolicyConfig, StageConfig
from playslot_rl.config.compose import compose
from playslot_rl.config.metaworld import SETS
from playslot_rl.config.methods import METHODS, cloning_methods
from playslot_rl.config.plugins import call
from playslot_rl.data.action_limits import ActionLimits
from playslot_rl.data.agreement import say_once
from playslot_rl.data.demonstrations import Demonstrations, transitions
from playslot_rl.data.tasks import require_tasks, say_missing, say_untaught, told_tasks
from playslot_rl.data.views import concatenate, drawn_demonstrations, episode_range
from playslot_rl.envs import task_config
from playslot_rl.errors import ConfigError, DataError
from playslot_rl.evaluation.success import summary
from playslot_rl.losses.behaviour import BehaviourLoss
from playslot_rl.methods.caddy.heads import StateHead
from playslot_rl.methods.frozen_encoder.network import CodePolicy
from playslot_rl.methods.lapo.method import LAPOConfig
from playslot_rl.methods.lapo.model import LAPOPolicy
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.play.session import PlaySession
from playslot_rl.play.starts import Start
from playslot_rl.runs import Run
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.training import record
from playslot_rl.training.fit import Part, fit
from playslot_rl.training.stage_behaviour import CloneStage, DecoderStage, FinetuneStage
from playslot_rl.training.stage_regression import PairedInputs, RegressionStage, TensorInputs
from playslot_rl.world_model import Agent
from tests.methods.told_examples import imagines_by
from tests.recipes.commands import instead, refused, smoke
from tests.training.tiny_stages import videos

MT10 = SETS["MT10"]
SIZES = PolicyConfig(dim=16, layers=1, heads=2, head_dim=8, mlp_dim=16)
MADE = ("env=metaworld", "env.task=MT10", "env.max_steps=3", "collect.random_steps=3", "collect.expert_steps=3")


@pytest.fixture(scope="module")
def agent() -> Agent:
    config = tiny_config()
    env = replace(task_config("metaworld/MT10"), max_steps=6)
    return tiny_agent(replace(config, env=env))


@torch.no_grad()
def test_it_acts_by_the_task_of_the_episodes_seed(agent: Agent) -> None:
    frames = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0)).expand(4, -1, -1, -1)
    for actor in (playslot_actor(agent), oracle_actor(agent), ImaginationActor(agent, 6)):
        loop = ClosedLoop(actor.eval())
        loop.reset([10, 3, 1_000_000_013, 5])
        seen = loop.step(TensorDict({keys.PIXELS: frames}, [4]))
        actions = seen[keys.ACTION]
        assert seen[keys.TASK].flatten().tolist() == [0, 3, 3, 5]
        torch.testing.assert_close(actions[1], actions[2])
        assert (actions[1] - actions[0]).abs().max() > 1e-4
        later = loop.step(TensorDict({keys.PIXELS: frames[:2]}, [2]), rows=[1, 3])  # two of them have ended
        assert later[keys.TASK].flatten().tolist() == [3, 5]


def test_imagination_is_of_the_task(agent: Agent) -> None:
    imagines_by(agent, keys.TASK, torch.tensor([[2], [7]]))


def test_reset_says_what_to_do(agent: Agent) -> None:
    model, env = PlaySlot(agent.world_model, agent), agent.world_model.env
    frame = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(0))
    with pytest.raises(
        ConfigError, match=r"act: got a policy of several tasks, expected to be told which: PlaySlot\.reset"
    ):
        model.act(frame)
    expected = ClosedLoop(playslot_actor(agent).eval(), 64)
    expected.reset(range(10))
    actions = expected.act(frame.expand(10, -1, -1, -1)).numpy()
    for number, (name, sentence) in enumerate(zip(env.tasks, env.sentences, strict=True)):
        for said in (name, sentence, None):  # once told, it stays
            model.reset(task=said)
            np.testing.assert_allclose(model.act(frame), actions[number], atol=1e-6)
    with pytest.raises(
        ValueError, match=r"task: got 'reac', expected one of 10: reach, push, .*; did you mean reach\?"
    ):
        model.reset(task="reac")
    with pytest.raises(ValueError, match=r"task: got 'reach' for a policy that is told none, expected nothing"):
        PlaySlot.untrained().reset(task="reach")


def test_who_plays_hands_over_to_the_policy_of_a_task_or_plans(agent: Agent) -> None:
    session = PlaySession(agent.world_model, agent)
    assert list(session.drivers) == [*(f"policy: {task}" for task in MT10), "planner"]
    assert session.planner is not None
    session.begin(Start("", np.zeros((64, 64, 3), np.uint8), torch.randn(1, 4, 32)))
    slots = session.slots[None]
    for number in (2, 7):
        driver = session.drivers[f"policy: {MT10[number]}"]
        torch.testing.assert_close(driver.choose(session), agent.policy(slots, torch.tensor([[number]]))[0])
    assert session.drive("policy: push").label == "latent policy: push"
    session.planner.aim(session)
    assert session.planner.choose(session).shape == agent.world_model.latent_shape


@pytest.mark.parametrize(("by", "noise", "most"), [("task", 0.0, 0.05), ("goal", 0.05, 0.1)])
def test_policy_decoder_and_oracle_learn_what_the_slots_do_not_say(
    by: str, noise: float, most: float, tmp_path: Path
) -> None:
    """The same slots in two tasks, or with two goals, the opposite to do for each: untold, half of it stays unexplained
    at best.
    """
    draw = torch.Generator().manual_seed(0)
    slots, which = torch.randn(20, 3, 16, generator=draw).repeat(2, 1, 1), torch.arange(2).repeat_interleave(20)
    said = which[:, None] if by == "task" else torch.randn(2, 3, 16, generator=draw)[which]
    actions = (1.0 - 2.0 * which[:, None]) * torch.tensor([[0.5, -0.3]])
    demos = Demonstrations(
        slots, slots + 0.01, torch.cat((actions, actions), 1), actions, torch.arange(40) // 10, torch.arange(40) % 10,
        torch.full((4,), 10),
    )  # fmt: skip
    own = BehaviourStageConfig(
        steps=150, batch_size=20, labelled_demos=4, decoder_inputs="policy", validate_every=150, whiten=False,
        optim=OptimConfig(lr=5e-3, warmup_steps=0), slot_noise=noise,
    )  # fmt: skip
    left = {}
    for shown in (replace(demos, **{by: said}), demos):
        torch.manual_seed(0)
        told = [] if shown.told is None else [shown.told]
        sizes, tasks = replace(SIZES, goal=by == "goal" and bool(told)), 2 * len(told)
        policy = LatentPolicy(sizes, 16, 4, tasks=tasks)
        oracle = LatentPolicy(sizes, 16, 2, acts=True, tasks=tasks)
        assert policy.tasks == (0 if by == "goal" else tasks)
        clone = CloneStage(policy, oracle, shown, own, shown)
        fit(Part("policy", clone, own), tmp_path / str(tasks), seed=0, device=torch.device("cpu"))
        measured = clone.validate(0)
        left[tasks] = [measured[name] for name in ("unexplained_parsed", "unexplained_imagined", "oracle_unexplained")]
        assert measured["oracle_unexplained_held_out"] == measured["oracle_unexplained"]
        decoder = ActionDecoder(tiny_config().model.action_decoder, 4, 2, 16)
        heard = DecoderStage(decoder, policy, shown, own).inputs.plain(torch.arange(40))[0]
        torch.testing.assert_close(heard[:40], policy(slots, *told))
        both = FinetuneStage(clone.stages["policy"], decoder, shown, own)
        acted = decoder(policy(slots, *told)).detach()
        expected = (acted - shown.actions).square().sum() / (shown.actions - shown.actions.mean(0)).square().sum()
        assert both.validate(0)["unexplained"] == pytest.approx(float(expected), rel=1e-3)
    assert max(left[2]) < most
    assert min(left[0]) > 0.9


FRAMES = {
    "lapo": lambda tasks: LAPOPolicy(LAPOConfig(channels=(4, 8), hidden=16, groups=2, code_dim=1), 16, tasks),
    "caddy": lambda tasks: StateHead(3, 2, tasks=tasks),
    "autoencoder": lambda tasks: CodePolicy(nn.Conv2d(3, 4, 4, 4), SIZES, (4, 2), 16, 2, tasks),
}


@pytest.mark.parametrize("method", FRAMES)
def test_a_policy_of_frames_learns_what_they_do_not_say(method: str, tmp_path: Path) -> None:
    """As above: the same frames in two tasks."""
    frames = torch.rand(20, 3, 16, 16, generator=torch.Generator().manual_seed(0)).repeat(2, 1, 1, 1)
    task = torch.arange(2).repeat_interleave(20)[:, None]
    own = StageConfig(steps=150, batch_size=20, validate_every=150, optim=OptimConfig(lr=5e-3, warmup_steps=0))
    left = []
    for tasks in (2, 0):
        torch.manual_seed(0)
        criterion = BehaviourLoss(FRAMES[method](tasks))
        criterion.set_keys(observation=keys.PIXELS)
        seen = PairedInputs.told(TensorInputs(frames), task if tasks else None)
        stage = RegressionStage("policy", criterion, seen, (1.0 - 2.0 * task) * torch.tensor([[0.5, -0.3]]), 20)
        fit(Part("policy", stage, own), tmp_path / str(tasks), seed=0, device=torch.device("cpu"))
        left.append(stage.validate(0)["unexplained"])
    assert left[0] < 0.05
    assert left[1] > 0.9


def test_who_clones_several_tasks_untold_is_told_so(capsys: pytest.CaptureFixture[str]) -> None:
    source = replace(videos(32), name="kitchen", tasks=np.array(["Wash up."] * 3 + ["Cook."] * 2 + [""]))
    require_tasks(source, EnvConfig())
    told = task_config("metaworld/MT10")
    require_tasks(replace(source, tasks=np.array(told.sentences[:6])), told)
    require_tasks(episode_range(source, 3, 6), EnvConfig())  # one, and a silent episode
    said = capsys.readouterr().err
    assert said.startswith("note: kitchen: got demonstrations of 2 tasks ('Cook.', 'Wash up.', ...)")
    assert said.count("\n") == 1
    assert "env.task" not in said
    for tasks, cure in (
        (["Wash up.", "Cook."] * 3, "tell it which by 'env.task=Cook.+Wash up.' from train-slots on, or train on"),
        (["Wash up.", "Cook."] * 2 + ["", ""], "train on those of one"),  # what is not named cannot be typed
        (["Wash up.", "Cook.", "Mix A + B."] * 2, "train on those of one"),
    ):
        say_once.cache_clear()
        require_tasks(replace(source, tasks=np.array(tasks)), EnvConfig(name="video"))
        assert f"not told apart: {cure}" in capsys.readouterr().err


def test_tasks_without_a_label_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    env = task_config("metaworld/MT10")
    source = replace(videos(32), name="kitchen", tasks=np.array([*env.sentences[:5], env.sentences[0]]))
    say_untaught(source, env, None)
    said = capsys.readouterr().err
    assert said.startswith(f"note: kitchen: got no labelled demonstration of {env.sentences[5]!r} and 4 others of")
    say_untaught(source, env, 2)
    assert f"demonstration of the first 2 of {env.sentences[2]!r} and 7 others of" in capsys.readouterr().err
    say_untaught(source, task_config("metaworld/" + "+".join(env.tasks[:5])), 5)
    say_untaught(source, task_config("metaworld/push"), 1)
    assert not capsys.readouterr().err


def test_a_demonstration_is_of_the_task_that_the_set_says(capsys: pytest.CaptureFixture[str]) -> None:
    env = task_config("metaworld/MT10")
    said = np.array([env.sentences[i] for i in (4, 0, 9, 4, 2, 1)])
    source = replace(videos(32), tasks=said)

    def told(of: object) -> list[int]:
        found = told_tasks(of, transitions(of), env)  # type: ignore[arg-type]
        assert found is not None
        return found.flatten().tolist()[::6]

    assert told(source) == [4, 0, 9, 4, 2, 1]
    assert told(episode_range(source, 1, 3)) == [0, 9]
    assert told(concatenate([source, episode_range(source, 2, 3)])) == [4, 0, 9, 4, 2, 1, 9]
    drawn = drawn_demonstrations(source, 3)
    assert [env.sentences[i] for i in told(drawn)] == drawn.tasks.tolist()  # type: ignore[union-attr]
    assert told_tasks(source, transitions(source), EnvConfig()) is None
    alone = replace(source, tasks=np.array(["Pull the drawer open."] * 3 + ["My own words."] * 3))
    assert told_tasks(alone, transitions(alone), task_config("metaworld/drawer-open")) is None
    with pytest.raises(DataError, match=r"got demonstrations of 'Pull the drawer open\.', expected the tasks of"):
        told_tasks(alone, transitions(alone), task_config("metaworld/push"))
    for tasks in (None, np.array([*said[:5], "Dance."])):
        with pytest.raises(DataError, match=r"got demonstrations of '(nothing|Dance\.)', expected the tasks of"):
            told(replace(source, tasks=tasks))
    robot = replace(source, tasks=np.array(["Open it.", "Close it."] * 3))
    capsys.readouterr()
    three = EnvConfig(name="video", task="Open it.+Close it.+Lift it.")
    for unlabelled in (True, False):
        say_missing(robot, EnvConfig(name="video", task="Open it.+Close it."), unlabelled)
        say_missing(robot, env, unlabelled)
    say_missing(robot, three, videos=True)
    assert not capsys.readouterr().err
    say_missing(robot, three, videos=False)
    assert "got no episode of 'Lift it.': is env.task=Open it.+Close it.+Lift it. as meant?" in capsys.readouterr().err
    say_missing(robot, EnvConfig(name="video", task="Open it.+Shut it."), videos=True)
    assert "got no episode of 'Shut it.', but some of 'Close it.': is env.task=" in capsys.readouterr().err
    with pytest.raises(
        DataError, match=r"of 'Close it\.', expected .* leave its episodes out; none are of 'close it\.'"
    ):
        require_tasks(robot, EnvConfig(name="video", task="close it.+Open it."))


@pytest.mark.parametrize("method", ["act", "lapo", "playslot"])
def test_every_method_refuses_other_tasks_and_is_told_what_it_clones(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = replace(videos(32), name=f"{method}s", tasks=np.array(["Pull the drawer open."] * 5 + ["Dance."]))
    found = replace(found, limits=ActionLimits(("x", "y"), *[np.zeros(2, np.float32)] * 4))
    monkeypatch.setattr(record, "open_videos", lambda *_: found)
    typed = ["preset=smoke", "env=metaworld", f"method={method}", "data.demos=x", "data.held_out=0", "demos=6"]
    stage = METHODS[method].last
    with pytest.raises(DataError, match=r"got demonstrations of 'Pull the drawer open\.', expected the tasks of"):
        record.StageRecord(stage, tmp_path, compose([*typed, "env.task=push"])).demos  # noqa: B018
    say_once.cache_clear()
    stride = f"data.stride={2 + len(method)}"
    assert record.StageRecord(stage, tmp_path, compose([*typed, "env.task=drawer-open", stride])).demos
    said = capsys.readouterr().err
    assert f"note: {method}s: got demonstrations of 2 tasks ('Dance.', 'Pull the drawer open.', ...)" in said
    assert f"note: {stride}: actions are the mean of so many" in said


def test_success_is_told_by_task() -> None:
    env = task_config("metaworld/MT10")
    episodes = [
        Outcome(seed, solved, 5 if solved else None, 0) for seed, solved in ((20, True), (30, False), (4, True))
    ]
    found = summary(episodes, env)
    assert found["success_rate"] == pytest.approx(2 / 3)
    assert {name: (row["episodes"], row["success_rate"]) for name, row in found["per_task"].items()} == {
        "reach": (2, 0.5), "drawer-open": (1, 1.0),
    }  # fmt: skip
    assert "per_task" not in summary(episodes, EnvConfig())


@pytest.mark.integration
@pytest.mark.slow
def test_commands_from_videos_to_success_of_each_task(tmp_path: Path) -> None:
    run, demos, sentences = tmp_path / "run", tmp_path / "demos", task_config("metaworld/MT10").sentences
    every = ("demos=10", "behaviour.labelled_demos=10")  # one of each task: of others without a label a note says so
    smoke("collect", *MADE, "policy=expert", "episodes=11", f"out={demos}")
    smoke("train-slots", *MADE, f"data.root={demos}", f"out={run}")
    smoke("train-dynamics", f"run={run}")
    smoke("train-policy", f"run={run}", f"data.demos={demos}", *every)
    done = smoke("evaluate", f"run={run}", "episodes=10", "protocol=imagination", "evaluation.references=false")
    assert all(f"{task}:" in done.out for task in MT10)
    assert "| peg-insert-side | 0 % |" in (run / "report.md").read_text()
    refused("evaluate", f"run={run}", "env.task=drawer-open", message=r"env\.task: got drawer-open, expected MT10")
    refused("plan", f"run={run}", message="got 10 tasks, expected one")
    smoke("export", f"run={run}", f"out={tmp_path / 'new'}")
    assert f'policy.reset(task="{sentences[0]}")' in (tmp_path / "new" / "README.md").read_text()
    refused("train-policy", f"run={run}", f"out={tmp_path / 'one'}", "env.task=push", f"data.demos={demos}",
            message=r"got demonstrations of '.*', expected the tasks of env\.task=push alone")  # fmt: skip
    pushes, one = tmp_path / "pushes", tmp_path / "pushing"
    smoke("collect", *instead(MADE, "env.task=push"), "policy=expert", "episodes=6", f"out={pushes}")
    smoke("train-policy", f"run={run}", f"out={one}", "env.task=push", f"data.demos={pushes}", "demos=5",
          "behaviour.labelled_demos=3")  # fmt: skip
    assert "push:" not in smoke("evaluate", f"run={one}", "episodes=2", "evaluation.references=false").out


TWO = ("env=metaworld", "env.task=drawer-open+push", "env.max_steps=3", "collect.expert_steps=3")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Demonstrations of two tasks, and a world model of them."""
    base = tmp_path_factory.mktemp("told")
    run, demos = base / "run", base / "demos"
    smoke("collect", *TWO, "policy=expert", "episodes=5", f"out={demos}")
    smoke("train-slots", *TWO, f"data.root={demos}", f"out={run}")
    smoke("train-dynamics", f"run={run}")
    return run, demos


@pytest.mark.integration
@pytest.mark.slow
@pytest.mark.parametrize("method", cloning_methods())
def test_every_method_that_clones_is_told(method: str, recorded: tuple[Path, Path], tmp_path: Path) -> None:
    """Trained, loaded and evaluated by commands, it does not act alike on one frame in two tasks."""
    (run, demos), own, out = recorded, METHODS[method], tmp_path / "run"
    typed = ["preset=smoke", f"data.root={demos}", f"data.demos={demos}", "demos=4", f"out={out}"]
    typed += [*TWO, *(["behaviour.labelled_demos=2"] if own.some_labelled else [])]
    if own.slots:
        typed += [f"run={run}"]
    smoke("train-policy" if method == "playslot" else "train-baseline", *typed, f"method={method}")
    said = smoke("evaluate", f"run={out}", "episodes=2", "evaluation.references=false").out
    assert "drawer-open:" in said
    assert "push:" in said
    actor = call(own.load.actor, Run(out), torch.device("cpu"))
    frames, state = torch.rand(1, 3, 64, 64).expand(3, -1, -1, -1), torch.rand(1, 4).expand(3, -1)
    loop = ClosedLoop(actor)
    loop.reset([0, 1, 2])
    torch.manual_seed(0)
    actions = loop.step(TensorDict({keys.PIXELS: frames, keys.STATE: state}, [3]))[keys.ACTION]
    assert not torch.equal(actions[0], actions[1])
    if "diffusion" not in method:  # whose noise is another of each seed
        torch.testing.assert_close(actions[0], actions[2])


def test_methods_that_are_told_nothing_are_refused(tmp_path: Path) -> None:
    assert [name for name, method in METHODS.items() if method.told] == cloning_methods()
    able = "playslot, slot_oracle, resnet_oracle, slot_bc"
    refused("train-baseline", *MADE, "method=dreamer", f"out={tmp_path / 'dreamer'}",
            message=f"got method=dreamer, expected one that is told .*: {able}")  # fmt: skip
