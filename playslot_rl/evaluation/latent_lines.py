"""The card's lines on latents: how many kinds and directions, how much of the real action they carry, with controls,
and whether what changes in the slots is of the action at all.

Shapes: M transitions, Z latent-action width (N * Z with one latent per slot), A action width, N slots, D slot width.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.windows import spread_windows
from playslot_rl.evaluation.card_lines import ACTIONS, MEASURES, NO_LATENTS, UNTOLD, Line, line
from playslot_rl.evaluation.probes import (
    Floats,
    Ints,
    code_table,
    codebook_usage,
    linear_probe,
    participation_ratio,
    probe_actions,
    repaired,
)
from playslot_rl.frames import normalise
from playslot_rl.modules.inverse_dynamics import InverseDynamics
from playslot_rl.seeds.draws import derived_seed, step_generator
from playslot_rl.world_model import WorldModel, module_device

NOISE = 0.02
"""Standard deviation of the camera noise, of the range [0, 1] of a pixel: five of 255."""
PAIRS_AT_ONCE = 64
NOTHING = 0.05
"""R² that is nothing, up or down: what chance does to a probe that finds nothing."""


@dataclass(frozen=True)
class ParsedEpisodes:
    """Episodes as a world model sees them, transition by transition; whole episodes are tested.

    Attributes:
        slots: (F, N, D) of all their frames, in order.
        starts: row of `slots` of each episode's first frame (E,).
        tested_episodes: (E,).
        latents: (M, Z) or (M, N * Z).
        codes: (M, 1) or (M, N), -1 without a codebook.
        rows: row of `slots` that a transition starts from (M,).
        pixels: row of the source's frames, likewise.
        episodes: episode of each transition (M,).
        actions: (M, A), scaled as they are learned, NaN where they are not known, or None.
    """

    source: EpisodeFrames
    slots: Floats
    starts: Ints
    tested_episodes: npt.NDArray[np.bool_]
    latents: Floats
    codes: Ints
    rows: Ints
    pixels: Ints
    episodes: Ints
    actions: Floats | None

    def windows(self, frames: int, most: int) -> tuple[Ints, Ints, Ints]:
        """At most so many windows of the tested episodes: rows of `slots` and of the source's frames, and the episode
        (W,).
        """
        rows = spread_windows(self.starts, self.source.lengths, frames, most, np.flatnonzero(self.tested_episodes))
        of = np.searchsorted(self.starts, rows[:, 0], side="right") - 1
        return rows, rows + (self.source.starts - self.starts)[of][:, None], of

    def take(self, kept: npt.NDArray[np.bool_]) -> ParsedEpisodes:
        """Some of the transitions (M,)."""
        parts = ("latents", "codes", "rows", "pixels", "episodes", "actions")
        return replace(self, **{name: getattr(self, name)[kept] for name in parts})

    @property
    def tested(self) -> npt.NDArray[np.bool_]:
        """Transitions that are tested (M,)."""
        return self.tested_episodes[self.episodes]


def usage_lines(model: WorldModel, parsed: ParsedEpisodes) -> tuple[list[Line], dict[str, Any]]:
    """Codes in use, perplexity, directions; and for the page, the counts of the codes and what was done under each."""
    k, tested = model.inverse_dynamics.n_prototypes, parsed.tested
    width = model.inverse_dynamics.latent_dim
    ratio, within = None, NO_LATENTS
    if width:
        latents = parsed.latents[tested].reshape(-1, width)
        ratio = participation_ratio(latents)
        within = "the latents do not vary" if ratio is None else f"of {width}, over {len(latents)} latents"
    directions = line("directions", ratio, within)
    if not k:
        why = f"mode {model.config.inverse_dynamics.mode} has no prototypes"
        return [line("codes_in_use", None, why), line("perplexity", None, why), directions], {}
    usage, done = codebook_usage(parsed.codes[tested], k), []
    if parsed.actions is not None and parsed.codes.shape[1] == 1:
        known = tested & np.isfinite(parsed.actions).all(axis=1)
        done = code_table(parsed.codes[known, 0], parsed.actions[known], k)
    return [
        line("codes_in_use", usage["used"] / k, f"{usage['used']} of {k}"),
        line("perplexity", usage["perplexity"] / k, f"{usage['perplexity']:.1f} of {k}"),
        directions,
    ], {"code_counts": usage["counts"], "code_actions": done}


def action_lines(model: WorldModel, parsed: ParsedEpisodes, seed: int) -> tuple[list[Line], dict[str, Any]]:
    """Probes of the real action with their controls; all `not measured` where that cannot be."""
    missing = ""
    if not model.inverse_dynamics.latent_dim:
        missing = NO_LATENTS
    elif model.config.inverse_dynamics.mode == "ground_truth":
        missing = "latents are the real actions (mode ground_truth)"
    lines: dict[str, Line] = {}
    scores: dict[str, Any] = {}
    slots: list[dict[str, Any]] = []
    if not missing:
        noisy = noise_latents(model, parsed, seed)
        lines["noise_size"] = _noise_size(noisy[parsed.tested], parsed.latents[parsed.tested])
        if parsed.actions is None:
            given = parsed.source.actions
            bad = 0 if given is None else int((~np.isfinite(given[parsed.pixels])).any(axis=1).sum())
            missing = f"NaN or infinite actions in {bad} of {len(parsed.rows)} transitions" if bad else "no actions"
        elif parsed.tested_episodes.all():
            missing = "no other episodes to fit a probe on"
        else:
            known = np.asarray(np.isfinite(parsed.actions).all(axis=1))
            of = "" if known.all() else f"; {known.sum()} of {len(known)} transitions have actions"
            acted = parsed.take(known)
            missing, scores = _scores(acted, noisy[known], seed)
            if scores:
                slots = telling_slots(acted)
                lines |= _probe_lines(scores, of) | {"telling_slots": _telling_line(model.inverse_dynamics, slots)}
    keys = [key for key, measure in MEASURES.items() if measure.group == ACTIONS]
    details = {"probes": scores} | ({"telling_slots": slots} if slots else {})
    return [lines.get(key) or line(key, None, missing) for key in keys], details


def _scores(parsed: ParsedEpisodes, noisy: Floats, seed: int) -> tuple[str, dict[str, Any]]:
    """Why there are none, or else what is seen -> result of `probe_actions`."""
    actions = parsed.actions
    if actions is None or not parsed.tested.any() or parsed.tested.all():
        return "no actions in the tested episodes, or in no others", {}
    wrong = repaired(np.arange(len(parsed.rows)), parsed.tested, derived_seed(seed, 0, "wrong pairs"))
    seen = {
        "latent": parsed.latents,
        "shuffled": parsed.latents[wrong],
        "frame": parsed.slots[parsed.rows].reshape(len(parsed.rows), -1),
        "noise": noisy,
    }
    scores = {name: probe_actions(x, actions, parsed.episodes, tested=parsed.tested) for name, x in seen.items()}
    if scores["latent"]["linear"]["mean_r2"] is None:
        return "the tested actions hardly vary", {}
    before = np.nonzero(np.diff(parsed.rows) == 1)[0]  # an episode's last one has none after it
    episodes, tested = parsed.episodes[before], parsed.tested[before]
    if tested.any() and not tested.all():
        seen = {"prompt": parsed.latents[before], "late": parsed.latents[before + 1]}  # of the same transitions
        pair = {name: probe_actions(x, actions[before], episodes, tested=tested) for name, x in seen.items()}
        scores |= pair if pair["late"]["linear"]["mean_r2"] is not None else {}
    return "", scores


def _probe_lines(scores: dict[str, Any], of: str) -> dict[str, Line]:
    best = {name: max(score["linear"]["mean_r2"], score["mlp"]["mean_r2"]) for name, score in scores.items()}
    own, lag = scores["latent"], line("lag", None, "no transitions that others follow, or their actions do not vary")
    # A probe that fails on other episodes is no better the further it fails: differences end at about nothing.
    counted = {name: max(r2, -NOTHING) for name, r2 in best.items()}
    above = line("above_frame", counted["latent"] - counted["frame"], f"the frame alone: {best['frame']:.2f}")
    if best["latent"] <= 0:
        above = above.without_value(f"{UNTOLD}: {best['latent']:.2f}")
    if "late" in best:
        lag = line("lag", counted["late"] - counted["prompt"], f"one later: {best['late']:.2f}")
        if max(best["late"], best["prompt"]) <= 0:
            lag = lag.without_value(f"{UNTOLD}: {best['prompt']:.2f}")
    held = f"{own['test']} transitions of {own['test_episodes']} held-out episodes, fitted on {own['train']} others{of}"
    return {
        "linear_probe": line("linear_probe", own["linear"]["mean_r2"], held),
        "mlp_probe": line("mlp_probe", own["mlp"]["mean_r2"], held),
        "above_frame": above,
        "lag": lag,
        "shuffled_probe": line("shuffled_probe", best["shuffled"], "the better of both probes"),
        "noise_probe": line("noise_probe", best["noise"], "the better of both probes"),
    }


def telling_slots(parsed: ParsedEpisodes) -> list[dict[str, Any]]:
    """Of each slot its number, from 1, `change`, its share of the squared change of all slots in a transition, and
    `r2`, what a linear probe tells of the action from its change alone; None where the tested actions hardly vary.
    """
    actions, tested = parsed.actions, parsed.tested
    if actions is None:
        return []
    change = parsed.slots[parsed.rows + 1] - parsed.slots[parsed.rows]
    size = np.square(change, dtype=np.float64).sum((0, 2))
    return [
        {
            "slot": n + 1,
            "change": float(size[n] / max(size.sum(), 1e-12)),
            "r2": linear_probe(change[~tested, n], actions[~tested], change[tested, n], actions[tested])["mean_r2"],
        }
        for n in range(change.shape[1])
    ]


def _telling_line(model: InverseDynamics, slots: Sequence[Mapping[str, Any]]) -> Line:
    """Of the change that the latents see, how much is in slots that tell of the action; which slots to choose."""
    seen = [slots[n] for n in model.config.seen(len(slots))]
    telling = [one for one in seen if one["r2"] > NOTHING]
    told = ", ".join(f"{one['slot']} ({one['r2']:.2f})" for one in telling) or "none"
    share = sum(one["change"] for one in telling) / max(sum(one["change"] for one in seen), 1e-12)
    found = line("telling_slots", share, f"slots that tell, with their R²: {told}")
    if found.verdict == "good" or not telling or len(telling) == len(seen) or model.per_slot:
        return found
    # What hardly moves may be a goal, which a policy has to see.
    kept = [one for one in slots if one["r2"] > NOTHING or one["change"] * len(slots) <= 1]
    latents, policy = (",".join(str(one["slot"]) for one in chosen) for chosen in (telling, kept))
    note = f"{found.note}; model.inverse_dynamics.slots=[{latents}] leaves out the others"
    if len(kept) < len(slots):
        note += f", model.policy.slots=[{policy}] those that move most and tell nothing"
    return replace(found, note=note)


def _noise_size(noisy: Floats, real: Floats) -> Line:
    size = float(np.sqrt(np.square(real, dtype=np.float64).mean()))
    if size < 1e-9:
        return line("noise_size", None, "the latents are all zero")
    ratio = float(np.sqrt(np.square(noisy, dtype=np.float64).mean())) / size
    return line("noise_size", ratio, f"noise of {NOISE:.0%} of a pixel's range, {len(noisy)} frames")


@torch.no_grad()
def noise_latents(model: WorldModel, parsed: ParsedEpisodes, seed: int) -> Floats:
    """The latent (M, Z) between each transition's first frame and the same frame with camera noise, parsed after it."""
    device, savi = module_device(model), model.savi
    found = []
    for first in range(0, len(parsed.rows), PAIRS_AT_ONCE):
        some = slice(first, first + PAIRS_AT_ONCE)
        frames = normalise(parsed.source.pixels(parsed.pixels[some]).to(device))
        generator = step_generator(seed, first, "camera noise", device)
        noise = NOISE * torch.randn(frames.shape, generator=generator, device=device)
        before = torch.from_numpy(parsed.slots[parsed.rows[some]]).to(device)
        after, _ = savi((frames + noise).clamp(0, 1)[:, None], savi.transition(before), generator)
        latent = model.inverse_dynamics(torch.stack([before, after[:, 0]], 1)).mean[:, 0]
        found.append(latent.flatten(1).cpu().numpy())
    return np.concatenate(found)
