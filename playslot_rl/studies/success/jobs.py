"""Jobs of a comparison of success: one for each method, number of demonstrations, of labels, world model and training
seed; and what they share, made once: demonstrations, videos, world models, other models of videos."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from playslot_rl.collectors.collection import collect_demos, collect_videos
from playslot_rl.config import DataConfig, ExperimentConfig, from_dict, plugins, to_dict
from playslot_rl.config.compose import compose, is_pretrained
from playslot_rl.config.methods import METHODS, method_stage
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.config.weights import data_roots
from playslot_rl.data.agreement import open_files
from playslot_rl.data.demonstrations import drawn_among, split_demonstrations
from playslot_rl.data.videos import open_videos
from playslot_rl.data.views import first_demonstrations
from playslot_rl.envs import RECORDED
from playslot_rl.errors import ConfigError
from playslot_rl.evaluation.actions import require_unseen
from playslot_rl.evaluation.held_out import held_out_seeds
from playslot_rl.methods.training import of_recorded, train_model
from playslot_rl.runs import Run
from playslot_rl.storage.checkpoints import StageCheckpoint
from playslot_rl.studies.launch import train
from playslot_rl.studies.study import Job, absolute, absolute_roots, computed, fingerprint_of, job_config


@dataclass(frozen=True)
class SuccessJob(Job):
    """One training and its evaluation.

    Attributes:
        demos: demonstrations it learns from; None for a method that acts.
        labels: those of them whose real actions it sees; None for a method that sees all or none, or where the
            comparison has one number for all (`behaviour.labelled_demos`).
        policy_of: labels of the job, with the same demonstrations and seed, whose policy is this one's too; None for
            one that trains its own.
        recorded: whether there is no simulator, and the error of its actions is measured.
        world: number of the world model, or other model of videos, that it builds on; 0 for a method that has none.
    """

    method: str
    demos: int | None
    seed: int
    out: Path
    labels: int | None = None
    policy_of: int | None = None
    world: int = 0
    recorded: bool = False

    @property
    def name(self) -> str:
        """Such as `lapo-d50-s0`, `lapo-d50-l10-s0`, `lapo-d50-w1-s0` of the second model, or `dreamer-s0`."""
        demos = "" if self.demos is None else f"-d{self.demos}"
        labels = "" if self.labels is None else f"-l{self.labels}"
        world = f"-w{self.world}" if self.world else ""
        return f"{self.method}{demos}{labels}{world}-s{self.seed}"

    @property
    def title(self) -> str:
        return METHODS[self.method].title

    @property
    def stage(self) -> str:
        return method_stage(self.method)

    @property
    def online(self) -> bool:
        return METHODS[self.method].online

    @property
    def wave(self) -> int:
        """Those whose policy others take over come first; these would train it again, side by side."""
        return int(self.policy_of is not None)

    @property
    def protocols(self) -> tuple[str, ...]:
        if self.recorded:
            return ("actions",)
        return ("simulation", "imagination") if METHODS[self.method].imagines else ("simulation",)


def success_jobs(config: ExperimentConfig, out: Path) -> list[SuccessJob]:
    """All jobs, in the order in which they run: few demonstrations first, the methods side by side."""
    wanted, labels = config.compare, sorted(config.compare.labels)
    online = [name for name in wanted.methods if METHODS[name].online]
    alone = [name for name in wanted.methods if METHODS[name].labelled_only]
    others = [name for name in wanted.methods if name not in (*online, *alone)]
    found: list[SuccessJob] = []
    for world in range(wanted.worlds):
        for seed in wanted.seeds:
            found += [SuccessJob(name, n, seed, out, n, None, world) for n in labels for name in alone]
            for demos in wanted.numbers:
                for name in others:
                    used = [n for n in labels if not wanted.videos or demos - n in wanted.videos]
                    found += _of_demonstrations(SuccessJob(name, demos, seed, out, world=world), used, config)
    seeds = wanted.online_seeds or wanted.seeds
    for world in range(wanted.worlds):
        found += [SuccessJob(name, None, seed, out, world=world) for seed in seeds for name in online]
    recorded = config.env.name in RECORDED
    found = [job for job in found if not job.world or _builds_on_model(config, job.method)]
    return [replace(job, recorded=True) for job in found] if recorded else found


def _builds_on_model(config: ExperimentConfig, method: str) -> bool:
    """Whether it builds on a world model or a model of videos that jobs share, of which there may be several."""
    return METHODS[method].slots or shared_model(config, method) is not None


def _of_demonstrations(job: SuccessJob, labels: Sequence[int], config: ExperimentConfig) -> list[SuccessJob]:
    """The job, or one for each number of labels: the first one's policy serves them all, unless labels count in it, or
    in its latents."""
    if not labels or not METHODS[job.method].some_labelled:
        return [job]
    served = METHODS[job.method].one_policy and not _supervised(config, job.method)
    own = {labels[0], *(() if served else labels)}
    return [replace(job, labels=n, policy_of=None if n in own else labels[0]) for n in labels]


def _supervised(config: ExperimentConfig, method: str) -> bool:
    """Whether labels count in the model of videos that a method builds on, so that each job trains its own."""
    model = METHODS[method].model
    return model is not None and model.sees_labels(config)


def shared_model(config: ExperimentConfig, method: str) -> StageSpec | None:
    """The model of unlabelled videos that a method builds on, made once for all jobs; None where there is none."""
    return None if _supervised(config, method) else METHODS[method].model


def uses_demos(config: ExperimentConfig) -> bool:
    return any(not METHODS[name].online for name in config.compare.methods)


def uses_slots(config: ExperimentConfig) -> bool:
    return any(METHODS[name].slots for name in config.compare.methods)


def world_parts(methods: Iterable[str]) -> tuple[str, ...]:
    """Stages of the world model that these methods build on, those of all, `slots` first."""
    used = {name for method in methods for name in METHODS[method].world}
    return tuple(sorted(used, key=("slots", "dynamics").index))


def latent_models(config: ExperimentConfig) -> dict[str, str]:
    """Stages of the models of unlabelled videos that methods share, and for each of them a method that does."""
    return {model.name: name for name in config.compare.methods if (model := shared_model(config, name))}


def model_named(config: ExperimentConfig, stage: str) -> str:
    """Run whose model of videos of that stage the comparison takes (`baselines.METHOD.world`), or empty."""
    sharing = [method.name for method in METHODS.values() if method.model and method.model.name == stage]
    groups = [getattr(config.baselines, name, None) for name in sharing]
    return next((named for group in groups if (named := getattr(group, "world", ""))), "")


def model_folder(config: ExperimentConfig, stage: str, out: Path, world: int = 0) -> Path:
    """Run folder of such a model: the named one, else `OUT/lapo_world`, `OUT/caddy_world`; then `OUT/lapo_world_1`."""
    named = model_named(config, stage)
    return Path(named) if named and not world else numbered(out / f"{stage.removesuffix('_model')}_world", world)


def numbered(folder: Path, world: int) -> Path:
    return folder.with_name(f"{folder.name}_{world}") if world else folder


def world_runs(config: ExperimentConfig) -> tuple[str, ...]:
    """Runs of the world models that are named, `run` first, or empty; all, once they are there."""
    return (config.run, *(part.strip() for part in config.compare.runs.split(",") if part.strip()))


def success_config(config: ExperimentConfig, job: SuccessJob, world: str) -> ExperimentConfig:
    """What a job trains with.

    Labels are the job's, else `behaviour.labelled_demos` or, with fewer demonstrations, all of them. PlaySlot's own
    oracle and the references of each evaluation are left out: the slot oracle is a method, and the references run once.
    """
    labelled = job.labels or min(config.behaviour.labelled_demos, job.demos or config.behaviour.labelled_demos)
    policy = "" if job.policy_of is None else absolute(str(replace(job, labels=job.policy_of).run))
    own = {}
    if model := shared_model(config, job.method):
        world_of = absolute(str(model_folder(config, model.name, job.out, job.world)))
        own = {job.method: replace(getattr(config.baselines, job.method), world=world_of)}
    draw = None if job.online else job.seed
    return replace(
        job_config(config, job, job.method, world, demos=absolute_roots(config.data.demos), draw=draw),
        demos=job.demos,
        protocol="simulation",
        behaviour=replace(config.behaviour, labelled_demos=labelled, oracle=False, policy_from=policy),
        baselines=replace(config.baselines, **own),
        evaluation=replace(config.evaluation, references=False),
    )


def success_record(job: SuccessJob, config: ExperimentConfig, parents: Mapping[str, str]) -> dict[str, Any]:
    """What the job's file says: with its own config, and fingerprints of what it builds on, which name it."""
    result = computed(config)  # of data and parents the content counts
    method = METHODS[job.method]
    # another method's settings are none of this job's
    result["baselines"] = result["baselines"].get(method.last.own, {})
    if method.model and method.last.sizes:  # with what its decoder reads, which jobs from before could not
        result["model"] = to_dict(plugins.call(method.last.sizes, config, config.model))
    if result["model"]["predictor"]["kind"] == "cocvp":
        del result["model"]["predictor"]["kind"]  # jobs from before there was a choice are the same jobs
    return {
        "name": job.name,
        "method": job.method,
        "demos": job.demos,
        "labels": job.labels,
        "seed": job.seed,
        "evaluation_seed": config.compare.evaluation_seed,
        "protocols": list(job.protocols),
        "stage": job.stage,
        **({"world": job.world} if job.world else {}),
        "processes": 1 if job.online else config.compare.processes,
        "fingerprint": fingerprint_of([result, config.compare.evaluation_seed, dict(parents)]),
        "config": to_dict(config),
    }


