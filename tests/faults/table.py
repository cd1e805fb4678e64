"""Every writing command, as small as can be: what it begins with, what is typed, and what it may leave otherwise."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ONE_CORE: Final = ("threads=1", "workers=1", "device=cpu")
SMOKE: Final = ("preset=smoke", *ONE_CORE)
VIDEOS, DEMOS = "data.root=run/data/random", "data.demos=run/data/expert"


@dataclass(frozen=True)
class Row:
    """A command.

    Attributes:
        argv: what is typed, in the work folder.
        begins: which parts of a finished run `run` are there before.
        passing: parts of names whose content depends on the day.
        prepare: puts more into the work folder.
        heavy: it takes long; fewer faults are enough, as its parts have rows of their own.
        clocked: how much it trains depends on the clock: what it leaves is only looked through for what is half-made.
        done: what the same command answers in one line where it is finished; empty ends with 0.
    """

    argv: tuple[str, ...]
    begins: tuple[str, ...] = ("data",)
    passing: tuple[str, ...] = ()
    prepare: Callable[[Path], object] = lambda root: None
    heavy: bool = False
    clocked: bool = False
    done: str = ""

    def lay(self, root: Path, finished: Path) -> None:
        """Make the work folder anew."""
        if root.exists():
            shutil.rmtree(root)
        (root / "run").mkdir(parents=True)
        for name in self.begins:
            for path in finished.glob(name):
                if path.is_dir():
                    shutil.copytree(path, root / "run" / path.name)
                else:
                    shutil.copy(path, root / "run")
        self.prepare(root)


WORLD: Final = ("config.json", "data", "slots", "dynamics")
ALL: Final = (*WORLD, "policy")
THERE: Final = "got something that is there already"


def _damage(root: Path) -> None:
    (root / "run" / "data" / "random" / "meta" / "stats.json").unlink()


def _cached(root: Path) -> None:
    for name in ("a", "b"):
        entry = root / "cache" / "frames" / f"{name}{'0' * 15}"
        entry.mkdir(parents=True)
        (entry / "entry.json").write_text("{}")


def _download(root: Path) -> None:
    from sketchy_layout import write_sketchy

    write_sketchy(root / "download")


def _any_set(root: Path) -> None:
    from test_adopt import write_set

    kept = root.parent / "any"  # no two runs of LeRobot's writer leave the same files
    if not kept.exists():
        write_set(kept, (24, 30, 26, 24, 28), speed=2)
    shutil.copytree(kept, root / "any")


TABLE: Final[dict[str, Row]] = {
    "collect": Row(("collect", "env=grid_shapes", "episodes=3", "out=out", *SMOKE), ()),
    "collect a simulator": Row(("collect", "policy=expert", "episodes=2", "out=out", *SMOKE), (), heavy=True),
    "convert": Row(
        ("convert", "env=sketchy", "data.root=download", "out=out", *ONE_CORE), (), prepare=_download, done=THERE
    ),
    "train-slots": Row(("train-slots", VIDEOS, "out=out", *SMOKE)),
    "train-dynamics": Row(("train-dynamics", "run=run", VIDEOS, *ONE_CORE), ("config.json", "data", "slots")),
    "train-policy": Row(("train-policy", "run=run", DEMOS, *ONE_CORE), WORLD),
    "train-baseline svg": Row(("train-baseline", "method=svg", VIDEOS, "out=out", *SMOKE)),
    "train-baseline slot_oracle": Row(
        ("train-baseline", "method=slot_oracle", "run=run", DEMOS, "out=out", *SMOKE), WORLD
    ),
    "train-baseline lapo": Row(("train-baseline", "method=lapo", VIDEOS, DEMOS, "out=out", *SMOKE)),
    "train-baseline caddy_policy": Row(("train-baseline", "method=caddy_policy", VIDEOS, DEMOS, "out=out", *SMOKE)),
    "train-baseline dreamer": Row(("train-baseline", "method=dreamer", "out=out", *SMOKE), (), heavy=True),
    "train-baseline sold": Row(("train-baseline", "method=sold", "run=run", "out=out", *SMOKE), WORLD, heavy=True),
    "evaluate in simulation": Row(
        ("evaluate", "run=run", "protocol=simulation", "episodes=2", *ONE_CORE), ALL, heavy=True
    ),
    "evaluate in imagination": Row(("evaluate", "run=run", "protocol=imagination", "episodes=2", *ONE_CORE), ALL),
    "inspect": Row(("inspect", "run=run", VIDEOS, "episodes=4", *ONE_CORE), ALL),
    "plan": Row(
        ("plan", "run=run", "planner=cem", "goals=ahead", "plan.seconds=0.2", "episodes=1", *ONE_CORE),
        ALL,
        passing=("run/planning/",),  # a search by the clock
    ),
    "export": Row(("export", "run=run", "out=out", *ONE_CORE), ALL),
    "pipeline": Row(("pipeline", "episodes=2", "out=out", *SMOKE), (), heavy=True),
    "adopt": Row(
        ("adopt", "data.root=any", "out=out", "minutes=0.02", "adopt.slots=[2,3]", "adopt.prototypes=4", *SMOKE),
        (),
        prepare=_any_set,
        heavy=True,
        clocked=True,
    ),
    "compare": Row(
        ("compare", "methods=slot_oracle,lapo", "demos=2", "seeds=0", "run=run", VIDEOS, DEMOS, "episodes=2", "out=out",
         *SMOKE),
        WORLD,
        passing=("comparison.md",),
        heavy=True,
    ),
    "compare-video": Row(
        ("compare-video", "methods=svg,slotformer", "run=run", VIDEOS, "out=out", *SMOKE),
        WORLD,
        passing=("video.md",),
        heavy=True,
    ),
    "demo": Row(("demo", "episodes=2", "out=out", *SMOKE), (), heavy=True),
    "dataset merge": Row(
        ("dataset", "merge", "run/data/random", "run/data/expert", "--out", "out"), done=THERE
    ),
    "dataset split": Row(
        ("dataset", "split", "run/data/random", "--out", "out", "--fractions", "a=0.5,b=0.5"), done=THERE
    ),
    "dataset repair": Row(("dataset", "repair", "run/data/random"), prepare=_damage),
    "dataset repair elsewhere": Row(
        ("dataset", "repair", "run/data/random", "--out", "out"), prepare=_damage, done=THERE
    ),
    "dataset viz": Row(("dataset", "viz", "run/data/random", "--out", "page.html")),
    "cache clear": Row(("cache", "clear"), (), prepare=_cached),
}  # fmt: skip

NOT_HERE: Final[dict[str, str]] = {
    "play": "recordings are made by a hand on a page: tests/play/test_recording.py",
    "bench": "one file, written at once, of numbers that no two runs share: tests/speed/test_bench.py",
    "models": "writes nothing",
    "doctor": "writes nothing that stays",
    "dataset info": "writes nothing",
    "dataset verify": "writes nothing",
    "dataset push": "changes the Hub by one commit: tests/hub/test_push.py",
    "dataset pull": "is killed in tests/hub/test_lerobot.py",
    "cache list": "writes nothing",
}
"""Commands that are not in the table, and why."""
