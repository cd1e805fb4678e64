"""The report's section on latent actions: codebook usage, what a code stands for, what a probe can read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from playslot_rl.data.demonstrations import probed_actions
from playslot_rl.errors import DataError
from playslot_rl.evaluation.held_out import data_folders
from playslot_rl.evaluation.probes import code_table, codebook_usage, infer_latents, probe_actions
from playslot_rl.visualization.charts import usage_chart
from playslot_rl.visualization.document import Block, Missing, Section, Table, Text
from playslot_rl.visualization.sections import ReportInput, chart
from playslot_rl.world_model import WorldModel, module_device

MOST = 200
COLLECT = "playslot collect out=DIR policy=random"


@dataclass(frozen=True)
class LatentData:
    """Latent actions of a data set: codes int64 (M, 1) or (M, N), actions (M, A) as they were recorded, if there are
    any, and the result of `probe_actions`, None without actions that are numbers; of all episodes of the set or of its
    first `MOST`.
    """

    name: str
    codes: Any
    actions: Any
    probe: dict[str, Any] | None
    whole: bool = True


def read_latents(model: WorldModel, root: Path, given: ReportInput, name: str) -> LatentData:
    """Latent actions of up to `MOST` episodes of a data set of that name, with the probe where it has actions."""
    from playslot_rl.data.cache import Cache
    from playslot_rl.data.slot_cache import slot_cache
    from playslot_rl.data.weighted import open_configured

    data = given.config.data
    source = open_configured(given.config, [root])
    prints = str(given.metas.get("slots", {}).get("fingerprint", ""))
    slots = slot_cache(source, model.savi, prints, Cache.of(data), module_device(model))
    starts, lengths, whole = source.starts[:MOST], source.lengths[:MOST], len(source.starts) <= MOST
    z, codes, episodes = infer_latents(model.inverse_dynamics, slots, starts, lengths, source.actions)
    if source.actions is None:
        return LatentData(name, codes, None, None, whole)
    rows = np.concatenate([np.arange(s, s + n - 1) for s, n in zip(starts, lengths, strict=True) if n > 1])
    actions, probed = np.asarray(source.actions[rows]), probed_actions(source, rows)
    known = np.isfinite(actions).all(axis=1)
    if probed is None or len(np.unique(episodes[known])) < 2:
        return LatentData(name, codes, actions, None, whole)
    probe = probe_actions(z[known], probed[known], episodes[known], codes=codes[known])
    return LatentData(name, codes, actions, probe, whole)


def told_apart(folders: Sequence[Path]) -> list[str]:
    """Their names, with as many folders above them as tell them apart."""
    for depth in range(1, max(len(folder.parts) for folder in folders)):
        names = [Path(*folder.parts[-depth:]).as_posix() for folder in folders]
        if len({*names}) == len(names):
            return names
    return list(map(str, folders))


def latent_section(given: ReportInput) -> Section:
    title = "Latent actions"
    if given.world_model is None:
        return Section(title, [Missing("There is no trained dynamics model.", given.command("train-dynamics"))])
    found = [p for p in data_folders(given.config, given.run) if (p / "meta" / "info.json").is_file()]
    if not found:
        return Section(title, [Missing("The run names no data set on this machine.", COLLECT)])
    model = given.world_model
    sets, blocks = [], list[Block]()
    for root, name in zip(found, told_apart(found), strict=True):
        try:
            sets.append(read_latents(model, root, given, name))
        except DataError as error:  # the rest of the report does not depend on it
            blocks.append(Missing(f"A data set cannot be read: {error}.", COLLECT))
    if not sets:
        return Section(title, blocks)
    k = model.inverse_dynamics.n_prototypes
    blocks += _usage(sets, k) if k else []
    blocks += _probes(sets)
    if k:
        blocks += _codes(sets, k)
    return Section(title, blocks)


def _usage(sets: list[LatentData], k: int) -> list[Block]:
    usage = {d.name: codebook_usage(d.codes, k) for d in sets}
    rows = [[n, f"{u['used']} of {k}", f"{u['perplexity']:.2f}", str(sum(u["counts"]))] for n, u in usage.items()]
    counts = {n: u["counts"] for n, u in usage.items()}
    alt = "Share of transitions by code. " + "; ".join(f"{n}: {', '.join(map(str, c))}" for n, c in counts.items())
    some = "" if all(d.whole for d in sets) else f"The first {MOST} episodes of each data set."
    return [
        Table(["data set", "codes in use", f"perplexity (1 to {k})", "transitions"], rows, some),
        chart("codebook", lambda theme: usage_chart(counts, theme), alt, "Codebook usage."),
    ]


def _r2(value: float | None) -> str:
    return "–" if value is None else f"{round(value, 2) + 0.0:.2f}"


def _probes(sets: list[LatentData]) -> list[Block]:
    probed = [d for d in sets if d.probe is not None]
    if not probed:
        return [Text("No probe of the real action: the data sets carry no actions, or a single episode.")]
    names = {
        "linear": "linear (ridge), from z",
        "mlp": "two-layer network, from z",
        "code": "linear, from the code alone",
    }
    width = probed[0].actions.shape[1]
    rows = []
    for d in probed:
        assert d.probe is not None
        for key, label in names.items():
            if key in d.probe:
                score = d.probe[key]
                rows.append([f"{d.name}: {label}", _r2(score["mean_r2"]), *(_r2(v) for v in score["r2"])])
    headers = ["probe", "mean R²", *(f"action {i + 1}" for i in range(width))]
    held = ", ".join(f"{d.name}: {d.probe['test_episodes']} episodes" for d in probed if d.probe is not None)
    caption = (
        f"Variance of the real action recovered on held-out episodes ({held}); 1 is all of it, 0 or less is none. "
        "Random actions are the stricter test: an expert's can partly be guessed from the scene alone."
    )
    return [Table(headers, rows, caption)]


def _codes(sets: list[LatentData], k: int) -> list[Block]:
    labelled = [d for d in sets if d.actions is not None and d.codes.shape[1] == 1]
    blocks: list[Block] = []
    for d in labelled:
        rows = []
        for row in code_table(d.codes[:, 0], d.actions, k):
            cells = ["–"] * d.actions.shape[1]
            if row["mean"] is not None:
                cells = [f"{m:+.2f} ± {s:.2f}" for m, s in zip(row["mean"], row["std"], strict=True)]
            rows.append([str(row["code"]), str(row["count"]), *cells])
        headers = ["code", "transitions", *(f"action {i + 1}" for i in range(d.actions.shape[1]))]
        blocks.append(Table(headers, rows, f"Real actions by code, mean ± standard deviation ({d.name})."))
    return blocks