EXPERT = Path("data") / "expert"


def check_data(config: ExperimentConfig) -> ExperimentConfig:
    """The config with the data sets that are known already; refuses those that do not fit, before anything is written:
    a ConfigError for too few demonstrations or an evaluation seed among the training seeds, a DataError for a data set
    that cannot be read or demonstrations without actions.
    """
    out = Path(config.out)
    config = replace(config, data=_known(config), method="playslot", demos=None)
    config = _recorded_elsewhere(config) if config.env.name in RECORDED else config
    if uses_demos(config) and (config.data.demos or _recorded(out)):
        where = config.data.demos or str(out / EXPERT)
        if config.data.demos:
            check_demos(config, _episodes(where), f"data.demos={where}")
        else:
            check_demos(config, _episodes(where), where, "use another out=, for which as many are recorded")
        open_videos(config, where, "compare").require_actions(config.env.action_dim)
    held_out_seeds(config, config.compare.evaluation_seed, config.episodes or 0, out)
    return config


def _recorded_elsewhere(config: ExperimentConfig) -> ExperimentConfig:
    """Of a set without simulator: videos and demonstrations are one set where one is named, the last episodes are held
    out for all, and as many demonstrations are used as are left where the numbers are the default ones. A DataError
    where a world model that is named was shown what is held out."""
    config = of_recorded(config)
    demos, own = absolute_roots(config.data.demos or config.data.root), config.compare
    count = _episodes(demos)
    held = config.data.held_out or count - drawn_among(count, 0, config.collect.validation_episodes)
    collect = replace(config.collect, validation_episodes=held)  # these alone measure
    data = replace(config.data, root=absolute_roots(config.data.root), demos=demos, held_out=held)
    if own.demos == type(own).demos and not own.videos:
        own = replace(own, demos=(max(count - held, 1),))
    config = replace(config, data=data, compare=own, collect=collect)
    check_demos(config, count - held, f"data.demos={demos} beside {held} that are held out")
    source = split_demonstrations(open_videos(config, demos, "compare"), None, held, 0).held_out
    if source is not None and uses_slots(config):
        for run in filter(None, world_runs(config)):
            require_unseen(source, _parts(config, run), held)
    return config


