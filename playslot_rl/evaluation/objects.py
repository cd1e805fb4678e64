"""Slots and latent actions scored against known objects and moves (GridShapes), and slots against the simulator's own
segmentation of the expert's episodes, on clips that no training has seen.

    ARI = adjusted Rand index of (slot with the largest mask, object) over a clip's pixels; FG-ARI: over objects' alone

Shapes: C clips, E episodes, T steps (T + 1 frames), O objects, N slots, Z latent-action width, K prototypes, H W image
size. Label images count from 0, the ground.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.config import ExperimentConfig
from playslot_rl.envs import PROCEDURAL, RECORDED, has_parts, make_env
from playslot_rl.envs.grid_shapes import MOVES, Clips, generate
from playslot_rl.errors import ConfigError
from playslot_rl.evaluation.held_out import held_out_seeds
from playslot_rl.evaluation.probes import probe_moves
from playslot_rl.evaluation.success import hardware, task_facts
from playslot_rl.evaluation.video import video_metrics
from playslot_rl.frames import psnr, to_float
from playslot_rl.modules.savi import SAVi
from playslot_rl.modules.savi.health import owners
from playslot_rl.runs import Run
from playslot_rl.seeds.episodes import episode_seed
from playslot_rl.storage.atomic import write_json
from playslot_rl.world_model import WorldModel, module_device

DEFAULT_CLIPS: Final = 100
CLIPS_AT_ONCE: Final = 10
SEED_FRAMES: Final = 6
"""Parsed frames before the predicted ones, as in the paper's table."""
PREDICTED_FRAMES: Final = 15
RESULT: Final = Path("evaluation") / "objects" / "eval_info.json"
"""The result, relative to the run folder."""
DEFAULT_SCENES: Final = 20
SLOTS_RESULT: Final = Path("evaluation") / "slots" / "eval_info.json"
"""The result, relative to the folder that is written."""
Segmented = tuple[npt.NDArray[np.uint8], npt.NDArray[np.int64]]
"""Frames (T + 1, H, W, 3) and which object each pixel shows (T + 1, H, W)."""


@dataclass(frozen=True)
class ParsedClips:
    """What a world model makes of clips.

    Attributes:
        labels: int64 (C, T + 1, H, W), slot with the largest mask.
        reconstructed: (C, T + 1, 3, H, W) float.
        prototypes, latents: (C, T, N, Z); with one latent a step (InvDyn_S) every slot has the same.
        codes: int64 (C, T, N).
        predicted: (C, P, 3, H, W), the frames that follow the seed frames.
    """

    labels: npt.NDArray[np.int64]
    reconstructed: Tensor
    prototypes: npt.NDArray[np.float32]
    latents: npt.NDArray[np.float32]
    codes: npt.NDArray[np.int64]
    predicted: Tensor


