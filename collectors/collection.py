"""Collect a data set: record what the journal lacks, then export it."""

from __future__ import annotations

import sys
from pathlib import Path

from playslot_rl.collectors.export import META_NAME, export
from playslot_rl.collectors.journal import SPEC_NAME, Journal, journal_path, read_spec, remove_leftover
from playslot_rl.collectors.spec import CollectionSpec
from playslot_rl.config import CollectorConfig, ExperimentConfig
from playslot_rl.data.metadata import INFO_NAME, json_content
from playslot_rl.errors import ConfigError, DataError, OutputError
from playslot_rl.runtime.progress import StageProgress
from playslot_rl.runtime.threads import available_cores


def is_complete(out: Path, spec: CollectionSpec) -> bool:
    """Whether the data set `out` is there.

    Returns:
        True for this collection's finished data set; False where there is nothing yet.

    Raises:
        OutputError: it holds something else, or a collection with other settings.
        DataError: its own record and LeRobot's disagree.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return False
    record = out / META_NAME
    if not record.is_file():
        raise OutputError(f"{out}: got a folder or file of something else, expected none; choose another out=")
    differs = spec.difference(read_spec(record).get("spec"))
    if differs:
        raise OutputError(f"{out} was collected with other settings ({differs}); repeat them or choose another out=")
    try:
        info = json_content(out / INFO_NAME)
        counts = info["total_episodes"], info["total_frames"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{out}: got no readable meta/info.json ({error}); delete the folder and collect again"
        ) from error
    expected = spec.episodes, spec.episodes * (spec.steps + 1)
    if counts != expected:
        raise DataError(f"{out}: got {counts} episodes and frames, expected {expected}; delete it and collect again")
    return True


def begun_episodes(out: Path) -> int | None:
    """Episodes of the collection that `out` holds, or that was begun there; None where there is none."""
    for record in (out / META_NAME, journal_path(out.absolute()) / SPEC_NAME):
        if record.is_file():
            stored = read_spec(record)
            spec = stored if record.name == SPEC_NAME else stored.get("spec")
            return int(spec["episodes"]) if isinstance(spec, dict) and "episodes" in spec else None
    return None


def collect(
    config: ExperimentConfig, policy: str, episodes: int, steps: int, out: Path, seed: int, workers: int
) -> Path:
    """Record episodes as a LeRobot v3.0 data set.

    Episodes go to a journal, `OUT.journal`, and from there in one transaction to `out`. Killed at any moment, it loses
    at most the episodes in hand (one per worker), and the same call carries on. A finished data set is left alone.
    Workers that die or hang are replaced, at most `config.collector.restarts` times.

    Args:
        config: its `env`, `render`, `collect`, `collector` and `logging` are used.
        seed: base seed; the data depend on it, not on the number of workers.
        workers: processes; 0 means one per core, 1 records in this process.

    Returns:
        `out`.

    Raises:
        ConfigError: unknown environment or policy, or a number outside its range.
        OutputError: `out` holds something else or a collection with other settings, another process is collecting
            into it, or the disk is full.
        DataError: the finished data set at `out` is damaged.
        RenderError: there is no working GL backend.
        PlaySlotError: too many workers died or hung.

    Examples:
        >>> import tempfile
        >>> from playslot_rl.config import CollectorConfig, ExperimentConfig
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     root = collect(ExperimentConfig(), "expert", 1, 2, Path(folder) / "demos", seed=0, workers=1)
        ...     (root / "meta" / "info.json").is_file()
        True
    """
    spec = CollectionSpec.make(config, policy, episodes, steps, seed)
    out = Path(out).absolute()
    shown = config.logging.progress
    folder = journal_path(out)
    if is_complete(out, spec):
        remove_leftover(folder, spec)  # of a process that was killed after the rename
        if shown:
            print(f"collect: {out} is complete ({episodes} episodes), nothing to do", file=sys.stderr)
        return out
    journal = Journal(folder, spec)
    with journal.lock():
        if not is_complete(out, spec):  # another process may have finished it while this one was starting
            _record_missing(journal, workers or available_cores(), config.collector, shown)
            if shown:
                print(f"collect: exporting {episodes} episodes to {out}", file=sys.stderr, flush=True)
            export(journal, out)
        journal.remove()
    return out


def _record_missing(journal: Journal, workers: int, settings: CollectorConfig, shown: bool) -> None:
    missing, total = journal.missing(), journal.spec.episodes
    if not missing:
        return
    from playslot_rl.envs.rendering import import_mujoco

    import_mujoco()  # before torchrl, which imports it too
    from playslot_rl.collectors.recording import record_into

    def say(text: str) -> None:
        print(f"collect: {text}", file=sys.stderr, flush=True)

    if shown and len(missing) < total:
        say(f"{total - len(missing)} of {total} episodes are there already")
    done = total - len(missing)
    try:
        with StageProgress(f"collect {journal.spec.policy}", done, total, shown, unit="episodes") as progress:
            for count, _ in enumerate(record_into(journal, missing, workers, settings, say), done + 1):
                progress.update(count)
    except ConfigError:
        if len(journal.missing()) == total:
            journal.remove()  # no other command would go on with it
        raise