def check_demos(config: ExperimentConfig, episodes: int, where: str, cure: str = "collect more") -> None:
    """Refuse more demonstrations than there are, by a ConfigError."""
    most = config.compare.numbers[-1]
    if most > episodes:
        raise ConfigError(
            f"demos: got {most}, expected at most the {episodes} demonstrations of {where}: lower it or {cure}"
        )


def prepare_shared(config: ExperimentConfig) -> ExperimentConfig:
    """Record, train or find what the jobs share, finished parts excepted; the config with `data` and `run` complete."""
    out, models = Path(config.out), latent_models(config)
    world = uses_slots(config) and len([part for part in world_runs(config) if part]) < config.compare.worlds
    if uses_demos(config) or (world and config.collect.learn_from_demos):
        config = replace(config, data=_demos(config, out))
    if (world or any(METHODS[name].model for name in config.compare.methods)) and not config.data.root:
        config = replace(config, data=collect_videos(config, out))
    if uses_slots(config):
        runs = [_world(config, number) for number in range(config.compare.worlds)]
        config = replace(config, run=runs[0], compare=replace(config.compare, runs=",".join(runs[1:])))
    for method in models.values():
        stage = shared_model(config, method)
        assert stage is not None
        for number in range(1 if model_named(config, stage.name) else 0, config.compare.worlds):
            train_model(_of_world(config, method, number), stage, model_folder(config, stage.name, out, number))
    return config


def world_run(config: ExperimentConfig, number: int) -> str:
    """Run of a world model: a named one, else `OUT/world_model`, then `OUT/world_model_1`."""
    named = [part for part in world_runs(config) if part]
    return named[number] if number < len(named) else str(numbered(Path(config.out) / "world_model", number))


def _world(config: ExperimentConfig, number: int) -> str:
    """Run of a world model, which is trained where none is named."""
    model = world_run(config, number)
    if model in world_runs(config):
        return model
    for stage in world_parts(config.compare.methods):
        train(f"train-{stage}", replace(config, out=model, run="", seed=config.seed + number))
    return model


def _of_world(config: ExperimentConfig, method: str, number: int) -> ExperimentConfig:
    """What a model of videos is trained with beside the world model of that number."""
    runs = world_runs(config)
    return replace(config, method=method, run=runs[number if number < len(runs) else 0], seed=config.seed + number)


