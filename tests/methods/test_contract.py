"""What holds for every stage of every method: a finished one is skipped, one that was begun otherwise is refused by the
key that is typed, a killed one ends with the weights of one that was not, a NaN ends in one line, and two commands do
not train it at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args
from unittest.mock import patch

import pytest
import torch
from stages import on_few_videos

from playslot_rl.config import ExperimentConfig, plugins, to_dict
from playslot_rl.config.compose import compose, hint_of
from playslot_rl.config.method_keys import GROUPS, chosen
from playslot_rl.config.methods import METHODS
from playslot_rl.config.plain import flatten
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.errors import CheckpointError, OutputError, TrainingError
from playslot_rl.methods.online.replay import OnlineCheckpoints
from playslot_rl.recipes import train_baseline, train_dynamics, train_policy, train_slots
from playslot_rl.runs import Run
from playslot_rl.runs.opening import STAGE_LOCK
from playslot_rl.storage.locks import locked
from playslot_rl.training import record as records
from playslot_rl.training.batches import GlobalBatches
from playslot_rl.training.fit import _Run

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("thin_resnets")]

WORLD = {"slots": train_slots, "dynamics": train_dynamics, "policy": train_policy}
RATES = {
    "slots": "slots.optim.lr",
    "dynamics": "dynamics.optim.lr",
    "policy": "behaviour.optim.lr",
    "slot_oracle": "behaviour.optim.lr",
    "slot_vpt": "behaviour.decoder_lr",
    "lapo_model": "baselines.lapo.model.optim.lr",
    "autoencoder": "baselines.autoencoder_bc.model.optim.lr",
    "autoencoder_bc": "baselines.autoencoder_bc.policy.optim.lr",
    "lapo_slots_model": "baselines.lapo_slots.model.optim.lr",
    "lapo_slots": "behaviour.optim.lr",
    "laom_model": "baselines.laom.model.optim.lr",
    "clam_model": "baselines.clam.model.optim.lr",
    "inverse_resnet": "baselines.inverse_bc.model.optim.lr",
    "inverse_bc": "baselines.inverse_bc.policy.optim.lr",
    "history_bc": "baselines.resnet_oracle.optim.lr",
    "act_state": "baselines.act.optim.lr",
    "diffusion_state": "baselines.diffusion.optim.lr",
    "dreamer": "baselines.dreamer.lr",
    "sold": "baselines.sold.actor_lr",
    **{name: f"baselines.{name}.policy.optim.lr" for name in ("lapo", "laom", "clam", "caddy_policy", "caddy_oracle")},
}
"""Where a stage's learning rate is typed, if not in `baselines.STAGE.optim.lr`."""


@dataclass(frozen=True)
class Case:
    """A stage, and the method it is trained by."""

    method: str
    spec: StageSpec

    @property
    def rate(self) -> str:
        """Full name of a learning rate that a stage is identified by."""
        return RATES.get(self.spec.name, f"baselines.{self.spec.name}.optim.lr")


CASES: dict[str, Case] = {}
for name, method in METHODS.items():
    for stage in method.stages:
        CASES.setdefault(stage.name, Case(name, stage))  # BC is its oracle on fewer demonstrations
LEARNED = {name: case for name, case in CASES.items() if case.spec.data}


class _Killed(BaseException):
    """As SIGKILL: nothing is tidied up."""


@pytest.fixture(autouse=True)
def _few_videos() -> Iterator[None]:
    with on_few_videos(), patch.object(records, "PATIENCE", 0.0):
        yield


def shared(out: Path, world: Path) -> list[str]:
    return [
        "preset=smoke", "env=button_press", "data.root=videos", "device=cpu", "logging.backend=none",
        f"data.cache={world.parent / 'cache'}", f"out={out}",
    ]  # fmt: skip


def train(case: Case, out: Path, world: Path, *more: str) -> None:
    """Train a stage, and what it builds on, by its command."""
    name, arguments = case.spec.name, [*shared(out, world), *more]
    if name in WORLD:
        WORLD[name].main(compose([*arguments, *([] if name == "slots" else [f"run={world}"])]))
    else:
        train_baseline.main(compose([*arguments, f"method={case.method}", f"run={world}"]))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs by method, made when they are asked for; `world` is PlaySlot's."""
    return {"folder": tmp_path_factory.mktemp("runs")}


def trained(name: str, runs: dict[str, Path]) -> Path:
    """A finished run of a stage and of all others of its method; look, do not touch."""
    world, method = runs["folder"] / "world", CASES[name].method
    if "playslot" not in runs:
        for stage in WORLD:
            train(CASES[stage], world, world)
        runs["playslot"] = world
    if method not in runs:
        train(CASES[name], runs["folder"] / method, world)
        runs[method] = runs["folder"] / method
    return runs[method]


