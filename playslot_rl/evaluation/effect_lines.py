"""The card's lines on what latents do: replayed, taken to another episode, held, exchanged for others.

Shapes: W windows, L steps, K prototypes, S places, N slots, D slot width, H W image size. A latent is ([N,] Z).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.data.windows import spread_windows
from playslot_rl.evaluation.card_lines import EFFECTS, MEASURES, Line, line
from playslot_rl.evaluation.effects import (
    Drawn,
    agreement,
    change_in,
    displacements,
    draw,
    explained_by_group,
    moving_slots,
    replay,
    same_mover,
    squared_change,
)
from playslot_rl.evaluation.latent_lines import NO_LATENTS, ParsedEpisodes
from playslot_rl.seeds.draws import derived_seed
from playslot_rl.world_model import WorldModel, module_device

STEPS = 5
"""L, steps that latents are replayed or held for."""
WINDOWS = 64
PLACES = 16
"""S, windows from whose first frame each prototype is held."""
STILL = "no slot moves in these videos"


@dataclass(frozen=True)
class Windows:
    """Windows of held-out episodes.

    Attributes:
        slots: parsed (W, L + 1, N, D).
        latents: (W, L, [N,] Z).
        frames: uint8 (W, L + 1, H, W, 3).
        others, thirds: window of another episode for each, int64 (W,); -1 where there is one episode only.
    """

    slots: Tensor
    latents: Tensor
    frames: npt.NDArray[np.uint8]
    others: npt.NDArray[np.int64]
    thirds: npt.NDArray[np.int64]


@dataclass(frozen=True)
class Replayed:
    """What the page shows of the replays; all pictures are of the same windows.

    Attributes:
        true, start: the last and the first frame as their parsed slots are drawn.
        own, taken, swapped: imagined after L steps under the own latents; from the first frame of `others` under the
            own ones; under the latents of `others`.
        region: where the slots that move are, bool (W, H, W).
        held: (K', 2, H, W, 3): each used prototype held from two places; None without prototypes.
        windows: the windows.
    """

    windows: Windows
    start: Drawn
    true: Drawn
    own: Drawn
    taken: Drawn | None
    swapped: Drawn | None
    region: npt.NDArray[np.bool_] | None = None
    held: npt.NDArray[np.uint8] | None = None
    codes: tuple[int, ...] = ()


def cut_windows(model: WorldModel, parsed: ParsedEpisodes, seed: int) -> Windows:
    """At most `WINDOWS` windows of the held-out episodes, of `STEPS` steps or as many as the longest has."""
    tested = np.flatnonzero(parsed.tested_episodes)
    lengths = parsed.source.lengths
    steps = min(STEPS, int(lengths[tested].max()) - 1)
    rows = spread_windows(parsed.starts, lengths, steps + 1, WINDOWS, tested)
    of = np.searchsorted(parsed.starts, rows[:, 0], side="right") - 1
    pixels = rows + (parsed.source.starts - parsed.starts)[of][:, None]
    index = np.full(len(parsed.slots), -1, np.int64)
    index[parsed.rows] = np.arange(len(parsed.rows))
    latents = parsed.latents[index[rows[:, :-1]]].reshape(len(rows), steps, *model.latent_shape)
    device = module_device(model)
    generator = np.random.default_rng(derived_seed(seed, 0, "partners"))
    return Windows(
        torch.from_numpy(parsed.slots[rows]).to(device),
        torch.from_numpy(latents).to(device),
        np.asarray(parsed.source.frames[pixels]),
        *(_partners(of, generator) for _ in range(2)),
    )


def _partners(of: npt.NDArray[np.int64], generator: np.random.Generator) -> npt.NDArray[np.int64]:
    """For each window, by its episode, a random window of another one; -1 for all where there is one only."""
    if len(np.unique(of)) < 2:
        return np.full(len(of), -1, np.int64)
    return np.array([generator.choice(np.flatnonzero(of != episode)) for episode in of], np.int64)


@torch.no_grad()
def effect_lines(
    model: WorldModel, parsed: ParsedEpisodes, seed: int, used: list[int]
) -> tuple[list[Line], dict[str, Any], Replayed]:
    """Replay, transfer, constancy and sensitivity, in windows of the tested episodes.

    Args:
        model: in evaluation mode.
        parsed: the episodes.
        seed: of the partners.
        used: codes that the tested episodes use; empty without prototypes.
    """
    windows, n = cut_windows(model, parsed, seed), model.slot_shape[0]
    paired = bool((windows.others >= 0).all())
    first = windows.slots[:, 0]
    start, true = draw(model, first), draw(model, windows.slots[:, -1])
    own = draw(model, replay(model, first, windows.latents)[:, -1])
    taken = draw(model, replay(model, first[windows.others], windows.latents)[:, -1]) if paired else None
    swapped = draw(model, replay(model, first, windows.latents[windows.others])[:, -1]) if paired else None
    shown = Replayed(windows, start, true, own, taken, swapped)
    if not model.inverse_dynamics.latent_dim:
        return [line(key, None, NO_LATENTS) for key, m in MEASURES.items() if m.group == EFFECTS], {}, shown
    moved = displacements(start.labels, true.labels, n)
    lines, details = _transfer(shown, moved, n)
    constancy, held, table = _constancy(model, windows, used)
    sensitivity, region = _sensitivity(shown, details["moving_slots"])
    details |= {"prototypes": table, "steps": windows.latents.shape[1], "windows": len(first)}
    shown = Replayed(windows, start, true, own, taken, swapped, region, held, tuple(used))
    return [*lines, constancy, *sensitivity], details, shown


SINGLE_EPISODE = "a single held-out episode"


def _transfer(shown: Replayed, moved: npt.NDArray[np.float64], n: int) -> tuple[list[Line], dict[str, Any]]:
    count, steps = moved.shape[0], shown.windows.latents.shape[1]
    what = f"{count} windows of {steps} steps"
    own = agreement(moved, displacements(shown.start.labels, shown.own.labels, n))
    lines = [line("replay", own, what if own is not None else STILL)]
    details: dict[str, Any] = {"moving_slots": moving_slots(shown.start.labels, shown.true.labels, n).tolist()}
    if shown.taken is None:
        keys = ("transfer", "transfer_shuffled", "same_slot")
        return [*lines, *(line(key, None, SINGLE_EPISODE) for key in keys)], details
    elsewhere = displacements(shown.start.labels[shown.windows.others], shown.taken.labels, n)
    alike = agreement(moved, elsewhere)
    wrong, mover = moved[shown.windows.thirds], same_mover(moved, elsewhere)
    chance = same_mover(wrong, elsewhere)
    return [
        *lines,
        line("transfer", alike, what if alike is not None else STILL),
        line("transfer_shuffled", agreement(wrong, elsewhere), what if alike is not None else STILL),
        line("same_slot", mover, STILL if mover is None else f"with the motion of another window: {chance:.2f}"),
    ], details


def _constancy(
    model: WorldModel, windows: Windows, used: list[int]
) -> tuple[Line, npt.NDArray[np.uint8] | None, list[dict[str, Any]]]:
    """The line, pictures of two places, and what each prototype does on average."""
    if not used:
        return line("constancy", None, f"mode {model.config.inverse_dynamics.mode} has no prototypes"), None, []
    count, steps, n = len(windows.slots), windows.latents.shape[1], model.slot_shape[0]
    places = np.unique(np.linspace(0, count - 1, min(PLACES, count)).round().astype(int))
    start = windows.slots[places, 0]
    before = draw(model, start)
    shape = (len(places), steps, *model.latent_shape)
    effects, pictures, table = [], [], []
    for code in used:
        after = draw(model, replay(model, start, model.inverse_dynamics.prototypes[code].expand(shape))[:, -1])
        effect = displacements(before.labels, after.labels, n)
        effects.append(effect)
        pictures.append(after.frames[[0, -1]])
        mean, slot = effect.mean(0), int(np.linalg.norm(effect.mean(0), axis=-1).argmax())
        spread = float(np.sqrt(((effect[:, slot] - mean[slot]) ** 2).sum(-1).mean()))
        table.append({"code": code, "slot": slot, "pixels": mean[slot].tolist(), "spread": spread})
    share = explained_by_group(np.stack(effects))
    why = f"{len(used)} prototypes in use, each held for {steps} steps from {len(places)} places"
    if share is None:
        why = "a single prototype is in use" if len(used) < 2 else STILL if len(places) > 1 else "a single window"
    return line("constancy", share, why), np.stack(pictures), table


def _sensitivity(shown: Replayed, movers: list[int]) -> tuple[list[Line], npt.NDArray[np.bool_] | None]:
    """Both lines, and the region of the slots that move."""
    if shown.swapped is None:
        return [line(key, None, SINGLE_EPISODE) for key in ("sensitivity", "locality")], None
    change = squared_change(shown.own.frames, shown.swapped.frames)
    real = float(squared_change(shown.start.frames, shown.true.frames).sum())
    size = float(np.sqrt(change.sum() / real)) if real > 0 else None
    lines = [line("sensitivity", size, "the latents of a window of another episode" if size is not None else STILL)]
    if not movers:
        return [*lines, line("locality", None, STILL)], None
    drawn = (shown.start, shown.own, shown.swapped)
    region: npt.NDArray[np.bool_] = np.logical_or.reduce([np.isin(one.labels, movers) for one in drawn])
    inside = change_in(change, region)
    if inside is None:
        return [*lines, line("locality", None, "nothing changes")], region
    names = ", ".join(f"slot {n + 1}" for n in movers)
    note = f"{inside.share:.0%} of the change in the {inside.area:.0%} of the picture of {names}"
    return [*lines, line("locality", inside.excess, note)], region
