"""How fast episodes are collected, and where the time goes. Leave the machine idle.

.venv/bin/python benchmarks/collect.py --env button_press --workers 1,2 --episodes 40 [--json FILE] [key=value ...]

Times are milliseconds an episode, of one process; rates are of whole collections, without the start of the workers.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any
from unittest import mock

from playslot_rl.config import ExperimentConfig

WARM_UP = 3
"""Episodes of each worker that are not counted."""


class Stopwatch:
    """Adds up the time spent in methods, each without the other timed methods it calls."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inner = [0.0]

    @contextlib.contextmanager
    def running(self, name: str) -> Iterator[None]:
        """Time a block."""
        self._inner.append(0.0)
        begin = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - begin
            self.seconds[name] = self.seconds.get(name, 0.0) + spent - self._inner.pop()
            self._inner[-1] += spent

    def watching(self, owner: Any, method: str, name: str) -> AbstractContextManager[Any]:
        """Time every call of a class's method, or a module's function, within a block."""
        original = getattr(owner, method)

        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.running(name):
                return original(*args, **kwargs)

        return mock.patch.object(owner, method, timed)


def measure(
    config: ExperimentConfig,
    policy: str,
    steps: int,
    workers: Sequence[int],
    episodes: int,
    repeats: int = 1,
    target: int = 20_000,
    say: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Measure everything.

    Args:
        config: the task (`env`, `render`) and storage (`collect`).
        policy: `random` or `expert`.
        steps: agent steps an episode.
        workers: numbers of worker processes to compare.
        episodes: counted episodes of each rate.
        repeats: how often the numbers of workers take turns; the rates are medians.
        target: size of the collection to extrapolate to.
        say: told what is being measured.

    Raises:
        ConfigError: unknown environment or policy. RenderError: no GL backend. PlaySlotError: workers died.
    """
    from playslot_rl.collectors.spec import CollectionSpec
    from playslot_rl.speed.report import machine

    total = max(workers) * WARM_UP + episodes + 2 * max(workers)
    spec = CollectionSpec.make(config, policy, total, steps, 0)
    with tempfile.TemporaryDirectory(prefix="playslot-bench-") as folder:
        say("where an episode's time goes, in one process")
        parts, sizes = episode_parts(spec, min(episodes, 20), Path(folder))
        rates: dict[int, list[float]] = {count: [] for count in workers}
        for turn in range(repeats):
            for count in workers:
                say(f"{count} worker{'s' if count > 1 else ''}, turn {turn + 1} of {repeats}")
                rates[count].append(rate(spec, count, episodes, Path(folder)))
    found = {count: median(values) for count, values in rates.items()}
    export_s = sum(ms for name, ms in parts.items() if name.startswith("export")) / 1000
    best = max(found, key=lambda count: found[count])
    return {
        "task": {"env": spec.env.name, "policy": policy, "steps": steps, "storage": spec.storage},
        "episodes_per_s": {str(count): value for count, value in found.items()},
        "all_rates": {str(count): values for count, values in rates.items()},
        "ratio_to_first": {str(count): value / found[workers[0]] for count, value in found.items()},
        "episode_ms": parts,
        "bytes_per_episode": sizes,
        "extrapolation": {
            "episodes": target,
            "workers": best,
            "record_h": target / found[best] / 3600,
            "export_h": target * export_s / 3600,
            "data_set_gb": target * sizes["data set"] / 1e9,
            "most_gb_while_exporting": target * (sizes["data set"] + sizes["journal"]) / 1e9,
        },
        "machine": machine(),
    }


def rate(spec: Any, workers: int, episodes: int, folder: Path) -> float:
    """Episodes a second that reach the journal, once every worker has recorded `WARM_UP` of them."""
    from playslot_rl.collectors.journal import Journal
    from playslot_rl.collectors.recording import record_into

    journal = Journal(folder / "journal", spec)
    before = WARM_UP * workers
    # Two more each are in the workers' hands when the last counted one is stored: none idles before.
    indices = range(before + episodes + 2 * workers)
    try:
        with contextlib.closing(record_into(journal, indices, workers)) as stored:  # type: ignore[type-var]
            for _ in range(before):
                next(stored)
            begin = time.perf_counter()
            for _ in range(episodes):
                next(stored)
            return episodes / (time.perf_counter() - begin)
    finally:
        shutil.rmtree(journal.folder)


def episode_parts(spec: Any, episodes: int, folder: Path) -> tuple[dict[str, float], dict[str, float]]:
    """Milliseconds of each part of an episode's way to the data set, and bytes an episode on disk."""
    from playslot_rl.collectors.journal import Journal

    warm = Journal(folder / "warm", replace(spec, episodes=1))
    _record_and_export(Stopwatch(), warm, folder / "warm_data")  # imports, compilation, first GL frames
    watch = Stopwatch()
    journal = Journal(folder / "parts", replace(spec, episodes=episodes))
    _record_and_export(watch, journal, folder / "parts_data")
    sizes = {
        "journal": _bytes(journal.folder) / episodes,
        "data set": _bytes(folder / "parts_data") / episodes,
    }
    for name in ("warm", "warm_data", "parts", "parts_data"):
        shutil.rmtree(folder / name)
    return {name: seconds / episodes * 1000 for name, seconds in watch.seconds.items()}, sizes


def _record_and_export(watch: Stopwatch, journal: Any, out: Path) -> None:
    from playslot_rl.collectors import export, image_set
    from playslot_rl.collectors import journal as journal_module
    from playslot_rl.collectors.episodes import EpisodeCollector, SeededView
    from playslot_rl.envs.rendering import FrameRenderer

    spec = journal.spec
    collector = EpisodeCollector.make(spec)
    with contextlib.ExitStack() as stack:
        for owner, method, name in (
            (SeededView, "step", "simulation"),
            (SeededView, "reset", "simulation"),
            (FrameRenderer, "__call__", "rendering"),
            (EpisodeCollector, "record", "policy and collector"),
            (journal_module, "encode", "encoding (PNG)"),
            (journal_module, "write_bytes", "journal writing"),
            (export, "_write", "export: other"),
            (journal_module.Journal, "read_with_images", "export: reading"),
            (image_set.ImageSetWriter, "_stats", "export: statistics"),
            (image_set.ImageSetWriter, "_flush", "export: writing"),
            (export, "_check", "export: checking"),
        ):
            stack.enter_context(watch.watching(owner, method, name))
        try:
            for index in range(spec.episodes):
                journal.add(collector.record(index))
        finally:
            collector.shutdown()
        export.export(journal, out)


def _bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def table(figures: dict[str, Any]) -> str:
    """The figures for people, as Markdown."""
    from playslot_rl.visualization import markdown

    task, size, far = figures["task"], figures["bytes_per_episode"], figures["extrapolation"]
    rates, ratios = figures["episodes_per_s"], figures["ratio_to_first"]
    parts = [[name, f"{ms:.1f}"] for name, ms in figures["episode_ms"].items()]
    lines = [
        f"{task['env']}, {task['policy']} policy, {task['steps']} agent steps an episode, storage={task['storage']}",
        f"{figures['machine']['cpu']}, {figures['machine']['cores']} cores\n",
        markdown.table(
            ["workers", "episodes/s", "times the first"], [[n, f"{rates[n]:.2f}", f"{ratios[n]:.2f}"] for n in rates]
        ),
        "",
        markdown.table(["part (one process)", "ms an episode"], parts),
        "",
        markdown.table(["on disk", "kB an episode"], [[name, f"{value / 1000:.1f}"] for name, value in size.items()]),
        f"\n{far['episodes']} episodes with {far['workers']} workers: {far['record_h']:.2f} h recording,",
        f"{far['export_h']:.2f} h exporting; the data set takes {far['data_set_gb']:.2f} GB,",
        f"with the journal {far['most_gb_while_exporting']:.2f} GB while it is exported.",
    ]
    return "\n".join(lines)


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="button_press", help="environment name")
    parser.add_argument("--policy", default="random", choices=["random", "expert"])
    parser.add_argument("--steps", type=int, default=25, help="agent steps an episode")
    parser.add_argument("--workers", default="1,2", help="numbers of workers to compare, separated by commas")
    parser.add_argument("--episodes", type=int, default=40, help="counted episodes of each rate")
    parser.add_argument("--repeats", type=int, default=3, help="turns; the rates are medians")
    parser.add_argument("--target", type=int, default=20_000, help="size of the collection to extrapolate to")
    parser.add_argument("--json", type=Path, help="also write the figures there")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="changes of the config")
    options = parser.parse_intermixed_args()

    from playslot_rl.config.compose import compose
    from playslot_rl.envs.rendering import import_mujoco
    from playslot_rl.errors import PlaySlotError

    try:
        config = compose([f"env={options.env}", *options.overrides], "collect")
        import_mujoco()  # before torchrl, which imports it too
        import torch

        torch.set_num_threads(1)  # as in the workers
        from playslot_rl.storage.atomic import write_json

        figures = measure(
            config,
            options.policy,
            options.steps,
            [int(count) for count in options.workers.split(",")],
            options.episodes,
            options.repeats,
            options.target,
            say=lambda text: print(f"{text} ...", file=sys.stderr, flush=True),
        )
    except PlaySlotError as error:
        print(f"benchmarks/collect.py: error: {error}", file=sys.stderr)
        return 1
    print(table(figures))
    if options.json is not None:
        write_json(options.json, figures)
        print(f"written: {options.json}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
