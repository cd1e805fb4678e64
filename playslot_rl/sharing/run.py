"""From a run to a model folder: where the policy came from and how well it does, which goes into `config.json` and the
card. Nothing of the machine is taken along: no folder, no command line, no host.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig
from playslot_rl.config.weights import data_roots
from playslot_rl.data.contents import camera_list, cameras_of, full_name
from playslot_rl.data.metadata import INFO_NAME, RECORD_NAME, read_info
from playslot_rl.envs import ENVIRONMENTS, RECORDED
from playslot_rl.errors import CheckpointError, ConfigError, DataError, OutputError
from playslot_rl.evaluation.success import POLICY_PROTOCOLS, run_facts, task_facts
from playslot_rl.runs import Run
from playslot_rl.sharing.card import MARK, make_card
from playslot_rl.sharing.commands import Result
from playslot_rl.sharing.folder import CARD, SharedPolicyConfig, require_whole, save_pretrained
from playslot_rl.storage.atomic import write_text

if TYPE_CHECKING:
    from playslot_rl.world_model import Agent

LIBRARIES: Final = ("torch", "torchrl", "tensordict", "lerobot", "gymnasium", "mujoco", "metaworld")
"""Named on the card with their versions."""


def read_source(run: Run) -> dict[str, Any]:
    """Plain values: fingerprints of weights and data, demonstrations, labels, commit, seed, versions. A CheckpointError
    where the run has no policy, or its checkpoints are damaged or do not belong together.
    """
    run_facts(run.folder)  # a run without a policy is refused with what to do
    policy, parents = run.own("policy"), run.world_stages
    meta = policy.meta
    prints = {name: checkpoint.fingerprint for name, checkpoint in parents.items()}
    return {
        "fingerprints": {**prints, "policy": policy.fingerprint},
        "data": {
            "world_model": parents["dynamics"].meta.get("data", {}).get("train", ""),
            "demonstrations": meta.get("data", {}).get("demos", ""),
        },
        "tasks": meta.get("tasks", []),
        "demos": meta.get("demos"),
        "labelled_demos": meta.get("labelled_demos"),
        "seed": meta.get("seed"),
        "world_model_seed": parents["slots"].meta.get("seed"),
        "commit": meta.get("commit", ""),
        "clocked": any(parent.meta.get("clocked", False) for parent in parents.values()),
        "shipped_world_model": _is_pretrained(str(policy.config.get("env", {}).get("name", "")), prints),
        "trained_with": {"playslot_rl": meta.get("version", ""), "torch": meta.get("torch", "")},
        "recorded": _recorded(Path(str(meta.get("data_root", "")))),
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    from playslot_rl import __version__

    return {"playslot_rl": __version__, **{name: importlib.metadata.version(name) for name in LIBRARIES}}


def _is_pretrained(env: str, prints: dict[str, str]) -> bool:
    """Whether the world model is the one that ships with the package."""
    try:
        pretrained = Run.open(f"pretrained/{env}").world_stages
    except CheckpointError:
        return False
    return prints == {name: checkpoint.fingerprint for name, checkpoint in pretrained.items()}


def _recorded(root: Path) -> dict[str, Any]:
    """How our collectors recorded the demonstrations, where they are still there; else empty."""
    try:
        spec = json.loads((root / RECORD_NAME).read_text())["spec"]
        return {name: spec[name] for name in ("policy", "episodes", "steps", "seed", "noise")}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _elsewhere(root: Path) -> bool:
    """Whether a data set is there that our collectors did not record."""
    return (root / INFO_NAME).is_file() and not (root / RECORD_NAME).is_file()


def read_results(run: Run, config: ExperimentConfig, source: dict[str, Any]) -> list[Result]:
    """Evaluations of exactly this policy, not of an older one, in the task and on the block of episodes that the run's
    config says, from `RUN/evaluation/*/eval_info.json`.
    """
    results = []
    for protocol in POLICY_PROTOCOLS:
        path = run.folder / "evaluation" / protocol / "eval_info.json"
        if not path.is_file():
            continue
        try:
            info = json.loads(path.read_text())
            facts = {"fingerprints": source["fingerprints"], **task_facts(config, int(info["seed"]))}
            if info["success_rate"] is not None and facts == {key: info.get(key) for key in facts}:
                results.append(_result(info))
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"{path} is damaged ({error!r}), expected the result of `playslot evaluate`: run that again"
            ) from error
    return results


def _result(info: dict[str, Any]) -> Result:
    def interval(values: Any) -> tuple[float, float]:
        return float(values[0]), float(values[1])

    steps = info.get("mean_steps_to_success")
    return Result(
        protocol=str(info["protocol"]),
        episodes=int(info["episodes"]),
        seed=int(info["seed"]),
        success_rate=float(info["success_rate"]),
        ci95=interval(info["ci95"]),
        mean_steps=None if steps is None else float(steps),
        references={
            name: (float(row["success_rate"]), interval(row["ci95"]))
            for name, row in info["references"].items()
            if row["success_rate"] is not None
        },
    )


def export_run(
    run: Run, folder: Path, config: ExperimentConfig, source: dict[str, Any] | None = None
) -> SharedPolicyConfig:
    """Write the policy of a run to a new folder. `source` is `read_source(run)`, if it has been read. A ConfigError
    where the policy was trained on several cameras and `data.camera` does not choose one; an OutputError where the
    folder exists.
    """
    source = source or read_source(run)
    roots = data_roots(",".join(text for text in (config.data.root, config.data.demos) if text))
    source = {**source, "recorded_elsewhere": any(_elsewhere(Path(root.path)) for root in roots)}
    agent = run.load_agent()
    card = _card(run, folder.name, agent, config, source)
    return save_pretrained(agent, folder, _policy(run, agent, config, source), card)


def _card(
    run: Run, name: str, agent: Agent, config: ExperimentConfig, source: dict[str, Any]
) -> Callable[[SharedPolicyConfig], str]:
    results = read_results(run, config, source)
    made = replace(config, data=replace(config.data, camera=run.view.camera))  # one of several may be exported
    home, world = run.world_run, None
    if home is not run and not home.pretrained:
        with contextlib.suppress(ConfigError):  # of an earlier version, or gone: the policy's own settings are said
            world = home.config
    return lambda written: make_card(name, written, agent, made, results, world)


def renew_exported(run: Run, folder: Path, config: ExperimentConfig, source: dict[str, Any]) -> bool:
    """Check that a model folder is whole and holds what `export_run` would write into it, but for versions of
    libraries, and renew its card unless it was edited by hand: whether that was another one. An OutputError where it
    holds another policy, other errors as of `export_run`.
    """
    made, agent = require_whole(folder), run.load_agent()
    wanted = replace(_policy(run, agent, config, source), fingerprint=made.fingerprint)
    if made.source.get("fingerprints") != source["fingerprints"] or replace(made, source=source) != wanted:
        raise OutputError(
            f"out={folder}: got another policy, expected a new folder or that of run={run.name}: choose another"
        )
    old, card = (folder / CARD).read_text("utf-8", "replace"), _card(run, folder.name, agent, config, source)(made)
    if old == card or MARK not in old:
        return False
    write_text(folder / CARD, card)
    return True


def _policy(run: Run, agent: Agent, config: ExperimentConfig, source: dict[str, Any]) -> SharedPolicyConfig:
    policy, env = run.own("policy"), agent.world_model.env
    if env.name in RECORDED and "actions" not in policy.meta:
        raise CheckpointError(
            f"{policy.path}: got a policy of an earlier version, which clipped the robot's "
            "actions to [-1, 1], expected one that knows their range: train it again by `playslot train-policy` with "
            "another out="
        )
    view, demos = run.view, _demonstrations(config)
    own = described(run)
    return SharedPolicyConfig(
        env=env,
        model=agent.world_model.config,
        camera=_camera(run, config, [*camera_list(view.camera), own.camera], demos),
        resize=config.data.resize,
        stride=config.data.stride,
        fps=own.fps or _frame_rate(config, demos),
        source=source,
        actions=own.actions,
    )


def described(run: Run) -> SharedPolicyConfig:
    """What a run says of the frames that its policy looks at, and of its actions; its networks are not made."""
    view, meta = run.view, run.own("policy").meta
    named = str(meta.get("camera") or ""), view.camera
    return SharedPolicyConfig(
        camera=next((one for one in named if one and "," not in one), keys.FEATURE_IMAGE),
        resize=view.resize,
        stride=view.stride,
        fps=float(meta.get("fps", 0.0)),
        actions={key: value for key, value in (meta.get("actions") or {}).items() if key in ("names", "low", "high")},
    )


def _demonstrations(config: ExperimentConfig) -> tuple[str, dict[str, Any]] | None:
    """The first data set of the demonstrations and its metadata; None where it is not there any more."""
    for root in data_roots(config.data.demos or config.data.root)[:1]:
        with contextlib.suppress(DataError):
            return root.path, read_info(Path(root.path))
    return None


def _frame_rate(config: ExperimentConfig, demos: tuple[str, dict[str, Any]] | None) -> float:
    """Frames a second of the demonstrations, over the stride: for older runs, which do not say it. 0 where nobody
    knows."""
    if demos is not None:
        return float(demos[1]["fps"]) / config.data.stride
    if config.env.name in ENVIRONMENTS:
        from playslot_rl.envs.lerobot import frames_a_second

        return frames_a_second(config.env) / config.data.stride
    return 0.0


def _camera(run: Run, config: ExperimentConfig, known: Sequence[str], demos: tuple[str, dict[str, Any]] | None) -> str:
    """LeRobot's name of the camera a run looks at: `data.camera`, else the only one of its demonstrations; a
    ConfigError for several. Where these are no longer there it is that of the run, or of our data sets: the last one
    `known`.
    """
    names, where, otherwise = camera_list(config.data.camera), run.name, known[-1]
    if demos is not None:
        known, where = cameras_of(demos[1]["features"]), demos[0]
        names = names or [*known]
    if len(names) > 1:
        raise ConfigError(f"data.camera: got {', '.join(names)}, expected the one the policy is to look at: name it")
    return full_name(names[0], known, where) if names else otherwise
