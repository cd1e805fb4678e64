"""The contact sheet of `env.variation.*`, docs/images/variation.png: `.venv/bin/python docs/_site/variations.py`.

Rows are tasks; columns the plain frame, each variation alone, all together, and all together nine agent steps later. It
prints frames a second of each, on one core.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from playslot_rl.config.env import VariationConfig
from playslot_rl.envs import make_env, task_config

OUT = Path(__file__).resolve().parents[1] / "images" / "variation.png"
TASKS = ("button_press", "metaworld/drawer-open", "block_push_easy")
EACH: dict[str, dict[str, Any]] = {
    "plain": {},
    "background": {"background": True},
    "textures": {"textures": True},
    "shake": {"shake": 1.0},
    "light": {"light": 1.0},
    "colours": {"colours": 0.7},
    "object": {"object": True},
}
ALL = {key: value for one in EACH.values() for key, value in one.items()}
SEED, ZOOM, GAP, STEPS = 5, 2, 4, 9


def frames(task: str, variation: dict[str, Any]) -> list[np.ndarray]:
    env: Any = make_env(replace(task_config(task), variation=VariationConfig(**variation))).unwrapped
    found = [env.reset(seed=SEED)[0]["pixels"]]
    for _ in range(STEPS):
        found.append(env.step(env.expert_action())[0]["pixels"])
    began = time.perf_counter()
    for _ in range(40):
        env.draw()
    print(f"{task:>16} {','.join(variation) or 'plain':<50} {40 / (time.perf_counter() - began):4.0f} frames a second")
    env.close()
    return found


def main() -> None:
    rows = []
    for task in TASKS:
        shown = [frames(task, variation)[0] for variation in EACH.values()]
        together = frames(task, ALL)
        shown += [together[0], together[STEPS]]
        rows.append(
            np.concatenate([np.pad(frame, ((GAP, 0), (GAP, 0), (0, 0)), constant_values=255) for frame in shown], 1)
        )
    sheet = Image.fromarray(np.concatenate(rows))
    sheet.resize((ZOOM * sheet.width, ZOOM * sheet.height), Image.Resampling.NEAREST).save(OUT, optimize=True)
    print(OUT)


if __name__ == "__main__":
    main()
