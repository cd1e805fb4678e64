"""The model card: what the policy does, what it was trained on, how well it does, and the commands that make it again
from its run's config, never from a folder of this machine.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any, Final

import yaml

from playslot_rl import keys
from playslot_rl.config import EvaluationConfig, ExperimentConfig, to_dict
from playslot_rl.config.compose import compose
from playslot_rl.config.plain import flatten
from playslot_rl.config.roles import keys_of
from playslot_rl.envs import ENVIRONMENTS, task_metadata
from playslot_rl.sharing.folder import LICENCE, TAGS, SharedPolicyConfig, shared_modules
from playslot_rl.visualization.document import table

if TYPE_CHECKING:
    from playslot_rl.world_model import Agent


RUN: Final = "runs/again"
WORLD: Final = "runs/world"
GROUPS: Final = ("env", "render", "collect", "model", "slots", "dynamics", "behaviour", "evaluation")
"""Parts of a config that a result depends on; intervals of logging and the like do no harm in between."""
BEHAVIOUR: Final = ("env", "render", "collect", "model.policy", "model.action_decoder", "behaviour", "evaluation")
"""Those a policy on the shipped world model depends on."""


@dataclass(frozen=True)
class Result:
    """A measured success rate.

    Attributes:
        protocol: `simulation` or `imagination`.
        episodes: how many, one for each seed.
        seed: block of evaluation seeds.
        success_rate: 0 to 1.
        ci95: Wilson's interval.
        mean_steps: agent steps to the first success, of the episodes that had one; None without any.
        references: success rate and interval of other policies in simulation, on the same seeds, by name.
    """

    protocol: str
    episodes: int
    seed: int
    success_rate: float
    ci95: tuple[float, float]
    mean_steps: float | None
    references: dict[str, tuple[float, tuple[float, float]]]


def reproduce(config: ExperimentConfig, source: Mapping[str, Any], results: Sequence[Result]) -> list[str]:
    """Command lines from nothing to the evaluated policy.

    Args:
        config: of the run.
        source: see `playslot_rl.sharing.run.read_source`.
        results: what was measured of it.
    """
    seed = source.get("seed")
    base = [f"env={config.env.name}", f"preset={config.preset}"]
    seeded = [] if seed is None else [f"seed={seed}"]
    evaluate = [
        _line("evaluate", f"run={RUN}", f"protocol={r.protocol}", f"episodes={r.episodes}", f"seed={r.seed}")
        for r in results
    ]
    changed, recorded, demos = changes(config, BEHAVIOUR), source.get("recorded") or {}, source.get("demos")
    episodes = recorded.get("episodes") or demos
    first = [f"demos={demos}"] if demos is not None and demos != episodes else []
    if not source.get("shipped_world_model"):
        world = source.get("world_model_seed", seed)
        if world in (None, seed) and not first:
            return [_line("pipeline", *base, *seeded, *changes(config, GROUPS), f"out={RUN}"), *evaluate]
        again = [] if world is None else [f"seed={world}"]
        collected = f"data.demos={WORLD}/data/expert"
        return [
            _line("pipeline", *base, *again, *changes(config, GROUPS), f"out={WORLD}"),
            _line("train-policy", f"run={WORLD}", *base, *seeded, *first, *changed, collected, f"out={RUN}"),
            *evaluate,
        ]
    count = [] if episodes is None else [f"episodes={episodes}"]
    start = [f"seed={recorded['seed']}"] if recorded else seeded
    where = "data/demonstrations"
    recording = [text for text in changed if text.startswith(("env.", "render.", "collect."))]
    return [
        _line("collect", *base, "policy=expert", *count, *start, *recording, f"out={where}"),
        _line("train-policy", "run=pretrained", *base, *seeded, *first, *changed, f"data.demos={where}", f"out={RUN}"),
        *evaluate,
    ]


def changes(config: ExperimentConfig, groups: tuple[str, ...]) -> list[str]:
    """`key=value` of what differs from the run's preset, in some groups of keys.

    Raises:
        ConfigError: the preset or the environment is not one of this version.
    """
    free = keys_of(ExperimentConfig, "free")
    preset = flatten(to_dict(compose([f"env={config.env.name}", f"preset={config.preset}"])))
    return [
        f"{key}={_value(value)}"
        for key, value in flatten(to_dict(config)).items()
        if any(key.startswith(f"{group}.") for group in groups)
        and key not in free
        and (key not in preset or preset[key] != value)
    ]


def _value(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


def _line(command: str, *arguments: str) -> str:
    return shlex.join(["playslot", command, *arguments])


MARK: Final = "<!-- made by `playslot export`; remove this line to keep your own text -->"
"""A card with this line was made here and not edited by hand."""
MEASURED: Final = """\
Held-out episodes, one for each seed; Wilson intervals, which cover the choice of episodes and not that of
the training run. In imagination only the first frame is seen, and the imagined actions are executed without
looking."""
REPEATS: Final = (
    "On one machine a seeded run repeats bit for bit on the CPU; another processor or library rounds differently."
)
PROTOCOL_NAMES: Final = {"simulation": "in simulation (closed loop)", "imagination": "in imagination (open loop)"}

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
) -> str:
    """The card as Markdown with a YAML header: `card.md`, filled in.

    Args:
        name: title.
        policy: config of the model folder.
        agent: the networks.
        experiment: config of the run; None where it is not known.
        results: evaluations of this policy.
    """
    env = policy.env
    header = {
        "license": LICENCE,
        "library_name": "lerobot",
        "pipeline_tag": "robotics",
        "tags": [*TAGS, env.name],
        "model_name": name,
    }
    parameters = sum(p.numel() for part in shared_modules(agent).values() for p in part.parameters())
    commands, evaluation = "Not recorded: saved from Python. `playslot export` writes the commands.", EvaluationConfig()
    if experiment:
        lines = "\n".join(reproduce(experiment, policy.source, results))
        commands, evaluation = f"```bash\n{lines}\n```\n\n{REPEATS}", experiment.evaluation
    versions = {
        "exported with": _numbers(policy.source.get("versions", {})),
        "trained with": _numbers(policy.source.get("trained_with", {})),
        "weights": f"fingerprint `{policy.fingerprint}`",
        "licence": "Apache License 2.0, of the weights and of this card",
    }
    return Template(Path(__file__).with_name("card.md").read_text()).substitute(
        front=front_matter(header, MARK),
        name=name,
        env=env.name,
        parameters=f"{parameters:,}",
        task=facts_table(_task(policy)),
        data=facts_table(_data(policy.source)),
        results=_results(results),
        seed=evaluation.seed_offset,
        commands=commands,
        versions=facts_table(versions),
    )


def front_matter(header: dict[str, Any], mark: str) -> str:
    """First lines of a card: what the Hub reads, and the mark by which a card made here is known."""
    return f"---\n{yaml.safe_dump(header, sort_keys=False, allow_unicode=True)}---\n\n{mark}"


def facts_table(rows: dict[str, str]) -> str:
    """Names and values as a Markdown table."""
    return table(("", ""), rows.items())


def _task(policy: SharedPolicyConfig) -> dict[str, str]:
    env, words, action, rate = policy.env, "", "", ""
    if env.name in ENVIRONMENTS:
        from playslot_rl.envs.lerobot import frames_a_second

        described = task_metadata(env)
        words, action = str(described.get("task", "")), str(described.get("action", ""))
        rate = f"; {frames_a_second(env)} a second"
    other = "resized by area averaging" if policy.resize else "refused"
    side = f"{env.image_size} x {env.image_size}"
    numbers = f"{env.action_dim} numbers in [-1, 1]"
    return {
        "task": words or "not described",
        "camera": f"`{policy.camera}`, {side} RGB; frames of another size are {other}",
        "action": f"`{keys.FEATURE_ACTION}`, {numbers}" + (f": {action}" if action else ""),
        "agent steps": f"at most {env.max_steps} an episode, each {env.frame_skip} environment steps{rate}",
        "memory": "SAVi's slots are carried from frame to frame: call `reset()` before each episode",
    }


def _data(source: dict[str, Any]) -> dict[str, str]:
    data = source.get("data", {})
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


def _results(results: Sequence[Result]) -> str:
    if not results:
        return "Not evaluated yet. `playslot evaluate`, then `playslot export` again, puts success rates here."
    rows = []
    for result in results:
        steps = "–" if result.mean_steps is None else f"{result.mean_steps:.1f}"
        title = f"this policy, {PROTOCOL_NAMES[result.protocol]}"
        rows.append(
            [title, _share(result.success_rate), _interval(result.ci95), steps, str(result.episodes), str(result.seed)]
        )
    first = results[0]
    for name, (rate, ci95) in first.references.items():
        title = REFERENCES.get(name, name.replace("_", " "))
        rows.append([title, _share(rate), _interval(ci95), "–", str(first.episodes), str(first.seed)])
    titles = ["", "success", "95 % interval", "mean agent steps to success", "episodes", "seed"]
    return f"{table(titles, rows)}\n\n{MEASURED}"


def _share(rate: float) -> str:
    return f"{100 * rate:.0f} %"


def _interval(ends: tuple[float, float]) -> str:
    return f"{100 * ends[0]:.0f} to {100 * ends[1]:.0f} %"


def _numbers(versions: dict[str, str]) -> str:
    return ", ".join(f"{name} {number or 'not recorded'}" for name, number in versions.items()) or "not recorded"
