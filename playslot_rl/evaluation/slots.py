"""Slots scored against the simulator's own segmentation, on episodes of the scripted expert that no training has seen.

    ARI = adjusted Rand index of (slot with the largest mask, object) over a clip's pixels; FG-ARI: over objects' alone

Shapes: E episodes, T agent steps (T + 1 frames), N slots, H W image size. Label images count from 0, the ground.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch

from playslot_rl.config import ExperimentConfig
from playslot_rl.envs import PROCEDURAL, RECORDED, make_env
from playslot_rl.envs.grid_shapes import generate
from playslot_rl.evaluation.objects import adjusted_rand_index
from playslot_rl.evaluation.seeds import held_out_seeds
from playslot_rl.evaluation.success import hardware
from playslot_rl.frames import psnr, to_float
from playslot_rl.modules.savi import SAVi
from playslot_rl.modules.savi.health import owners
from playslot_rl.runs import Run
from playslot_rl.seeds.episodes import episode_seed
from playslot_rl.storage.atomic import write_json
from playslot_rl.world_model import module_device

DEFAULT_EPISODES: Final = 20
RESULT: Final = Path("evaluation") / "slots" / "eval_info.json"
"""The result, relative to the folder that is written."""
Segmented = tuple[npt.NDArray[np.uint8], npt.NDArray[np.int64]]
"""Frames (T + 1, H, W, 3) and which object each pixel shows (T + 1, H, W)."""


def segmented_episode(env: Any, seed: int, steps: int) -> Segmented:
    """The scripted expert's episode of a `PixelTask`, T steps long."""
    frames, labels = [env.reset(seed=seed)[0]["pixels"]], [env.segment()]
    for _ in range(steps):
        frames.append(env.step(env.expert_action())[0]["pixels"])
        labels.append(env.segment())
    return np.stack(frames), np.stack(labels)


def segmented_episodes(config: ExperimentConfig, seeds: Sequence[int]) -> Iterator[Segmented]:
    """One after the other: the expert's episodes of a simulated task, or GridShapes' clips; `env.max_steps` is T."""
    if config.env.name in PROCEDURAL:
        for seed in seeds:
            clips = generate([seed], config.env.max_steps, config.env)
            yield clips.frames[0], clips.masks[0].astype(np.int64)
        return
    env = make_env(config.env, config.render).unwrapped
    try:
        for seed in seeds:
            yield segmented_episode(env, seed, config.env.max_steps)
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
        decoded = savi.decode(savi(real, generator=torch.Generator(device).manual_seed(seed))[0])
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
    ConfigError where a training data set holds one of the seeds.
    """
    began = time.perf_counter()
    seeds = held_out_seeds(config, config.seed, config.episodes or DEFAULT_EPISODES, run.folder)
    result = {
        "protocol": "slots",
        "episodes": len(seeds),
        "seed": config.seed,
        "seeds": seeds,
        **score_slots(run.load_savi(device), segmented_episodes(config, seeds), seeds),
        "fingerprints": {"slots": run.stage("slots").fingerprint},
        "wall_seconds": round(time.perf_counter() - began, 2),
        "hardware": hardware(),
    }
    write_json(out / RESULT, result)
    return result