def _known(config: ExperimentConfig) -> DataConfig:
    """`data` with the videos the world model of `run` was trained on, where none are named and those are there."""
    stored = Path(config.run) / "config.json"
    if config.data.root or not config.run or not stored.is_file():
        return config.data
    try:
        root = from_dict(ExperimentConfig, json.loads(stored.read_text())).data.root
    except ValueError as error:
        raise ConfigError(f"{stored} cannot be used: {error}; name the videos by data.root=") from error
    there = root and all((Path(part.path) / "meta" / "info.json").is_file() for part in data_roots(root))
    return replace(config.data, root=root) if there else config.data


def _recorded(out: Path) -> bool:
    return (out / EXPERT / "meta" / "info.json").is_file()


def _episodes(roots: str | Path) -> int:
    return sum(len(open_files(root.path).episodes) for root in data_roots(str(roots)))


def _demos(config: ExperimentConfig, out: Path) -> DataConfig:
    """Enough demonstrations for the largest number; at least the preset's, so that the first ones stay the same."""
    most, more = max(config.collect.expert_episodes, *config.compare.numbers), config.collect.validation_episodes
    there = _episodes(out / EXPERT) if not config.data.demos and _recorded(out) else 0
    if there not in (0, most + more):
        most = there  # recorded for other numbers, or without ones to hold out
    return collect_demos(replace(config, collect=replace(config.collect, expert_episodes=most)), out)


def unusual_draw(config: ExperimentConfig, episodes: int) -> dict[str, str]:
    """Among how many demonstrations the seeds draw, as a part of what jobs build on; nothing where it is as many as
    the preset gives of this data set, so that only jobs of another draw are other jobs.
    """
    usual = compose([f"preset={config.preset}", f"env={config.env.name}"]).collect.validation_episodes
    here = bool(config.data.held_out) and Path(config.data.demos) == Path(config.out) / EXPERT
    among = drawn_among(episodes, config.data.held_out, config.collect.validation_episodes)
    return {} if among == drawn_among(episodes, usual if here else 0, usual) else {"drawn_among": str(among)}


class Shared:
    """What was made or found: what jobs build on, and what the result says of it."""

    def __init__(self, config: ExperimentConfig) -> None:
        runs = world_runs(config) if uses_slots(config) else ()
        self._worlds = [(_source(run), _parts(config, run)) for run in runs]
        self._models = {
            stage: [
                Run(model_folder(config, stage, Path(config.out), n)).own(stage) for n in range(config.compare.worlds)
            ]
            for stage in latent_models(config)
        }
        prints = [tuple(stage.fingerprint for stage in stages.values()) for _, stages in self._worlds]
        if len(set(prints)) < len(prints):
            raise ConfigError(f"compare.runs: got one world model twice among {', '.join(runs)}, expected others")
        self._demos = open_videos(config, config.data.demos, "compare") if uses_demos(config) else None
        self._draw = unusual_draw(config, self._demos.recordings) if self._demos else {}
        self._supervised = {name for name in config.compare.methods if _supervised(config, name)}
        self._videos = open_videos(config, config.data.root, "compare", False).fingerprint if self._supervised else ""

    def parents(self, job: SuccessJob) -> dict[str, str]:
        """Fingerprints of the weights, by stage, and of the demonstrations that a job builds on."""
        method = METHODS[job.method]
        prints = {name: self._worlds[job.world][1][name].fingerprint for name in method.world}
        if job.method in self._supervised:
            prints["videos"] = self._videos
        elif method.model:
            prints[method.model.name] = self._models[method.model.name][job.world].fingerprint
        if job.demos is not None and self._demos is not None:
            prints["demos"] = first_demonstrations(self._demos, job.demos).fingerprint  # the seed is in its config
            prints |= self._draw
        return prints

    def plain(self) -> dict[str, Any]:
        """`world_models`, and the models of videos by stage, `latent_models`."""
        worlds = [
            {
                "source": source,
                "fingerprints": {name: stage.fingerprint for name, stage in stages.items()},
                "seconds": sum(float(stage.meta.get("seconds", 0.0)) for stage in stages.values()),
                "episodes": stages["slots"].meta.get("episodes"),
            }
            for source, stages in self._worlds
        ]
        kept = ("fingerprint", "seconds", "episodes")
        models = {
            name: [{key: stage.meta.get(key) for key in kept} for stage in stages]
            for name, stages in self._models.items()
        }
        return {"world_models": worlds, "latent_models": models}


def _parts(config: ExperimentConfig, run: str) -> dict[str, StageCheckpoint]:
    """Of a world model, what the methods build on."""
    return {name: Run.open(run).stage(name) for name in world_parts(config.compare.methods)}


def _source(run: str) -> str:
    return run if is_pretrained(run) else Path(run).name
