"""The model card: what the policy does, what it was trained on, how well it does, and how to make it again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import yaml

from playslot_rl import keys
from playslot_rl.config import EvaluationConfig, ExperimentConfig
from playslot_rl.sharing.commands import reproduce
from playslot_rl.sharing.config import LICENCE, TAGS, PolicyConfig
from playslot_rl.sharing.source import Result
from playslot_rl.visualization.markdown import table

MARK: Final = "<!-- made by `playslot export`; remove this line to keep your own text -->"
PAPER: Final = (
    "A. Villar-Corrales and S. Behnke, *PlaySlot: Learning Inverse Latent Dynamics for Controllable Object-Centric "
    "Video Prediction and Planning*, ICML 2025"
)
PROTOCOL_NAMES: Final = {"simulation": "in simulation (closed loop)", "imagination": "in imagination (open loop)"}

REFERENCES: Final = {
    "random": "random actions",
    "expert": "scripted expert",
    "slot_oracle": "slot oracle (real actions of all demonstrations)",
}


def is_ours(card: str) -> bool:
    """Whether a card was made here and not edited by hand."""
    return MARK in card


@dataclass(frozen=True)
class CardInput:
    """What a card is made of.

    Attributes:
        name: title.
        policy: config of the model folder.
        experiment: config of the run; None where it is not known.
        task: in words; empty if the task has none.
        action: meaning of the action's numbers; empty if it is not known.
        fps: agent steps a second; None if it is not known.
        results: evaluations of this policy.
        parameters: how many numbers the weights are.
    """

    name: str
    policy: PolicyConfig
    experiment: ExperimentConfig | None
    task: str
    action: str
    fps: int | None
    results: list[Result]
    parameters: int


def make_card(given: CardInput) -> str:
    """The card as Markdown with a YAML header."""
    env = given.policy.env
    header = {
        "license": LICENCE,
        "library_name": "lerobot",
        "pipeline_tag": "robotics",
        "tags": [*TAGS, env.name],
        "model_name": given.name,
    }
    lines = ["---", yaml.safe_dump(header, sort_keys=False, allow_unicode=True).rstrip(), "---", "", MARK, ""]
    lines += [f"# {given.name}", "", *_summary(given), ""]
    for title, part in (
        ("Task", _table(_task(given))),
        ("Data", _table(_data(given))),
        ("Results", _results(given)),
        ("Use it", _use(given)),
        ("Make it again", _reproduce(given)),
        ("Limits", _limits(given)),
        ("References", [f"- {PAPER}.", ""]),
        ("Versions and licence", _versions(given)),
    ):
        lines += [f"## {title}", "", *part]
    return "\n".join(lines).rstrip() + "\n"


def _summary(given: CardInput) -> list[str]:
    return [
        f"A PlaySlot policy for the task `{given.policy.env.name}`: frames are split into object slots, a policy",
        "cloned from videos without action labels chooses a latent action, and a decoder trained on few labels turns",
        f"it into the robot's action. The folder holds the whole agent with its world model: {given.parameters:,}",
        "parameters.",
    ]


def _task(given: CardInput) -> dict[str, str]:
    env = given.policy.env
    side = f"{env.image_size} x {env.image_size}"
    other = "resized by area averaging" if given.policy.resize else "refused"
    return {
        "task": given.task or "not described",
        "camera": f"`{given.policy.camera}`, {side} RGB; frames of another size are {other}",
        "action": f"`{keys.FEATURE_ACTION}`, {env.action_dim} numbers in [-1, 1]"
        + (f": {given.action}" if given.action else ""),
        "agent steps": f"at most {env.max_steps} an episode, each {env.frame_skip} environment steps"
        + (f"; {given.fps} a second" if given.fps else ""),
        "memory": "SAVi's slots are carried from frame to frame: call `reset()` before each episode",
    }


def _data(given: CardInput) -> dict[str, str]:
    source, data = given.policy.source, given.policy.source.get("data", {})
    world = "the one that ships with playslot_rl" if source.get("shipped_world_model") else "trained for this policy"
    recorded = source.get("recorded") or {}
    maker = (
        f"{recorded['policy']}, noise {recorded['noise']:g}, seed {recorded['seed']}" if recorded else "not recorded"
    )
    return {
        "demonstrations": f"videos of {_count(source.get('demos'))}",
        "labels used": f"real actions of {_count(source.get('labelled_demos'))} demonstrations, by the action decoder",
        "demonstrator": maker,
        "data set of the demonstrations": f"fingerprint `{data.get('demonstrations') or 'not recorded'}`",
        "data set of the world model": f"fingerprint `{data.get('world_model') or 'not recorded'}`",
        "world model": world,
        "weights by stage": ", ".join(f"{name} `{mark}`" for name, mark in source.get("fingerprints", {}).items()),
        "training seed": _count(source.get("seed")),
        "commit": f"`{source['commit']}`" if source.get("commit") else "not recorded",
    }


def _count(value: Any) -> str:
    return "not recorded" if value is None else str(value)


def _results(given: CardInput) -> list[str]:
    if not given.results:
        return ["Not evaluated yet. `playslot evaluate`, then `playslot export` again, puts success rates here.", ""]
    rows = []
    for result in given.results:
        steps = "–" if result.mean_steps is None else f"{result.mean_steps:.1f}"
        title = f"this policy, {PROTOCOL_NAMES[result.protocol]}"
        rows.append([title, _share(result.success_rate), _interval(result.ci95), steps, *_played(result)])
    first = given.results[0]
    for name, (rate, ci95) in first.references.items():
        title = REFERENCES.get(name, name.replace("_", " "))
        rows.append([title, _share(rate), _interval(ci95), "–", *_played(first)])
    return [
        table(["", "success", "95 % interval", "mean agent steps to success", "episodes", "seed"], rows),
        "",
        "Held-out episodes, one for each seed; Wilson intervals, which cover the choice of episodes and not that of",
        "the training run. In imagination only the first frame is seen, and the imagined actions are executed without",
        "looking.",
        "",
    ]


def _played(result: Result) -> list[str]:
    return [str(result.episodes), str(result.seed)]


def _share(rate: float) -> str:
    return f"{100 * rate:.0f} %"


def _interval(ends: tuple[float, float]) -> str:
    return f"{100 * ends[0]:.0f} to {100 * ends[1]:.0f} %"


def _use(given: CardInput) -> list[str]:
    evaluation = given.experiment.evaluation if given.experiment else EvaluationConfig()
    evaluate = (
        f"lerobot-eval --policy.path=THIS_FOLDER --env.type=playslot --env.task={given.policy.env.name} "
        f"--eval.n_episodes=10 --seed={evaluation.seed_offset}"
    )
    return [
        "In LeRobot, with `playslot_rl` and `lerobot_policy_playslot` installed; the seed is the first of ours that no",
        "training has seen:",
        "",
        "```bash",
        evaluate,
        "```",
        "",
        "In Python:",
        "",
        "```python",
        "import playslot_rl",
        "",
        'policy = playslot_rl.PlaySlot.from_pretrained("THIS_FOLDER")  # or user/name on the Hub',
        "policy.reset()",
        "action = policy.act(frame)  # for each frame of an episode, uint8 (H, W, 3)",
        "```",
        "",
    ]


def _reproduce(given: CardInput) -> list[str]:
    if given.experiment is None:
        return ["Not recorded: saved from Python. `playslot export` writes the commands.", ""]
    return [
        "```bash",
        *reproduce(given.experiment, given.policy.source, given.results),
        "```",
        "",
        "On one machine a seeded run repeats bit for bit on the CPU; another processor or library rounds differently.",
        "",
    ]


def _limits(given: CardInput) -> list[str]:
    return [
        f"- Trained and tested on frames of `{given.policy.env.name}` from one camera; other cameras, lighting, robots",
        "  or tasks were not tried, and it must not be run on a real robot without somebody at the stop button.",
        "- Success rates are of one training run.",
        "- It cannot be trained further by `lerobot-train`; use `playslot train-policy`.",
        "",
    ]


def _versions(given: CardInput) -> list[str]:
    source = given.policy.source
    rows = {
        "exported with": _numbers(source.get("versions", {})),
        "trained with": _numbers(source.get("trained_with", {})),
        "weights": f"fingerprint `{given.policy.fingerprint}`",
        "licence": "Apache License 2.0, of the weights and of this card",
    }
    return _table(rows)


def _numbers(versions: dict[str, str]) -> str:
    return ", ".join(f"{name} {number or 'not recorded'}" for name, number in versions.items()) or "not recorded"


def _table(rows: dict[str, str]) -> list[str]:
    return [table(("", ""), rows.items()), ""]
