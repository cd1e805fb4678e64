"""The sections of a run's report, each from what the run folder holds; what is missing is named with its command."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from playslot_rl.acting.episodes import TaskPool
from playslot_rl.config import ExperimentConfig
from playslot_rl.evaluation.held_out import first_seed
from playslot_rl.evaluation.objects import SLOTS_RESULT
from playslot_rl.evaluation.success import POLICY_PROTOCOLS, PROTOCOLS, hardware
from playslot_rl.evaluation.video import video_metrics
from playslot_rl.frames import png, to_float
from playslot_rl.runtime.progress import format_seconds
from playslot_rl.storage.atomic import json_or_nothing
from playslot_rl.training.logging import History
from playslot_rl.visualization.charts import DARK, LIGHT, Theme, loss_chart, loss_names, success_chart
from playslot_rl.visualization.document import Block, Missing, Picture, Section, Table, Text
from playslot_rl.visualization.drawings import draw_prototypes, draw_slots, run_rollouts
from playslot_rl.visualization.grid import animation, film_strip, side_by_side
from playslot_rl.world_model import Agent, WorldModel

STAGES = ("slots", "dynamics", "policy")
HISTORIES = {"slots": "slots", "dynamics": "dynamics", "policy": "policy", "action decoder": "policy/decoder"}
"""What was trained -> folder of its `metrics.jsonl` in the run."""
EPISODES_SHOWN = 3
SHARE: Final = "{:.0%}"
NUMBER: Final = "{:.3g}"
METRICS: Final = {
    "mse": ("mean squared image error", NUMBER),
    "mse_image": ("mean squared image error", NUMBER),
    "mse_slot": ("mean squared slot error", NUMBER),
    "psnr": ("PSNR", "{:.1f} dB"),
    "slots_in_use": ("slots in use", NUMBER),
    "largest_slot": ("the largest slot's share of the pixels", SHARE),
    "flicker": ("exchanges of slots a transition", NUMBER),
    "mask_entropy": ("entropy of the masks", "{:.2f} nats"),
    "moving_explained": ("share of the moving pixels' change that is drawn", SHARE),
    "usage": ("prototypes in use", SHARE),
    "perplexity": ("perplexity of the codes", NUMBER),
    "unexplained_parsed": ("latents of the policy, from parsed slots", SHARE),
    "unexplained_imagined": ("latents of the policy, from imagined slots", SHARE),
    "oracle_unexplained": ("actions of the slot oracle", SHARE),
    "decoder_trial_unexplained": ("actions of a decoder that reads slots, on trial", SHARE),
    "decoder_unexplained": ("actions of the action decoder", SHARE),
    "finetune_unexplained": ("actions of policy and decoder tuned together", SHARE),
}
"""Key of a stage's metric: its words, and how its value is written. Those of `unexplained` are variances."""
HELD_OUT: Final = "_held_out"
ROLLOUTS = ("imagined", "executed", "closed loop")


@dataclass(frozen=True)
class ReportInput:
    """What the sections are made from; the models are None where the run has none yet.

    Attributes:
        pool: environments for the pictures.
        shown: how the run folder is written in commands: relative where it lies below the present one, else by its
            name.
        metas: stage -> `meta.json` of its finished checkpoint.
    """

    run: Path
    config: ExperimentConfig
    world_model: WorldModel | None
    agent: Agent | None
    pool: TaskPool
    shown: str
    metas: dict[str, dict[str, Any]] = field(default_factory=dict)

    @cached_property
    def evaluations(self) -> dict[str, dict[str, Any]]:
        """Protocol -> `eval_info.json`, for those that are there and of the weights that the run has now."""
        found = {name: self.measured(Path("evaluation") / name / "eval_info.json") for name in PROTOCOLS}
        return {name: one for name, one in found.items() if one}

    def measured(self, path: Path) -> dict[str, Any] | None:
        """A result below the run, if it is there and of the weights that the run has now."""
        result = json_or_nothing(self.run / path)
        pairs = [(self.metas.get(s, {}).get("fingerprint"), of) for s, of in result.get("fingerprints", {}).items()]
        return result if result and all(now in (None, of) for now, of in pairs) else None

    def steps(self, result: Mapping[str, Any]) -> int:
        """Agent steps of its episodes, at most."""
        return int(result.get("max_steps", self.config.acting.max_steps))

    @property
    def first_seed(self) -> int:
        """First seed of the last evaluation, so that the pictures show episodes that were measured."""
        seeds = [result["seeds"][0] for result in self.evaluations.values()]
        return int(seeds[0]) if seeds else first_seed(self.config, self.config.seed)

    def command(self, name: str, rest: str = "") -> str:
        return f"{shlex.join(('playslot', name, f'run={self.shown}'))}{' ' + rest if rest else ''}"


