"""Collect a data set: record what the journal lacks, then export it; and what a preset has recorded: demonstrations,
and the videos a world model learns from.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from playslot_rl.collectors.export import export
from playslot_rl.collectors.journal import SPEC_NAME, CollectionSpec, Journal, journal_path, read_spec, remove_leftover
from playslot_rl.config import CollectorConfig, DataConfig, ExperimentConfig
from playslot_rl.data.metadata import INFO_NAME, RECORD_NAME, json_content
from playslot_rl.envs import PROCEDURAL, play_config
from playslot_rl.errors import ConfigError, DataError, OutputError
from playslot_rl.runtime.progress import StageProgress
from playslot_rl.runtime.threads import available_cores


def is_complete(out: Path, spec: CollectionSpec) -> bool:
    """Whether `out` is this collection's finished data set; False where there is nothing yet.

    Raises:
        OutputError: it holds something else, or a collection with other settings.
        DataError: its own record and LeRobot's disagree.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return False
    record = out / RECORD_NAME
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
    for record in (out / RECORD_NAME, journal_path(out.absolute()) / SPEC_NAME):
        if record.is_file():
            stored = read_spec(record)
            spec = stored if record.name == SPEC_NAME else stored.get("spec")
            return int(spec["episodes"]) if isinstance(spec, dict) and "episodes" in spec else None
    return None


def collect(
    config: ExperimentConfig, policy: str, episodes: int, steps: int, out: Path, seed: int, workers: int
) -> Path:
    """Record episodes as the LeRobot v3.0 data set `out`.

    Episodes go to a journal, `OUT.journal`, and from there in one transaction to `out`. Killed at any moment, it loses
    at most the episodes in hand (one per worker), and the same call carries on. A finished data set is left alone.
    Workers that die or hang are replaced, at most `config.collector.restarts` times.

    Args:
        seed: base seed; the data depend on it, not on the number of workers.
        workers: processes; 0 means one per core, 1 records in this process.

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
    shown, folder = config.logging.progress, journal_path(out)
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


def collect_demos(config: ExperimentConfig, folder: Path) -> DataConfig:
    """Record demonstrations into `FOLDER/data/expert` unless `data.demos` names some; returns where the data are.

    Where nothing can be acted on there are none. `collect.validation_episodes` more than `collect.expert_episodes` are
    recorded and held out; a data set begun without them stays as it is.
    """
    if config.data.demos or config.env.name in PROCEDURAL:
        return config.data
    demos, want = folder / "data" / "expert", config.collect
    held_out = 0 if begun_episodes(demos) == want.expert_episodes else want.validation_episodes
    episodes = want.expert_episodes + held_out
    collect(config, "expert", episodes, want.expert_steps, demos, config.seed, config.workers)
    return replace(config.data, demos=str(demos), held_out=held_out)


def playing(config: ExperimentConfig) -> ExperimentConfig:
    """What the noisy expert records: `collect.exploration_noise` on its actions, random goals where a task has some."""
    noise = replace(config.collect, noise=config.collect.exploration_noise)
    return replace(config, collect=noise, env=play_config(config.env))


def collect_videos(config: ExperimentConfig, folder: Path) -> DataConfig:
    """Record the world model's videos below `FOLDER/data`; `data.demos` are among them where the preset wants it."""
    random, want = folder / "data" / "random", config.collect
    collect(config, "random", want.random_episodes, want.random_steps, random, config.seed, config.workers)
    if config.env.name in PROCEDURAL:
        return replace(config.data, root=str(random))
    roots = [str(random)]
    if want.noisy_episodes:
        # Random actions never reach the object. Videos of a noisy expert (no action is read from them) show the world
        # model the places a policy goes to; the paper has 9,000 random episodes instead.
        noisy = folder / "data" / "noisy_expert"
        # The next base seed: no episode of the demonstrations comes twice.
        played = playing(config)
        collect(played, "expert", want.noisy_episodes, want.expert_steps, noisy, config.seed + 1, config.workers)
        roots.append(str(noisy))
    if want.learn_from_demos and config.data.demos:
        roots.append(config.data.demos)
    return replace(config.data, root=",".join(roots))
