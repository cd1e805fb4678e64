"""What latent actions do when they are replayed: elsewhere, held, or exchanged for others.

Effects are displacements of the slots: of the centroid of the pixels that a slot holds, in pixels, over L imagined
steps from one parsed frame.

Shapes: W windows, L steps, K prototypes, S places, N slots, D slot width, H W image size. A latent is ([N,] Z).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.evaluation.card_lines import EFFECTS, MEASURES, NO_LATENTS, Line, line
from playslot_rl.evaluation.latent_lines import ParsedEpisodes
from playslot_rl.frames import to_uint8
from playslot_rl.modules.savi.health import LEAST_SHARE, owners
from playslot_rl.seeds.draws import derived_seed
from playslot_rl.world_model import WorldModel, module_device

Floats = npt.NDArray[np.float64]
AT_ONCE = 32
"""Frames decoded at a time: bounds the memory."""
MOVES = 1.0
"""Pixels over L steps, from which on a slot counts as moving."""
TURNOVER = 0.2
"""Share of the pixels held before or after L steps that are held only once, from which on a slot counts as moving."""


@dataclass(frozen=True)
class Drawn:
    """Decoded slots: frames uint8 (M, H, W, 3) and which slot holds each pixel, int64 (M, H, W)."""

    frames: npt.NDArray[np.uint8]
    labels: npt.NDArray[np.int64]


@torch.no_grad()
def draw(model: WorldModel, slots: Tensor) -> Drawn:
    frames, labels = [], []
    for some in slots.split(AT_ONCE):
        decoded = model.savi.decode(some)
        frames.append(to_uint8(decoded.frames))
        labels.append(owners(decoded.masks).cpu().numpy())
    return Drawn(np.concatenate(frames), np.concatenate(labels))


@torch.no_grad()
def replay(model: WorldModel, start: Tensor, latents: Tensor) -> Tensor:
    """Slots (M, L, N, D) imagined from slots (M, N, D) under latents (M, L, [N,] Z)."""
    return model.predictor.rollout(start[:, None], *model.inverse_dynamics.split(latents))


def centroids(labels: npt.NDArray[np.int64], n_slots: int) -> tuple[Floats, Floats]:
    """Centroids (M, N, 2) as x, y in pixels, NaN for a slot that holds nothing, and shares (M, N) of the pixels."""
    h, w = labels.shape[1:]
    held = np.eye(n_slots)[labels.reshape(len(labels), -1)]
    y, x = np.divmod(np.arange(h * w), w)
    count = held.sum(1)
    with np.errstate(invalid="ignore", divide="ignore"):
        where = np.stack([np.einsum("mpn,p->mn", held, axis.astype(float)) / count for axis in (x, y)], -1)
    return where, count / (h * w)


def displacements(before: npt.NDArray[np.int64], after: npt.NDArray[np.int64], n_slots: int) -> Floats:
    """How far each slot moved, (M, N, 2) in pixels; 0 for one that holds less than `LEAST_SHARE` of either frame."""
    (a, held_a), (b, held_b) = centroids(before, n_slots), centroids(after, n_slots)
    seen = (held_a >= LEAST_SHARE) & (held_b >= LEAST_SHARE)
    moved: Floats = np.where(seen[..., None], np.nan_to_num(b - a), 0.0)
    return moved


def agreement(one: Floats, other: Floats) -> float | None:
    """Correlation of displacements (W, N, 2), each slot's and axis's mean taken off; None if nothing varies.

    All slots count by how far they move, so that a still background does not.
    """
    a, b = one - one.mean(0), other - other.mean(0)
    size = float(np.sqrt((a**2).sum() * (b**2).sum()))
    return float((a * b).sum()) / size if size > 1e-9 else None


def same_mover(one: Floats, other: Floats) -> float | None:
    """Share of the windows (W, N, 2) in which one slot moves most in both, of those in which one moves by `MOVES` in
    `one`.
    """
    a, b = np.linalg.norm(one, axis=-1), np.linalg.norm(other, axis=-1)
    moving = a.max(1) >= MOVES
    if not moving.any():
        return None
    return float(((a.argmax(1) == b.argmax(1)) & (b.max(1) > 0))[moving].mean())


def explained_by_group(effects: Floats) -> float | None:
    """Share of the variance of effects (K, S, ...) that lies between the K groups, adjusted for their number: 1 -
    (within / (K S - K)) / (total / (K S - 1)). 1 where a group has one effect, about 0 where groups say nothing (it may
    be below); None where nothing varies, or there is one group or place.
    """
    k, s = effects.shape[:2]
    flat = effects.reshape(k, s, -1)
    within = float(((flat - flat.mean(1, keepdims=True)) ** 2).sum())
    total = float(((flat - flat.mean((0, 1))) ** 2).sum())
    if k < 2 or s < 2 or total < 1e-9:
        return None
    return 1.0 - (within / (k * s - k)) / (total / (k * s - 1))


@dataclass(frozen=True)
class Region:
    """The shares of the squared change and of the pixels that lie inside a region."""

    share: float
    area: float

    @property
    def excess(self) -> float:
        """0 where the change is spread over the picture evenly, 1 where all of it is inside; may be below 0."""
        return (self.share - self.area) / (1.0 - self.area) if self.area < 1 else 0.0


def change_in(change: Floats, inside: npt.NDArray[np.bool_]) -> Region | None:
    """How much of squared changes (W, H, W) is inside a region of the same shape; None if nothing changes."""
    total = float(change.sum())
    return Region(float(change[inside].sum()) / total, float(inside.mean())) if total > 0 else None


def squared_change(one: npt.NDArray[np.uint8], other: npt.NDArray[np.uint8]) -> Floats:
    """Squared difference of pictures (W, H, W, 3) in [0, 1], mean over the colours: (W, H, W)."""
    changed: Floats = (((one.astype(np.float64) - other) / 255.0) ** 2).mean(-1)
    return changed


def moving_slots(before: npt.NDArray[np.int64], after: npt.NDArray[np.int64], n_slots: int) -> npt.NDArray[np.int64]:
    """Slots that move from some frames to others (W, H, W): by `MOVES` pixels in the root mean square, and
    so that `TURNOVER` of what they hold is elsewhere. What an arm only uncovers, a ground, is not among them.
    """
    moved = displacements(before, after, n_slots)
    far = np.sqrt((moved**2).sum(-1).mean(0)) >= MOVES
    slots = np.arange(n_slots)[:, None]
    held, then = (labels.reshape(1, -1) == slots for labels in (before, after))
    either = (held | then).sum(1)
    turnover = 1.0 - (held & then).sum(1) / np.maximum(either, 1)
    return np.flatnonzero(far & (turnover >= TURNOVER)).astype(np.int64)


STEPS = 5
"""L, steps that latents are replayed or held for."""
WINDOWS = 64
PLACES = 16
"""S, windows from whose first frame each prototype is held."""
STILL = "no slot moves in these videos"
SINGLE_EPISODE = "a single held-out episode"


@dataclass(frozen=True)
class Windows:
    """Windows of held-out episodes: slots as parsed (W, L + 1, N, D), latents (W, L, [N,] Z), frames uint8 (W, L + 1,
    H, W, 3), and twice a window of another episode for each (W,), -1 where there is one episode only.
    """

    slots: Tensor
    latents: Tensor
    frames: npt.NDArray[np.uint8]
    others: npt.NDArray[np.int64]
    thirds: npt.NDArray[np.int64]


@dataclass(frozen=True)
class Replayed:
    """What the page shows of the replays of the same windows.

    Attributes:
        start, true: the first and the last frame as their parsed slots are drawn.
        own, taken, swapped: imagined after L steps under the own latents; from the first frame of `others` under the
            own ones; under the latents of `others`.
        region: where the slots that move are, bool (W, H, W).
        held: (K', 2, H, W, 3): each used prototype held from two places; None without prototypes.
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
    steps = min(STEPS, int(parsed.source.lengths[parsed.tested_episodes].max()) - 1)
    rows, pixels, of = parsed.windows(steps + 1, WINDOWS)
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
    """Replay, transfer, constancy and sensitivity, in windows of the tested episodes; the seed draws the partners,
    `used` are the codes that the tested episodes use, none without prototypes.
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
    lines, details = transfer_lines(shown, n, model.config.inverse_dynamics.seen(n))
    constancy, held, table = _constancy(model, windows, used)
    sensitivity, region = _sensitivity(shown, details["moving_slots"])
    details |= {"prototypes": table, "steps": windows.latents.shape[1], "windows": len(first)}
    shown = replace(shown, region=region, held=held, codes=tuple(used))
    return [*lines, constancy, *sensitivity], details, shown


def transfer_lines(shown: Replayed, n: int, told: list[int]) -> tuple[list[Line], dict[str, Any]]:
    moved = displacements(shown.start.labels, shown.true.labels, n)[:, told]
    count, steps = moved.shape[0], shown.windows.latents.shape[1]
    of = "" if len(told) == n else f", slots {', '.join(str(slot + 1) for slot in told)}"
    what = f"{count} windows of {steps} steps{of}"
    own = agreement(moved, displacements(shown.start.labels, shown.own.labels, n)[:, told])
    lines = [line("replay", own, what if own is not None else STILL)]
    details: dict[str, Any] = {"moving_slots": moving_slots(shown.start.labels, shown.true.labels, n).tolist()}
    if shown.taken is None:
        keys = ("transfer", "transfer_shuffled", "same_slot")
        return [*lines, *(line(key, None, SINGLE_EPISODE) for key in keys)], details
    elsewhere = displacements(shown.start.labels[shown.windows.others], shown.taken.labels, n)[:, told]
    alike = agreement(moved, elsewhere)
    wrong, mover = moved[shown.windows.thirds], same_mover(moved, elsewhere)
    chance = same_mover(wrong, elsewhere)
    said = (
        "no other window to compare with moves"
        if chance is None
        else f"with the motion of another window: {chance:.2f}"
    )
    return [
        *lines,
        line("transfer", alike, what if alike is not None else STILL),
        line("transfer_shuffled", agreement(wrong, elsewhere), what if alike is not None else STILL),
        line("same_slot", mover, STILL if mover is None else said),
    ], details


def _constancy(
    model: WorldModel, windows: Windows, used: list[int]
) -> tuple[Line, npt.NDArray[np.uint8] | None, list[dict[str, Any]]]:
    """The line, pictures of two places, and what each prototype does on average."""
    if not used:
        return line("constancy", None, f"mode {model.config.inverse_dynamics.mode} has no prototypes"), None, []
    count, steps, n = len(windows.slots), windows.latents.shape[1], model.slot_shape[0]
    told = model.config.inverse_dynamics.seen(n)  # what moves by itself in other slots is not theirs to repeat
    places = np.unique(np.linspace(0, count - 1, min(PLACES, count)).round().astype(int))
    start = windows.slots[places, 0]
    before = draw(model, start)
    shape = (len(places), steps, *model.latent_shape)
    effects, pictures, table = [], [], []
    for code in used:
        after = draw(model, replay(model, start, model.inverse_dynamics.prototypes[code].expand(shape))[:, -1])
        effect = displacements(before.labels, after.labels, n)[:, told]
        effects.append(effect)
        pictures.append(after.frames[[0, -1]])
        mean, slot = effect.mean(0), int(np.linalg.norm(effect.mean(0), axis=-1).argmax())
        spread = float(np.sqrt(((effect[:, slot] - mean[slot]) ** 2).sum(-1).mean()))
        table.append({"code": code, "slot": told[slot], "pixels": mean[slot].tolist(), "spread": spread})
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