def chart(name: str, draw: Callable[[Theme], bytes], alt: str, caption: str) -> Picture:
    """A chart drawn for both themes."""
    return Picture(name, draw(LIGHT), alt, caption, dark=draw(DARK))


def percent(rate: float | None) -> str:
    """`87 %`, or a dash."""
    return "–" if rate is None else f"{100 * rate:.0f} %"


def interval(ci: list[float] | None) -> str:
    """`79 to 92 %`, or a dash."""
    return "–" if ci is None else f"{100 * ci[0]:.0f} to {100 * ci[1]:.0f} %"


def seconds(value: float | None) -> str:
    """A duration, or a dash."""
    return "–" if value is None else format_seconds(value)


WAYS = {
    "simulation": "PlaySlot, in simulation",
    "imagination": "PlaySlot, in imagination",
    "replay": "expert's videos, latents decoded",
}
REFERENCES = {"slot_oracle": "slot oracle", "expert": "scripted expert", "random": "random actions"}


def success_section(given: ReportInput) -> Section:
    results = given.evaluations
    blocks: list[Block] = []
    if results:
        rows = _success_rows(results)
        cells = []
        for name, result, _, count in rows:
            steps = result.get("mean_steps_to_success")
            taken = "–" if steps is None else f"{steps:.1f}"
            said = f"return {result['mean_return']:.2f}" if "mean_return" in result else percent(result["success_rate"])
            cells.append([name, said, interval(result["ci95"]), taken, count])
        headers = ["", "success rate", "95 % interval", "mean steps to success", "episodes"]
        same = "the same seeds" if len(_by_seeds(results)) == 1 else "the seeds that are named"
        lengths = {name: given.steps(result) for name, result in results.items()}
        long = ", ".join(f"{steps} in {name}" for name, steps in lengths.items())
        unlike = f" Episodes differ in agent steps: {long}." if len({*lengths.values()}) > 1 else ""
        blocks.append(Table(headers, cells, f"Wilson intervals. References run closed-loop on {same}.{unlike}"))
        blocks += _task_table(rows)
        drawn = [
            (n, r["success_rate"], tuple(r["ci95"]), method)
            for n, r, method, _ in rows
            if r["success_rate"] is not None
        ]
        alt = "; ".join(f"{n}: {percent(rate)}, {interval(list(ci))}" for n, rate, ci, _ in drawn)
        steps = given.steps(results.get("imagination", {}))
        ways = (
            "Simulation: the agent sees every frame. Imagination: it sees the first frame only, unfolds "
            f"{steps} steps in latent space, and the decoded actions are then executed."
        )
        if "replay" in results:
            ways += (
                " Expert's videos: their latents instead of the policy's, decoded and executed without looking; "
                "what fails is lost by the decoder."
            )
        if drawn:
            blocks.append(chart("success", lambda theme: success_chart(drawn, theme), f"Success rates. {alt}.", ways))
    for protocol in POLICY_PROTOCOLS:
        if protocol not in results:
            command = given.command("evaluate", f"protocol={protocol}")
            blocks.append(Missing(f"Success in {protocol} has not been measured with these weights.", command))
    return Section("Success", blocks)


def _task_table(rows: Sequence[tuple[str, dict[str, Any], str, str]]) -> list[Block]:
    """Success in each of several tasks, a column for whoever acts; nothing where there is one."""
    found = {name: result["per_task"] for name, result, _, _ in rows if "per_task" in result}
    tasks = dict.fromkeys(task for each in found.values() for task in each)
    cells = [[task, *(percent(each.get(task, {}).get("success_rate")) for each in found.values())] for task in tasks]
    return [Table(["task", *found], cells, "Episodes take the tasks in turn, by their seeds.")] if cells else []


