"""How often the experts of Meta-World's fifty tasks solve them, and what these and OGBench's look like:

.venv/bin/python docs/_site/metaworld_tasks.py experts    results/metaworld.json; then: make tables
.venv/bin/python docs/_site/metaworld_tasks.py sheet      docs/images/metaworld.png
.venv/bin/python docs/_site/metaworld_tasks.py cubes      docs/images/ogbench.png (needs the extra ogbench)
"""

from __future__ import annotations

import datetime
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from playslot_rl.config.families import FAMILIES, OGBENCH
from playslot_rl.config.metaworld import TASKS
from playslot_rl.envs import make_env, task_env
from playslot_rl.seeds.episodes import episode_seed

ROOT: Final = Path(__file__).resolve().parents[2]
IMAGES: Final = ROOT / "docs" / "images"
FILE: Final = ROOT / "results" / "metaworld.json"
COLUMNS: Final = 5
LABEL: Final = 14
EPISODES: Final = 20
BLOCK: Final = 100
"""Of the evaluation stream."""

Frame = npt.NDArray[np.uint8]


def first_and_last(name: str, index: int = 0) -> Frame:
    """What an agent sees of an episode at its beginning and when the expert has solved it: (H, 2 W, 3)."""
    env = make_env(name).unwrapped
    begin = env.reset(seed=episode_seed("evaluation", BLOCK, index))[0]["pixels"]
    env.draw_steps = False
    solved = truncated = False
    while not (solved or truncated):
        _, _, _, truncated, info = env.step(env.expert_action())
        solved = info["success"]
    frames = np.hstack((begin, env.draw()))
    env.close()
    return frames


def sheet(tiles: dict[str, Frame]) -> Image.Image:
    """Tasks, `COLUMNS` side by side, each under its name."""
    height, width = next(iter(tiles.values())).shape[:2]
    rows = -(-len(tiles) // COLUMNS)
    picture = Image.new("RGB", (COLUMNS * (width + 4) - 4, rows * (height + LABEL)), "white")
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(size=10)
    for place, (task, tile) in enumerate(tiles.items()):
        left, top = place % COLUMNS * (width + 4), place // COLUMNS * (height + LABEL)
        draw.text((left + 2, top), task, fill="black", font=font)
        picture.paste(Image.fromarray(tile), (left, top + LABEL))
    return picture.quantize(256, Image.Quantize.MAXCOVERAGE)


def solved_after(task: str, steps: int | None = None) -> list[int | None]:
    """Agent steps after which the expert has solved each of the episodes; None where it has not."""
    env, found = task_env(make_env(f"metaworld/{task}")), []
    env.draw_steps = env.draw_resets = False
    for index in range(EPISODES):
        env.reset(seed=episode_seed("evaluation", BLOCK, index))
        count = steps or env.config.max_steps
        found.append(next((step for step in range(1, count + 1) if env.step(env.expert_action())[4]["success"]), None))
    env.close()
    return found


def row(task: str, steps: list[int | None]) -> list[Any]:
    """The task, its agent steps, how many episodes of a hundred are solved, and after how many agent steps."""
    solved = [step for step in steps if step is not None]
    median = int(np.median(solved)) if solved else None
    return [task, TASKS[task].steps, round(100 * len(solved) / len(steps)), median]


def experts() -> dict[str, Any]:
    """The file in results/."""
    rows = []
    for task in TASKS:
        rows.append(row(task, solved_after(task)))
        print(rows[-1], flush=True)
    commit = subprocess.run(["git", "rev-parse", "--short=7", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    titles: list[dict[str, str]] = [{"title": "`env.task`"}, {"title": "agent steps"}]
    titles += [{"title": "expert", "unit": "%"}, {"title": "solved after"}]
    made = {
        "rows": None,
        "command": [".venv/bin/python docs/_site/metaworld_tasks.py experts"],
        "commit": commit.stdout.strip(),
        "machine": "one thread of an Intel Xeon",
        "time": None,
        "date": datetime.date.today().isoformat(),
    }
    title = f"Meta-World's experts: success of {EPISODES} episodes, and the median agent step at which they are solved"
    hard = {"rows": [[task] for task, _, rate, _ in rows if rate < 100]}
    table = {"title": title, "columns": titles, "rows": rows, "made": [made], "views": {"hard": hard}}
    return {"question": "How often do Meta-World's experts solve its tasks?", "tables": {"metaworld": table}}


def main() -> None:
    if sys.argv[1:] in (["sheet"], ["cubes"]):
        tiles = {task: (f"metaworld/{task}", 0) for task in TASKS}
        if sys.argv[1] == "cubes":
            cubes = FAMILIES[OGBENCH].tasks
            tiles = {f"{task}, goal {i + 1}": (f"{OGBENCH}/{task}", i) for task in cubes for i in range(COLUMNS)}
        file = IMAGES / f"{'metaworld' if sys.argv[1] == 'sheet' else OGBENCH}.png"
        sheet({title: first_and_last(*episode) for title, episode in tiles.items()}).save(file, optimize=True)
        print(f"written: {file.relative_to(ROOT)}, {file.stat().st_size / 1000:.0f} kB")
    elif sys.argv[1:] == ["experts"]:
        lines = json.dumps(experts(), indent=2, ensure_ascii=False)
        rows = re.sub(r"\[[^\[\]{}]*\]", lambda found: " ".join(found[0].split()), lines)
        FILE.write_text(rows + "\n")
        print(f"written: {FILE.relative_to(ROOT)}; now: make tables")
    else:
        sys.exit(f"got {sys.argv[1:]}, expected sheet, cubes or experts")


if __name__ == "__main__":
    main()
