"""Records an episode of each task with its shipped policy and animates, beside it, what the world model imagines:

    make animation

The imagined frames follow from the first one alone, under the latent actions inferred from the recorded video.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image

import playslot_rl
from playslot_rl.config import EnvConfig
from playslot_rl.envs import make_env, task_env
from playslot_rl.envs.grid_shapes import generate
from playslot_rl.pretrained import episode
from playslot_rl.seeds.episodes import episode_seed
from playslot_rl.visualization.grid import side_by_side

ROOT: Final = Path(__file__).resolve().parents[2]
STEPS: Final = {"button_press": 20, "block_push_easy": 25, "block_push": 25}
"""Task and how many agent steps its episode has."""
SHOWN: Final = {"block_push": "four cubes", "button_press": "ButtonPress"}
"""Tasks that the animation shows, and what it calls them."""
PICTURES: Final = ("button_press", "block_push_easy", "block_push", "block_reach", "block_pick", "grid_shapes")
PICTURED: Final = 3
BLOCK: Final = 100
ANIMATION: Final = ROOT / "docs" / "images" / "imagined.webp"

Frames = npt.NDArray[np.uint8]


def record(env: str) -> Frames:
    """The first episode of the evaluation block that the shipped policy solves: (T, H, W, 3)."""
    model = playslot_rl.load(f"pretrained/{env}", device="cpu")
    task = make_env(env)
    for index in range(20):
        observation, info = task.reset(seed=episode_seed("evaluation", BLOCK, index))
        model.reset()
        frames, solved = [observation["pixels"]], False
        for _ in range(STEPS[env]):
            observation, _, _, _, info = task.step(model.act(observation["pixels"]))
            frames.append(observation["pixels"])
            solved = solved or bool(info["success"])
        if solved:
            break
    task.close()
    return np.stack(frames)


def imagined(env: str, video: Frames) -> Frames:
    """What is imagined from the first frame of a video; that frame, parsed and decoded, comes first: (T, H, W, 3)."""
    model = playslot_rl.load(f"pretrained/{env}", device="cpu")
    slots = model.parse(video)
    future = model.imagine(video[0], model.infer_actions(slots).z)
    decoded = model.decode(torch.cat([slots[:1], future])).frames.clamp(0, 1)
    frames: Frames = (decoded * 255).round().byte().permute(0, 2, 3, 1).numpy()
    return frames


def draw() -> bytes:
    """The animation, a WebP: each task's simulator and imagination side by side; the shorter episode waits."""
    clips = [frames for env in SHOWN for frames in (episode(env), imagined(env, episode(env)))]
    longest = max(len(clip) for clip in clips)
    held = [np.concatenate([clip, np.repeat(clip[-1:], longest - len(clip), axis=0)]) for clip in clips]
    columns = [label for title in SHOWN.values() for label in (f"{title}: simulator", "imagined")]
    first, *others = side_by_side(np.stack(held)[None], columns, [], scale=3)
    times = [150] * (longest - 1) + [1500]
    stream = io.BytesIO()
    first.save(stream, "WEBP", save_all=True, append_images=others, duration=times, loop=0, quality=70, method=6)
    return stream.getvalue()


def task_picture(env: str) -> Image.Image:
    """A frame of the scripted expert's episode, twice as large; of GridShapes a drawn clip's."""
    if env == "grid_shapes":
        frame: Frames = generate([PICTURED], 1, EnvConfig(name=env)).frames[0, 0]
    else:
        task = make_env(env)
        expert = task_env(task)
        observation, _ = task.reset(seed=PICTURED)
        for _ in range(4):
            observation, *_ = task.step(expert.expert_action())
        task.close()
        frame = observation["pixels"]
    return Image.fromarray(frame).resize((128, 128), Image.Resampling.NEAREST)


def main() -> None:
    """Record all, then draw."""
    for env in PICTURES:
        path = ROOT / "docs" / "images" / f"task_{env}.png"
        task_picture(env).save(path, optimize=True)
        print(path.relative_to(ROOT))
    for env in STEPS:
        path = ROOT / "playslot_rl" / "pretrained" / f"{env}.png"
        Image.fromarray(np.concatenate(list(record(env)), axis=1)).save(path, optimize=True)
        print(path.relative_to(ROOT))
    ANIMATION.write_bytes(draw())
    print(ANIMATION.relative_to(ROOT))


if __name__ == "__main__":
    main()