def _success_rows(results: dict[str, dict[str, Any]]) -> list[tuple[str, dict[str, Any], str, str]]:
    rows = [(WAYS[p], results[p], "playslot", str(results[p]["episodes"])) for p in PROTOCOLS if p in results]
    apart = _by_seeds(results)
    for protocols in apart:
        where = f", seeds of {' and '.join(protocols)}" if len(apart) > 1 else ""
        one = results[protocols[0]]
        there = {name: label for name, label in REFERENCES.items() if name in one.get("references", {})}
        rows += [(label + where, one["references"][name], name, str(one["episodes"])) for name, label in there.items()]
    return rows


def _by_seeds(results: dict[str, dict[str, Any]]) -> list[list[str]]:
    """The protocols that were measured on the same seeds, together."""
    found: dict[tuple[int, ...], list[str]] = {}
    for protocol, result in results.items():
        found.setdefault(tuple(result["seeds"]), []).append(protocol)
    return list(found.values())


def rollout_section(given: ReportInput) -> Section:
    title = "Imagined and simulated rollouts"
    if given.agent is None:
        return Section(title, [Missing("There is no trained policy.", given.command("train-policy"))])
    start = given.first_seed
    clips, executed, closed = run_rollouts(given.agent, given.pool, range(start, start + EPISODES_SHOWN))
    pictures = side_by_side(clips, ROLLOUTS, [f"episode {i + 1}" for i in range(len(clips))], scale=3)
    metrics = video_metrics(to_float(clips[:, 0, 1:]), to_float(clips[:, 1, 1:]))  # but for the first, parsed frame
    outcome = "; ".join(
        f"episode {i + 1}: {_outcome(a.steps)} from imagination, {_outcome(b.steps)} closed-loop"
        for i, (a, b) in enumerate(zip(executed, closed, strict=True))
    )
    moving = Picture(
        "rollouts",
        animation(pictures),
        f"Animation of {EPISODES_SHOWN} episodes: imagined frames, the same actions in the simulator, and the agent "
        "running closed-loop.",
        f"The first {EPISODES_SHOWN} evaluation seeds, not chosen. {outcome[:1].upper()}{outcome[1:]}.",
        still=png(pictures[-1]),
    )
    steps = len(metrics.psnr_steps)
    text = (
        f"Imagined against executed frames over {steps} steps and {EPISODES_SHOWN} episodes: "
        f"PSNR {metrics.psnr:.1f} dB ({metrics.psnr_steps[0]:.1f} dB at step 1, {metrics.psnr_steps[-1]:.1f} dB at "
        f"step {steps}), SSIM {metrics.ssim:.3f}."
    )
    alt = "Frames of the same episodes at even distances in time, three rows an episode."
    labels = [f"{i + 1} {name}" for i in range(len(clips)) for name in ROLLOUTS]
    strip = png(film_strip(clips.reshape(-1, *clips.shape[2:]), labels))
    return Section(title, [moving, Text(text), Picture("rollouts_strip", strip, alt, "The same, as a film strip.")])


def _outcome(steps: int | None) -> str:
    return "not solved" if steps is None else f"solved at step {steps}"


EXPERT_CLIP = "A held-out episode of the scripted expert."


def slots_section(given: ReportInput, clip: Callable[[], Any], what: str = EXPERT_CLIP) -> Section:
    """Slot masks and reconstructions; `what` says which clip it is."""
    title = "Slots"
    if given.world_model is None:
        return Section(title, [Missing("There is no trained SAVi.", given.command("train-slots"))])
    alt = "Rows: frames, their reconstructions, the segmentation by slot, and the part of the frame each slot holds."
    caption = (
        f"{what} Segmentation: each pixel in the colour of the slot with the "
        "largest mask. Slot rows: the slot's colours weighted by its mask, on white."
    )
    picture = Picture("slots", png(draw_slots(given.world_model, clip())), alt, caption)
    blocks: list[Block] = [picture]
    if result := given.measured(SLOTS_RESULT):
        scored = (
            f"On {result['episodes']} held-out episodes of the expert: FG-ARI {result['foreground_ari']:.2f} and ARI "
            f"{result['ari']:.2f} against the simulator's segmentation (1 is perfect, 0 chance), "
            f"{result['slots_per_object']:.1f} slots an object, reconstruction {result['psnr']:.1f} dB."
        )
        blocks.append(Text(scored))
    elif (given.run / SLOTS_RESULT).is_file():
        blocks.append(Missing("These slots have not been scored.", given.command("evaluate", "protocol=slots")))
    return Section(title, blocks)