@pytest.mark.parametrize("name", CASES)
def test_a_finished_stage_is_skipped_and_one_of_other_settings_refused(
    name: str, runs: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    run, world = trained(name, runs), runs["folder"] / "world"
    before = Run(run).own(name).fingerprint
    capsys.readouterr()
    train(CASES[name], run, world)
    assert f"{name}: finished before" in capsys.readouterr().out
    assert Run(run).own(name).fingerprint == before
    with pytest.raises(CheckpointError, match=f"^{CASES[name].rate}: got 0.5, expected ") as caught:
        train(CASES[name], run, world, f"{CASES[name].rate}=0.5")
    assert "\n" not in str(caught.value)
    with pytest.raises(CheckpointError, match=r"seed: got 5, expected 0"):
        train(CASES[name], run, world, "seed=5")


@pytest.mark.parametrize("name", LEARNED)
def test_a_killed_stage_ends_with_the_weights_of_one_that_was_not(
    name: str, runs: dict[str, Path], tmp_path: Path
) -> None:
    whole, world, plain = trained(name, runs), runs["folder"] / "world", _Run.advance
    out = tmp_path / "run"

    def advance(self: Any, step: int, progress: Any) -> None:
        if step == self.config.steps - 1 and self.folder.name == name:
            raise _Killed
        plain(self, step, progress)

    with patch.object(_Run, "advance", advance), pytest.raises(_Killed):
        train(CASES[name], out, world)
    assert not Run(out).has(name)
    with pytest.raises(CheckpointError, match=f"^{CASES[name].rate}: got 0.5, expected "):
        train(CASES[name], out, world, f"{CASES[name].rate}=0.5")
    train(CASES[name], out, world)
    assert Run(out).own(name).fingerprint == Run(whole).own(name).fingerprint
    meta = Run(out).own(name).meta
    own = [one for one in meta["sittings"] if one["training"] == meta["sittings"][0]["training"]]
    assert sum(one["steps"] for one in own) == meta["steps"]
    assert sum(one["seconds"] for one in meta["sittings"]) == pytest.approx(meta["seconds"], abs=0.06)


@pytest.mark.parametrize("name", LEARNED)
def test_a_loss_that_is_no_number_ends_in_one_line(name: str, runs: dict[str, Path], tmp_path: Path) -> None:
    trained("policy", runs)

    def backward(*_: Any) -> dict[str, torch.Tensor]:
        return {"loss": torch.tensor(float("nan"))}

    with patch.object(GlobalBatches, "backward", backward), pytest.raises(TrainingError) as caught:
        train(CASES[name], tmp_path / "run", runs["folder"] / "world")
    assert "loss is nan at step 1" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", CASES)
def test_two_commands_do_not_train_a_stage_at_once(name: str, runs: dict[str, Path], tmp_path: Path) -> None:
    trained("policy", runs)
    folder = tmp_path / "run" / name
    folder.mkdir(parents=True)
    with (
        locked(folder / STAGE_LOCK, "", 0.0),
        pytest.raises(OutputError, match=f"whose {name} another command is training"),
    ):
        train(CASES[name], tmp_path / "run", runs["folder"] / "world")
    assert [path.name for path in folder.iterdir()] == [STAGE_LOCK]


@pytest.mark.parametrize("name", [name for name, method in METHODS.items() if method.online])
def test_a_killed_training_by_acting_is_carried_on(name: str, runs: dict[str, Path], tmp_path: Path) -> None:
    whole, world, plain, saves = trained(name, runs), runs["folder"] / "world", OnlineCheckpoints.save_online, []

    def save_online(self: Any, *state: Any) -> Path:
        if saves:
            raise _Killed
        saves.append(plain(self, *state))
        return saves[0]

    with patch.object(OnlineCheckpoints, "save_online", save_online), pytest.raises(_Killed):
        train(CASES[name], tmp_path / "run", world)
    train(CASES[name], tmp_path / "run", world)
    assert Run(tmp_path / "run").own(name).fingerprint == Run(whole).own(name).fingerprint


@pytest.mark.parametrize("name", [name for name in METHODS if name not in ("slot_bc", "resnet_bc")])
def test_a_finished_run_is_loaded_as_what_the_method_says(name: str, runs: dict[str, Path]) -> None:
    method = METHODS[name]
    run = Run.open(trained(method.last.name, runs))
    for reference in filter(None, (method.load.actor, method.load.video)):
        loaded = plugins.call(reference, run, "cpu")
        assert callable(getattr(loaded, "predict" if reference == method.load.video else "reset"))


def with_value(config: Any, key: str, value: object) -> Any:
    """A config, or a group of one, with another value of a dotted key."""
    first, _, rest = key.partition(".")
    return replace(config, **{first: with_value(getattr(config, first), rest, value) if rest else value})


def with_others_changed(config: ExperimentConfig) -> tuple[ExperimentConfig, set[str]]:
    """A config in which choices, flags and numbers that its method does not read are others, and which these are: its
    world model's, which is there, among them."""
    typed, changed = chosen(config, "train-baseline"), set[str]()
    assert typed is not None
    methods = replace(typed, world=())
    for key, value in flatten(to_dict(config)).items():
        if key.partition(".")[0] in GROUPS and not methods.reads(key) and (others := other_values(key, value)):
            with suppress(ValueError):  # it does not go with the others
                config = with_value(config, key, others[0])
                changed.add(key)
    return config, changed


def other_values(key: str, value: object) -> list[object]:
    match value:
        case bool():
            return [not value]
        case int():
            return [value + 1]
        case float():
            return [value / 2]
    return [other for other in get_args(hint_of(key)) if isinstance(other, str) and other != value]


@pytest.mark.parametrize("name", [name for name in METHODS if name != "playslot"])
def test_what_a_method_does_not_read_changes_nothing(name: str, runs: dict[str, Path], tmp_path: Path) -> None:
    method, plain, out = METHODS[name], tmp_path / "plain", tmp_path / "others"
    run, world = trained(method.last.name, runs), runs["folder"] / "world"
    if CASES[method.last.name].method != name:
        train(Case(name, method.last), plain, world)
        run = plain
    config, changed = with_others_changed(compose([*shared(out, world), f"method={name}", f"run={world}"]))
    assert {"model.savi.slot_dim", "slots.steps", "dynamics.steps", "dynamics.optim.lr"} & changed
    assert {"slots.precision", "dynamics.precision"} <= changed
    assert len(changed) > 200
    train_baseline.main(config)
    assert Run(out).own(method.last.name).fingerprint == Run(run).own(method.last.name).fingerprint