def seed_frames(steps: int) -> int:
    """Seed frames of clips of T steps: the paper's 6, or fewer in short clips."""
    return min(SEED_FRAMES, max(1, steps // 2))


@torch.no_grad()
def parse_clips(model: WorldModel, frames: npt.NDArray[np.uint8]) -> ParsedClips:
    """Parse clips (C, T + 1, H, W, 3), infer their latent actions and predict the frames after the seed frames."""
    slots = model.savi.parse(to_float(frames, module_device(model.savi)))
    decoded = model.savi.decode(slots)
    latent = model.inverse_dynamics(slots)
    seed = seed_frames(frames.shape[1] - 1)
    steps = min(seed - 1 + PREDICTED_FRAMES, frames.shape[1] - 1)
    p, v = latent.prototype[:, :steps], latent.variability[:, :steps]
    ahead = model.predictor.rollout(slots[:, :seed], p, v)[:, seed - 1 :]

    def per_slot(values: Tensor) -> npt.NDArray[Any]:
        if not model.inverse_dynamics.per_slot:
            values = values.unsqueeze(2).expand(*values.shape[:2], slots.shape[2], *values.shape[2:])
        return values.cpu().numpy()

    return ParsedClips(
        labels=owners(decoded.masks).cpu().numpy(),
        reconstructed=decoded.frames,
        prototypes=per_slot(latent.prototype),
        latents=per_slot(latent.mean),
        codes=per_slot(latent.code),
        predicted=model.savi.decode(ahead).frames,
    )


def _score(
    model: WorldModel, clips: Clips, first: int
) -> tuple[list[tuple[float, ...]], list[tuple[npt.NDArray[Any], ...]]]:
    """Scores of some clips, of which the first has the number `first`, and the transitions of their matched objects."""
    scores: list[tuple[float, ...]] = []
    transitions: list[tuple[npt.NDArray[Any], ...]] = []
    parsed = parse_clips(model, clips.frames)
    objects, slots = clips.moves.shape[2], model.slot_shape[0]
    real = to_float(clips.frames, parsed.predicted.device)
    seed = seed_frames(clips.moves.shape[1])
    again = video_metrics(parsed.reconstructed, real)
    ahead = video_metrics(parsed.predicted, real[:, seed : seed + parsed.predicted.shape[1]])
    for c, (masks, labels) in enumerate(zip(clips.masks, parsed.labels, strict=True)):
        ari, foreground = adjusted_rand_index(masks, labels), adjusted_rand_index(masks, labels, foreground=True)
        scores.append((ari, foreground, again.psnr, again.ssim, ahead.psnr, ahead.ssim))
        chosen = match_slots(masks, labels, objects, slots)
        for o in np.flatnonzero(chosen >= 0):
            n, moves = chosen[o], clips.moves[c, :, o]
            of = np.full(len(moves), first + c, np.int64)
            transitions.append((parsed.prototypes[c, :, n], parsed.latents[c, :, n], parsed.codes[c, :, n], moves, of))
    return scores, transitions


def evaluate_objects(model: WorldModel, config: ExperimentConfig, clips: int, seeds: list[int]) -> dict[str, Any]:
    """Score a world model, in evaluation mode, on C clips, at least 2, of `env.max_steps` steps.

    Returns:
        `ari` and `foreground_ari` (means over clips), `reconstruction` and `prediction` (`psnr` in dB, `ssim`),
        `probes` (`prototype`, `latent`: see `probe_moves`), `codes` (K rows of counts by move; None without
        prototypes), `unmatched` (objects without a slot).
    """
    scores, transitions = [], []
    for first in range(0, clips, CLIPS_AT_ONCE):
        drawn = generate(seeds[first : first + CLIPS_AT_ONCE], config.env.max_steps, config.env)
        of_clips, of_objects = _score(model, drawn, first)
        scores += of_clips
        transitions += of_objects
    prototypes, latents, codes, moves, of = (np.concatenate(part) for part in zip(*transitions, strict=True))
    k = model.inverse_dynamics.n_prototypes
    probes = {"latent": probe_moves(latents, moves, of, len(MOVES), config.seed)}
    if k:
        probes = {"prototype": probe_moves(prototypes, moves, of, len(MOVES), config.seed), **probes}
    table = np.bincount(codes * len(MOVES) + moves, minlength=k * len(MOVES)).reshape(k, -1).tolist() if k else None
    ari, foreground, psnr, ssim, ahead_psnr, ahead_ssim = np.mean(scores, 0).tolist()
    seed = seed_frames(config.env.max_steps)
    return {
        "ari": ari,
        "foreground_ari": foreground,
        "reconstruction": {"psnr": psnr, "ssim": ssim},
        "prediction": {
            "psnr": ahead_psnr,
            "ssim": ahead_ssim,
            "seed_frames": seed,
            "predicted_frames": min(PREDICTED_FRAMES, config.env.max_steps + 1 - seed),
        },
        "probes": probes,
        "moves": list(MOVES),
        "codes": table,
        "objects": config.env.grid.objects,
        "unmatched": clips * config.env.grid.objects - len(transitions),
    }


def evaluate_run_objects(run: Run, model: WorldModel, config: ExperimentConfig) -> dict[str, Any]:
    """Score a run's world model on `config.episodes` clips (100) and write `RUN/evaluation/objects/eval_info.json`. A
    ConfigError for fewer than two clips, or where a training data set holds one of the seeds.
    """
    clips, began = config.episodes or DEFAULT_CLIPS, time.perf_counter()
    if clips < 2:
        raise ConfigError(f"episodes: got {clips}, expected at least 2, since a probe is tested on clips held out")
    seeds = held_out_seeds(config, config.seed, clips, run.folder)
    model.eval()
    result = {
        "protocol": "objects",
        "episodes": clips,
        "seed": config.seed,
        "seeds": seeds,
        **task_facts(config, config.seed),
        **evaluate_objects(model, config, clips, seeds),
        "fingerprints": {name: stage.fingerprint for name, stage in run.world_stages.items()},
        "wall_seconds": round(time.perf_counter() - began, 2),
        "hardware": hardware(),
    }
    write_json(run.folder / RESULT, result)
    return result


Labels = npt.NDArray[Any]


def adjusted_rand_index(truth: Labels, predicted: Labels, foreground: bool = False) -> float:
    """Agreement of two labellings of the same pixels, of any shape: 1 if equal up to names, about 0 for a random one.

    A clip is scored as a whole, as in SAVi's paper: a slot that changes its object in mid-clip loses. `foreground`
    leaves out the pixels whose truth is 0, the ground (FG-ARI). A ValueError where the shapes differ, or no pixel is
    left.
    """
    from sklearn.metrics import adjusted_rand_score

    if truth.shape != predicted.shape:
        raise ValueError(f"adjusted_rand_index: got {truth.shape} and {predicted.shape}, expected one shape")
    chosen = truth > 0 if foreground else np.ones_like(truth, bool)
    if not chosen.any():
        raise ValueError("adjusted_rand_index: got no pixel of an object, expected some")
    return float(adjusted_rand_score(truth[chosen], predicted[chosen]))


def overlaps(truth: Labels, predicted: Labels, objects: int, slots: int) -> npt.NDArray[np.float64]:
    """Intersection over union (O + 1, N) of ground and objects with the slots."""
    pairs = np.bincount(truth.ravel().astype(np.int64) * slots + predicted.ravel(), minlength=(objects + 1) * slots)
    both = pairs.reshape(objects + 1, slots).astype(np.float64)
    either = both.sum(1, keepdims=True) + both.sum(0, keepdims=True) - both
    found: npt.NDArray[np.float64] = both / np.maximum(either, 1.0)
    return found


def match_slots(truth: Labels, predicted: Labels, objects: int, slots: int) -> npt.NDArray[np.int64]:
    """The slot of each object (O,) in a clip (T, H, W) by the largest overlap in all, ground included; -1 where there
    are too few slots. Label o + 1 of `truth` is object o.
    """
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(overlaps(truth, predicted, objects, slots), maximize=True)
    chosen = np.full(objects + 1, -1, np.int64)
    chosen[rows] = columns
    return chosen[1:]


def segmented_episode(env: Any, seed: int, steps: int) -> Segmented:
    """The scripted expert's episode of a `PixelTask`, T steps long; random actions where it has none."""
    frames, labels = [env.reset(seed=seed)[0]["pixels"]], [env.segment()]
    drawn, width = np.random.default_rng(seed), env.action_space.shape
    for _ in range(steps):
        action = env.expert_action() if env.has_expert else drawn.uniform(-1, 1, width).astype(np.float32)
        frames.append(env.step(action)[0]["pixels"])
        labels.append(env.segment())
    return np.stack(frames), np.stack(labels)


def segmented_episodes(config: ExperimentConfig, seeds: Sequence[int]) -> Iterator[Segmented]:
    """One after the other: the expert's episodes of a simulated task, or GridShapes' clips; `env.max_steps` is T."""
    if config.env.name in PROCEDURAL:
        for seed in seeds:
            clips = generate([seed], config.env.max_steps, config.env)
            yield clips.frames[0], clips.masks[0].astype(np.int64)
        return
    env = make_env(config.acting, config.render).unwrapped
    try:
        for seed in seeds:
            yield segmented_episode(env, seed, config.acting.max_steps)
    finally:
        env.close()


@torch.no_grad()
def score_slots(savi: SAVi, episodes: Iterable[Segmented], seeds: Sequence[int]) -> dict[str, float]:
    """Parse E episodes by a SAVi in evaluation mode and compare slots with objects: means over episodes of `ari`,
    `foreground_ari`, `psnr` of the reconstructions (dB) and `slots_per_object`. The seeds are of initial slots that are
    drawn.
    """
    device, scores = module_device(savi), []
    for (frames, truth), seed in zip(episodes, seeds, strict=True):
        real = to_float(frames[None], device)
        decoded = savi.decode(savi.parse(real, seed))
        found = owners(decoded.masks[0]).cpu().numpy()
        ari, foreground = adjusted_rand_index(truth, found), adjusted_rand_index(truth, found, foreground=True)
        decibels = float(psnr((decoded.frames - real).square().mean()))
        scores.append((ari, foreground, decibels, slots_per_object(truth, found, savi.config.n_slots)))
    names = ("ari", "foreground_ari", "psnr", "slots_per_object")
    return dict(zip(names, np.mean(scores, 0).tolist(), strict=True))


def validation_scores(config: ExperimentConfig) -> Callable[[SAVi], dict[str, float]] | None:
    """What stage 1 asks of its slots at every validation: `foreground_ari` and `slots_per_object`.

    `slots.segmented_episodes` episodes of the task, of seeds that neither a collection nor an evaluation has, are drawn
    now and kept. None where the task has no segmentation, or nothing can be drawn on this machine, which a line says:
    a training needs no simulator.
    """
    if not config.slots.segmented_episodes or config.env.name in RECORDED:
        return None
    seeds = [episode_seed("development", config.seed, i) for i in range(config.slots.segmented_episodes)]
    try:
        if not has_parts(config.env):
            return None
        episodes = list(segmented_episodes(config, seeds))
    except Exception as error:  # noqa: BLE001  a simulator fails in as many ways as it has drivers
        said = str(error).partition("\n")[0]
        print(f"slots: warning: no FG-ARI while training, since {config.env.name} cannot be drawn here ({said})")
        return None

    def scores(savi: SAVi) -> dict[str, float]:
        found = score_slots(savi, episodes, seeds)
        return {name: found[name] for name in ("foreground_ari", "slots_per_object")}

    return scores


def slots_per_object(truth: npt.NDArray[np.int64], found: npt.NDArray[np.int64], slots: int) -> float:
    """Slots that hold at least a tenth of an object's pixels, averaged over the objects of a clip."""
    counts = []
    for label in np.unique(truth[truth > 0]):
        share = np.bincount(found[truth == label], minlength=slots) / (truth == label).sum()
        counts.append(int((share >= 0.1).sum()))
    return float(np.mean(counts)) if counts else 0.0


def evaluate_slots(run: Run, out: Path, config: ExperimentConfig, device: torch.device | str) -> dict[str, Any]:
    """Score a run's slots on `config.episodes` episodes (20) and write `OUT/evaluation/slots/eval_info.json`. A
    ConfigError where a training data set holds one of the seeds, or nobody knows the task's objects.
    """
    if not has_parts(config.env):
        raise ConfigError(
            f"protocol=slots: got env={config.env.full_name}, which draws itself and does not say what each pixel "
            "shows, expected a task in MuJoCo, or one whose class has `segment`"
        )
    began = time.perf_counter()
    seeds = held_out_seeds(config, config.seed, config.episodes or DEFAULT_SCENES, run.folder)
    result = {
        "protocol": "slots",
        "episodes": len(seeds),
        "seed": config.seed,
        "seeds": seeds,
        **task_facts(config, config.seed),
        **score_slots(run.load_savi(device), segmented_episodes(config, seeds), seeds),
        "fingerprints": {"slots": run.stage("slots").fingerprint},
        "wall_seconds": round(time.perf_counter() - began, 2),
        "hardware": hardware(),
    }
    write_json(out / SLOTS_RESULT, result)
    return result