def prototype_section(given: ReportInput, clip: Callable[[], Any]) -> Section:
    """Each prototype held for 15 frames."""
    title = "Action prototypes"
    if given.world_model is None:
        return Section(title, [Missing("There is no trained dynamics model.", given.command("train-dynamics"))])
    model = given.world_model
    if model.inverse_dynamics.n_prototypes == 0:
        mode = model.config.inverse_dynamics.mode
        return Section(title, [Text(f"The latent-action mode is `{mode}`, which has no prototypes.")])
    alt = "One row a prototype: the first frame and imagined frames up to t = 15, then a map of what changed."
    caption = (
        "Each prototype held for 15 frames with zero variability, from one parsed frame (t = 0 is real). Change: "
        "between t = 1 and t = 15, orange where it became brighter, blue where it became darker."
    )
    return Section(title, [Picture("prototypes", png(draw_prototypes(model, clip()[0])), alt, caption)])


def metric_text(metrics: Mapping[str, Any]) -> str:
    """The numbers among a stage's metrics that no column of the report has; a dash where there are none."""
    found = []
    for key, value in metrics.items():
        name = key.removesuffix(HELD_OUT)
        if not isinstance(value, (int, float)) or "unexplained" in name:
            continue
        words, form = METRICS.get(name, (name.replace("_", " "), NUMBER))
        held = " on held-out episodes" if key != name else ""
        found.append(f"{words}{held} {form.format(value).replace('%', ' %')}")
    return "; ".join(found) or "–"


def _unexplained(metrics: dict[str, Any]) -> list[Block]:
    """Variance that each network of the behaviour stage leaves unexplained, trained on and held out."""
    names = [name for name in METRICS if "unexplained" in name and name in metrics]
    rows = [[METRICS[n][0], percent(metrics[n]), percent(metrics.get(n + HELD_OUT))] for n in names]
    headers = ["unexplained variance", "demonstrations trained on", "held-out demonstrations"]
    return [Table(headers, rows)] if rows else []


def training_section(given: ReportInput, stages: Sequence[str] = STAGES) -> Section:
    blocks: list[Block] = []
    rows = []
    for stage in stages:
        meta = given.metas.get(stage)
        if meta is None:
            blocks.append(Missing(f"Stage {stage} is not finished.", given.command(f"train-{stage}")))
            continue
        metrics = metric_text(meta.get("metrics", {}))
        took = seconds(meta.get("seconds"))
        machine = ", ".join(part for part in (meta.get("gpu"), meta.get("machine")) if part) or "–"
        rows.append(
            [stage, str(meta.get("steps", "–")), took, machine, str(meta.get("commit", ""))[:12] or "–", metrics]
        )
    if rows:
        blocks.insert(0, Table(["stage", "steps", "time", "machine", "commit", "measured at the end"], rows))
        blocks[1:1] = _unexplained(given.metas.get("policy", {}).get("metrics", {}))
    paths = {name: given.run / folder / "metrics.jsonl" for name, folder in HISTORIES.items()}
    histories = {name: history for name, path in paths.items() if loss_names(history := History(path).read())}
    if histories:
        names = ", ".join(histories)
        caption = f"Logarithmic where all values are positive. Trained in this run: {names}."
        drawn = chart("losses", lambda theme: loss_chart(histories, theme), f"Loss curves of {names}.", caption)
        blocks.append(drawn)
    elsewhere = [stage for stage in given.metas if stage not in histories]
    if elsewhere:
        blocks.append(Text(f"No loss curves here for {', '.join(elsewhere)}: trained outside this run folder."))
    return Section("Training", blocks)


def settings_table(model: WorldModel | None, task: list[list[str]], measured: list[list[str]]) -> Table:
    """The rows of the task, of the world model, of what was measured, and of the machine that makes the report."""
    rows = list(task)
    if model is not None:
        savi, inverse = model.config.savi, model.config.inverse_dynamics
        rows += [
            ["slots", f"{savi.n_slots} of width {savi.slot_dim}"],
            ["latent actions", f"{inverse.mode}, {inverse.variant}, width {model.latent_shape[-1]}"],
            ["prototypes", str(model.inverse_dynamics.n_prototypes)],
        ]
    machine = hardware()
    gpu = f", {machine['gpu']}" if machine["gpu"] else ""
    here = ["report made on", f"{machine['machine']}, {machine['cores']} cores{gpu}, torch {machine['torch']}"]
    return Table(["setting", "value"], [*rows, *measured, here])
