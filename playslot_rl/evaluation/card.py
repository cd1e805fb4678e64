"""The report card of a world model on one data set: `inspect.json`."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from playslot_rl.config import DataConfig
from playslot_rl.data.demonstrations import probed_actions
from playslot_rl.data.neighbours import in_batches
from playslot_rl.data.slot_cache import parse_episodes
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.errors import DataError
from playslot_rl.evaluation.card_lines import MEASURES, NO_NUMBERS, WORDS, Line, conclude, line, settle, worthless
from playslot_rl.evaluation.effects import Replayed, effect_lines
from playslot_rl.evaluation.held_out import HeldOut, hold_out
from playslot_rl.evaluation.latent_lines import ParsedEpisodes, action_lines, usage_lines
from playslot_rl.evaluation.probes import infer_latents
from playslot_rl.evaluation.success import hardware
from playslot_rl.frames import normalise
from playslot_rl.modules.savi.health import MOVING, SlotHealth
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.logging import finite
from playslot_rl.world_model import WorldModel, module_device

FORMAT: Final = "playslot_rl.inspect/1"
FOLDER: Final = "inspect"
"""Of the card, below the run's."""
RESULT: Final = Path(FOLDER) / "inspect.json"
DEFAULT_EPISODES: Final = 200
HEALTH_CLIPS: Final = 32
HEALTH_FRAMES: Final = 8
CLIPS_AT_ONCE: Final = 8


@dataclass(frozen=True)
class Card:
    """What was measured: lines in the order of the page, the plain values behind them, and what the pictures show."""

    lines: list[Line]
    details: dict[str, Any]
    held_out: HeldOut
    replayed: Replayed
    parsed: ParsedEpisodes


def make_card(
    model: WorldModel,
    source: EpisodeFrames,
    metas: Mapping[str, Mapping[str, Any]],
    data: DataConfig,
    most: int = DEFAULT_EPISODES,
    seed: int = 0,
) -> Card:
    """Measure a world model in evaluation mode on at most so many episodes (`hold_out`) of the model's frame size, with
    actions or without; the seed is that of wrong pairs, noise and partners. A DataError where no episode has two
    frames, nothing moves, or actions have the wrong width for mode `ground_truth`.
    """
    held = hold_out(source, metas, data, most)
    chosen, tested = held.subset(source)
    require_motion(chosen, tested)
    if model.config.inverse_dynamics.mode == "ground_truth":
        chosen.require_actions(model.env.action_dim)
    with global_seed(seed, 0, "inspect"):  # for latents that are sampled, and for nothing else
        parsed = parse(model, chosen, tested)
        usage, details = usage_lines(model, parsed)
        numbers = bool(np.isfinite(parsed.slots).all() and np.isfinite(parsed.latents).all())
        actions, probes = action_lines(model, parsed, seed) if numbers else ([], {})
        used = [code for code, count in enumerate(details.get("code_counts", [])) if count]
        effects, replays, replayed = effect_lines(model, parsed, seed, used)
        health, values = health_lines(model, parsed)
    lines = settle([*usage, *actions, *effects, *health])
    if not numbers:
        lines = [line(key, None, NO_NUMBERS) for key in MEASURES]
    return Card(lines, details | probes | replays | {"slots": values}, held, replayed, parsed)


def require_motion(source: EpisodeFrames, tested: Any) -> None:
    """A DataError where no pixel of a tested episode changes by `MOVING` between frames that follow each other."""
    largest = 0
    for start, length in zip(source.starts[tested], source.lengths[tested], strict=True):
        frames = np.asarray(source.frames[start : start + length]).astype(np.int16)
        largest = max(largest, int(np.abs(np.diff(frames, axis=0)).max()))
    if largest < 255 * MOVING:
        raise DataError(
            f"data.root: got frames that never change (by {largest} of 255 at most), expected videos in which "
            f"something moves by {math.ceil(255 * MOVING)} or more: use other videos, or every few frames of them"
        )


def parse(model: WorldModel, source: EpisodeFrames, tested: Any) -> ParsedEpisodes:
    """Slots and latents of episodes, parsed from their first frames on."""
    device = module_device(model)
    slots = np.concatenate(list(parse_episodes(source, model.savi, device)))
    lengths = source.lengths
    starts = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)
    frames = np.concatenate([s + np.arange(n) for s, n in zip(source.starts, lengths, strict=True)])
    real = None if source.actions is None else np.asarray(source.actions[frames])
    latents, codes, episodes = infer_latents(model.inverse_dynamics, slots, starts, lengths, real)
    rows = np.concatenate([s + np.arange(n - 1) for s, n in zip(starts, lengths, strict=True)])
    actions = probed_actions(source, frames[rows])
    return ParsedEpisodes(source, slots, starts, tested, latents, codes, rows, frames[rows], episodes, actions)


@torch.no_grad()
def health_lines(model: WorldModel, parsed: ParsedEpisodes) -> tuple[list[Line], dict[str, float]]:
    """Slots in use, flicker, entropy and motion explained, on clips of the tested episodes."""
    device, n = module_device(model), model.slot_shape[0]
    frames = min(HEALTH_FRAMES, int(parsed.source.lengths[parsed.tested_episodes].max()))
    rows, pixels, _ = parsed.windows(frames, HEALTH_CLIPS)
    health = SlotHealth(n)
    for some in in_batches(np.arange(len(rows)), CLIPS_AT_ONCE):
        decoded = model.savi.decode(torch.from_numpy(parsed.slots[rows[some]]).to(device))
        health.add(normalise(parsed.source.pixels(pixels[some]).to(device)), decoded.frames, decoded.masks)
    values = health.values()
    clips, explained = f"{len(rows)} clips of {frames} frames", values.get("moving_explained")
    one, entropy = n == 1, values.get("mask_entropy", math.nan) / math.log(max(2, n))
    in_use = line("slots_in_use", values["slots_in_use"] / n, f"{values['slots_in_use']:.1f} of {n}, {clips}")
    if not one and worthless("mask_entropy", entropy):
        in_use = in_use.without_value(WORDS["mask_entropy"])  # whoever is a hair ahead holds a pixel
    return [
        in_use,
        line("flicker", None if one else values["flicker"], "a single slot" if one else clips),
        line("mask_entropy", None if one else entropy, "a single slot" if one else clips),
        line("moving_explained", explained, clips if explained is not None else "nothing moves in these clips"),
    ], finite(values)


def card_json(card: Card, source: EpisodeFrames, facts: Mapping[str, Any], began: float) -> dict[str, Any]:
    """The card as JSON holds it, with the `facts` of run, data set and seed; `began` is of `time.perf_counter`."""
    held = card.held_out
    return {
        "format": FORMAT,
        **facts,
        "data_fingerprint": source.fingerprint,
        "camera": source.camera,
        "episodes_tested": held.tested.tolist(),
        "episodes_fitted": len(held.fitted),
        "held_out": held.told_by,
        "held_out_known": held.known,
        "lines": (lines := [one.plain() for one in card.lines]),
        "verdict": asdict(conclude(lines, card.details.get("code_counts", []), len(held.tested))),
        "details": card.details,
        "wall_seconds": round(time.perf_counter() - began, 2),
        "hardware": hardware(),
    }
