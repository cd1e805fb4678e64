"""The model card: what the policy does, what it was trained on, how well it does, and the commands that use it and make
it again (`playslot_rl.sharing.commands`).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any, Final

import yaml

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig
from playslot_rl.data.action_limits import said
from playslot_rl.envs import ENVIRONMENTS, RECORDED, task_metadata
from playslot_rl.sharing.commands import Result, places, rate_words, reproduce, use
from playslot_rl.sharing.folder import LICENCE, TAGS, SharedPolicyConfig, shared_modules
from playslot_rl.visualization.document import table

if TYPE_CHECKING:
    from playslot_rl.world_model import Agent


MARK: Final = "<!-- made by `playslot export`; remove this line to keep your own text -->"
"""A card with this line was made here and not edited by hand."""
MEASURED: Final = """\
Held-out episodes, one for each seed; Wilson intervals, which cover the choice of episodes and not that of
the training run. In imagination only the first frame is seen, and the imagined actions are executed without
looking."""
REPEATS: Final = (
    "On one machine a seeded run repeats bit for bit on the CPU; another processor or library rounds differently."
)
CLOCKED: Final = (
    "The steps of this training followed the clock (`playslot adopt`): these commands train those that were planned, "
    "with another outcome."
)
PROTOCOL_NAMES: Final = {"simulation": "in simulation (closed loop)", "imagination": "in imagination (open loop)"}
UNKNOWN: Final = "not recorded"
SHOWN: Final = 5  # tasks of a data set
REFERENCES: Final = {
    "random": "random actions",
    "expert": "scripted expert",
    "slot_oracle": "slot oracle (real actions of all demonstrations)",
}


def make_card(
    name: str,
    policy: SharedPolicyConfig,
    agent: Agent,
    experiment: ExperimentConfig | None = None,
    results: Sequence[Result] = (),
    world: ExperimentConfig | None = None,
) -> str:
    """The card as Markdown with a YAML header: `card.md`, filled in; `world` is the config of the world model's run,
    where that is another one than the policy's.
    """
    env = policy.env
    header = {
        "license": LICENCE,
        "library_name": "lerobot",
        "pipeline_tag": "robotics",
        "tags": [*TAGS, env.full_name],
        "model_name": name,
    }
    parameters = sum(p.numel() for part in shared_modules(agent).values() for p in part.parameters())
    commands = "Not recorded: saved from Python. `playslot export` writes the commands."
    if experiment:
        lines = "\n".join(reproduce(experiment, policy.source, results, world))
        repeats = CLOCKED if policy.source.get("clocked") else REPEATS
        commands = f"{places(experiment, policy.source, world)}```bash\n{lines}\n```\n\n{repeats}"
    versions = {
        "exported with": _numbers(policy.source.get("versions", {})),
        "trained with": _numbers(policy.source.get("trained_with", {})),
        "weights": f"fingerprint `{policy.fingerprint}`",
        "licence": "Apache License 2.0, of the weights and of this card",
    }
    return Template(Path(__file__).with_name("card.md").read_text()).substitute(
        front=front_matter(header, MARK),
        name=name,
        env=env.full_name,
        parameters=f"{parameters:,}",
        task=facts_table(_task(policy)),
        data=facts_table(_data(policy.source)),
        results=_results(results),
        use=use(policy, experiment),
        told=f"task={json.dumps(policy.told[0], ensure_ascii=False)}" if policy.told else "",
        frames=f"for each frame of an episode, uint8 (H, W, 3); {rate_words(policy)}",
        commands=commands,
        versions=facts_table(versions),
    )


def front_matter(header: dict[str, Any], mark: str) -> str:
    """First lines of a card: what the Hub reads, and the mark by which a card made here is known."""
    return f"---\n{yaml.safe_dump(header, sort_keys=False, allow_unicode=True)}---\n\n{mark}"


def facts_table(rows: dict[str, str]) -> str:
    return table(("", ""), rows.items())


def _task(policy: SharedPolicyConfig) -> dict[str, str]:
    env, words, action, rate = policy.env.every(policy.stride), "", "", ""
    if env.name in ENVIRONMENTS:
        from playslot_rl.envs.lerobot import frames_a_second

        described = task_metadata(env)
        words, action = str(described.get("task", "")), str(described.get("action", ""))
        rate = f", each {env.frame_skip} environment steps; {frames_a_second(env)} a second"
    other = "resized by area averaging" if policy.resize else "refused"
    side = f"{env.image_size} x {env.image_size}"
    numbers = f"{env.action_dim} numbers in [-1, 1]"
    if policy.actions:
        numbers = f"{env.action_dim} numbers, in the units of the data set: {said(policy.actions)}"
    tasks = policy.source.get("tasks", [])
    others = f" and {len(tasks) - SHOWN} others" if len(tasks) > SHOWN else ""
    steps = {} if env.name in RECORDED else {"agent steps": f"at most {env.max_steps} an episode{rate}"}
    told = (
        {"told": "which of these, by `reset(task=...)`, or by LeRobot's `task` in these words"} if policy.told else {}
    )
    return {
        "task": "; ".join(policy.told) or words or "; ".join(tasks[:SHOWN]) + others or "not described",
        **told,
        "camera": f"`{policy.camera}`, {side} RGB; frames of another size are {other}",
        "frames": rate_words(policy),
        "action": f"`{keys.FEATURE_ACTION}`, {numbers}" + (f": {action}" if action else ""),
        **steps,
        "memory": "SAVi's slots are carried from frame to frame: call `reset()` before each episode",
    }


def _data(source: dict[str, Any]) -> dict[str, str]:
    data = source.get("data", {})
    world = "the one that ships with playslot_rl" if source.get("shipped_world_model") else "trained for this policy"
    recorded = source.get("recorded") or {}
    maker = f"{recorded['policy']}, noise {recorded['noise']:g}, seed {recorded['seed']}" if recorded else UNKNOWN
    demos, labels, seed = (
        UNKNOWN if source.get(key) is None else str(source[key]) for key in ("demos", "labelled_demos", "seed")
    )
    return {
        "demonstrations": f"videos of {demos}",
        "labels used": f"real actions of {labels} demonstrations, by the action decoder",
        "demonstrator": maker,
        "data set of the demonstrations": f"fingerprint `{data.get('demonstrations') or UNKNOWN}`",
        "data set of the world model": f"fingerprint `{data.get('world_model') or UNKNOWN}`",
        "world model": world,
        "weights by stage": ", ".join(f"{name} `{mark}`" for name, mark in source.get("fingerprints", {}).items()),
        "training seed": seed,
        "commit": f"`{source['commit']}`" if source.get("commit") else UNKNOWN,
    }


def _results(results: Sequence[Result]) -> str:
    if not results:
        return "Not evaluated yet. `playslot evaluate`, then `playslot export` again, puts success rates here."
    first = results[0]
    measured = [
        (f"this policy, {PROTOCOL_NAMES[own.protocol]}", own.success_rate, own.ci95, own.mean_steps, own)
        for own in results
    ]
    measured += [
        (REFERENCES.get(name, name.replace("_", " ")), rate, ci95, None, first)
        for name, (rate, ci95) in first.references.items()
    ]
    rows = []
    for title, rate, (low, high), steps, of in measured:
        mean = "–" if steps is None else f"{steps:.1f}"
        interval = f"{100 * low:.0f} to {100 * high:.0f} %"
        rows.append([title, f"{100 * rate:.0f} %", interval, mean, str(of.episodes), str(of.seed)])
    titles = ["", "success", "95 % interval", "mean agent steps to success", "episodes", "seed"]
    return f"{table(titles, rows)}\n\n{MEASURED}"


def _numbers(versions: dict[str, str]) -> str:
    return ", ".join(f"{name} {number or UNKNOWN}" for name, number in versions.items()) or UNKNOWN
