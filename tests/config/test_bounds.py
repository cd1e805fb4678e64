"""Every number of the config has bounds in its field, and what lies outside of them ends in one line at once.

The table of bad values is made from the fields, so that a new one is in it. Values go the way of the command line.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import subprocess
import sys
import time
import types
import typing
from collections.abc import Iterator
from typing import Any, Union, get_args, get_origin

import pytest

from playslot_rl import cli
from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.compose import compose
from playslot_rl.config.machine import machine_memory, needs
from playslot_rl.config.plain import type_hints
from playslot_rl.config.roles import Bounds, Checked
from playslot_rl.errors import ConfigError

LIMIT_S = 5.0
SECRET = "not-to-be-printed"


def number_of(hint: Any) -> type | None:
    """int or float, where a field holds one, several of them, or None."""
    if get_origin(hint) in (Union, types.UnionType, tuple):
        return next((kind for part in get_args(hint) if (kind := number_of(part))), None)
    return hint if hint in (int, float) else None


def fields(cls: type, prefix: str = "") -> Iterator[tuple[str, type, dataclasses.Field[Any], Any]]:
    """Dotted key, class, field and type of every leaf."""
    hints = type_hints(cls)
    for field in dataclasses.fields(cls):
        hint = hints[field.name]
        if dataclasses.is_dataclass(hint):
            yield from fields(typing.cast(type, hint), f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", cls, field, hint


NUMBERS = {key: (field, hint) for key, _, field, hint in fields(ExperimentConfig) if number_of(hint)}
FIRST = {group: key for key in reversed(NUMBERS) if (group := key.rpartition(".")[0]) or "." not in key}.values()
"""A key of every group."""


def unbounded(cls: type) -> list[str]:
    """Numbers that nothing bounds, or that a class does not check."""
    return [
        key
        for key, owner, field, hint in fields(cls)
        if number_of(hint)
        and not (
            issubclass(owner, Checked)
            and isinstance(bounds := field.metadata.get("bounds"), Bounds)
            and bounds.smallest is not None
            and bounds.largest is not None
            and math.isfinite(bounds.smallest)
            and bounds.smallest < bounds.largest < math.inf
        )
    ]


def bad_values(key: str) -> list[str]:
    field, hint = NUMBERS[key]
    bounds: Bounds = field.metadata["bounds"]
    assert bounds.smallest is not None
    assert bounds.largest is not None
    below, above = bounds.smallest - 1, bounds.largest + max(1, bounds.largest * 1e-6)
    if number_of(hint) is int:
        below, above = int(below), int(above)
    huge = "1e308" if bounds.largest > 10**22 else "9" * 23  # a rate may be as large, and is said to diverge
    texts = ["nan", "inf", str(below), str(above), huge]
    if key in FIRST:
        texts += ["-inf", "9" * 400, "-1e308", "1_000", "x", "true"]
    return [f"[{text}]" if get_origin(hint) is tuple else text for text in texts]


def test_every_number_has_bounds() -> None:
    assert unbounded(ExperimentConfig) == []
    assert len(NUMBERS) > 250


def test_a_number_without_bounds_is_found() -> None:
    @dataclasses.dataclass(frozen=True)
    class Unchecked:
        one: int = dataclasses.field(default=1, metadata={"bounds": Bounds(lambda value: True, "", 0, 2)})

    @dataclasses.dataclass(frozen=True)
    class New(Checked):
        text: str = ""
        none: float | None = None
        several: tuple[int, ...] = ()
        bounded: int = dataclasses.field(default=1, metadata={"bounds": Bounds(lambda value: True, "", 0, 2)})
        endless: float = dataclasses.field(default=1, metadata={"bounds": Bounds(lambda value: True, "", 0, math.inf)})

    globals()["Unchecked"] = Unchecked
    found = unbounded(dataclasses.make_dataclass("All", [("new", New), ("other", Unchecked)]))
    assert found == ["new.none", "new.several", "new.endless", "other.one"]


def test_the_defaults_lie_within_and_the_table_is_large() -> None:
    for cls in {owner for _, owner, _, _ in fields(ExperimentConfig)}:
        cls()
    assert sum(len(bad_values(key)) for key in NUMBERS) > 1500
    groups = {key.rpartition(".")[0] for key in FIRST}
    assert {"", "env", "collect", "slots.optim", "model.savi", "baselines.sold", "adopt", "plan", "play"} <= groups


@pytest.mark.parametrize("key", FIRST)
def test_a_bad_number_is_one_line_that_names_its_key(key: str, capsys: pytest.CaptureFixture[str]) -> None:
    for text in bad_values(key):
        began = time.monotonic()
        code = cli.main(["train-slots", f"{key}={text}"])
        took = time.monotonic() - began
        out, err = capsys.readouterr()
        assert (code, out, err.count("\n")) == (2, "", 1), (text, err)
        assert err.startswith("playslot train-slots: error: ")
        assert "unexpected" not in err
        assert f"{key.rpartition('.')[2]}: got " in err
        assert took < LIMIT_S


def test_no_group_takes_a_bad_number() -> None:
    for key, owner, field, hint in fields(ExperimentConfig):
        for text in bad_values(key) if key in NUMBERS and key not in FIRST else ():
            number = text.strip("[]")
            value = int(number) if number.lstrip("-").isdecimal() else float(number)
            with pytest.raises(ValueError, match=f"{field.name}: got "):
                owner(**{field.name: (value,) if get_origin(hint) is tuple else value})


@pytest.mark.parametrize(
    "argument",
    [
        "model.savi.slot_dim=1000000000",
        "model.savi.n_slots=1000000000",
        "model.savi.encoder_channels=[1000000,1000000,8]",
        "model.savi.decoder_channels=[1000000,1000000]",
        "model.savi.transition_mlp=1000000000",
        "model.inverse_dynamics.n_prototypes=1000000000",
        "model.inverse_dynamics.dim=1000000000",
        "model.predictor.heads=1000000000",
        "model.predictor.context=1000000000",
        "model.policy.mlp_dim=1000000000",
        "model.action_decoder.hidden_dim=10000000",
        "model={savi:{token_dim:1000000000}}",
        "slots.batch_size=1000000000",
        "slots.clip_frames=1000000000",
        "dynamics.batch_size=100000000",
        "dynamics.predicted_frames=1000000000",
        "behaviour.batch_size=1000000000",
        "data.shuffle_buffer=1000000000",
        "collect.expert_steps=1000000000",
        "plan.candidates=1000000000",
        "baselines.resnet_oracle.batch_size=1000000000",
        "baselines.lapo.hidden=1000000000",
        "baselines.lapo.model.batch_size=1000000000",
        "baselines.svg.hidden=10000000",
        "baselines.caddy.dynamics=10000000",
        "baselines.caddy_policy.policy.batch_size=1000000000",
        "baselines.dreamer.units=10000000",
        "baselines.dreamer.capacity=1000000000",
        "baselines.sold.mlp_dim=1000000000",
        "baselines.sold.starts=1000000000",
        "baselines.slotformer.predictor.mlp_dim=1000000000",
        "baselines.ocvp_seq.batch_size=1000000000",
    ],
)
def test_what_cannot_fit_is_refused_with_the_estimate(argument: str, capsys: pytest.CaptureFixture[str]) -> None:
    began = time.monotonic()
    assert cli.main(["train-slots", "preset=smoke", "device=cpu", argument]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert argument in err
    assert "need at least" in err
    assert "B of memory, expected at most the " in err
    assert time.monotonic() - began < LIMIT_S


def test_the_estimate_is_of_what_would_be_allocated() -> None:
    from playslot_rl.modules.savi import SAVi

    for preset in ("smoke", "compact"):
        config = compose([f"preset={preset}"])
        weights = sum(weight.numel() for weight in SAVi(config.model.savi, 64).parameters())
        least = next(need.size for need in needs(config) if need.what == "SAVi's weights") / 16
        assert 0.5 * weights < least <= weights


def test_threads_are_bounded_by_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("playslot_rl.config.machine.available_cores", lambda: 2)
    assert compose(["threads=64"]).threads == 64
    with pytest.raises(ConfigError, match=r"^threads: got 65, expected at most 64 for 2 cores: use 2$"):
        compose(["threads=65"])
    monkeypatch.setattr("playslot_rl.config.machine.available_cores", lambda: 100)
    assert compose(["threads=800"]).threads == 800


def test_a_comparison_on_other_machines_is_left_to_them() -> None:
    slurm = ["hydra.launcher=submitit_slurm", "slots.batch_size=1000000000", "threads=1000"]
    assert compose(slurm, "compare").slots.batch_size == 10**9
    with pytest.raises(ConfigError, match="need at least"):
        compose(["hydra.launcher=joblib", *slurm[1:2]], "compare")


@pytest.mark.parametrize("preset", ["smoke", "compact", "gpu", "paper"])
def test_shipped_presets_and_stored_runs_are_never_refused_for_memory(
    preset: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert machine_memory() > 10**8
    monkeypatch.setattr("playslot_rl.config.machine.machine_memory", lambda: 1000)
    assert compose([f"preset={preset}", "seed=3", "device=cpu"]).seed == 3
    with pytest.raises(ConfigError, match=r"^slots\.batch_size=2: got sizes with which the windows of a batch need"):
        compose([f"preset={preset}", "slots.batch_size=2", "device=cpu"])


ONCE_TAKEN = [
    ("seed=1", "seed=2"),
    ("seed=1_000",),
    ("slots={steps:1_000}",),
    ("model.savi.encoder_channels=[8,1_6,8]",),
    ("out=[a,b]",),
    ("out=a\nb",),
    ("out=a\x1b[2J",),
    ("out=a\udcff",),
    ("out=" + "x" * 256,),
    ("out=" + "x/" * 3000,),
    ("data.root=a,b" + "x" * 256,),
    ("slots.steps=" + "9" * 5000,),
]


@pytest.mark.parametrize("arguments", ONCE_TAKEN, ids=str)
def test_a_slip_is_refused_with_its_key(arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["collect", *arguments]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert f"error: {arguments[0].partition('=')[0]}: got " in err
    assert len(err) < 500


INTERPOLATIONS = [
    "seed=${oc.env:PLAYSLOT_SECRET}",
    "out=${oc.env:PLAYSLOT_SECRET}",
    "out=${data.root}",
    "out='${oc.env:PLAYSLOT_SECRET}'",
    "out=$\\{oc.env:PLAYSLOT_SECRET\\}",
    "data.root=a,${oc.env:PLAYSLOT_SECRET}",
    "model.savi.encoder_channels=[8,${oc.env:PLAYSLOT_SECRET},8]",
    "slots={steps:${oc.env:PLAYSLOT_SECRET}}",
    "slots.optim={lr:${slots.optim.${oc.env:PLAYSLOT_SECRET}}}",
    "env=${oc.env:PLAYSLOT_SECRET}",
    "preset=${oc.env:PLAYSLOT_SECRET}",
    "run=${oc.env:PLAYSLOT_SECRET}",
    "method=${oc.env:PLAYSLOT_SECRET}",
    "${oc.env:PLAYSLOT_SECRET}=1",
    "${oc.env:PLAYSLOT_SECRET}",
    "hydra.launcher.n_jobs=${oc.env:PLAYSLOT_SECRET}",
    "hydra.launcher.n_jobs=$\\{oc.env:PLAYSLOT_SECRET\\}",
]


@pytest.mark.parametrize(
    ("command", "argument"),
    [*(("collect", text) for text in INTERPOLATIONS), *((name, INTERPOLATIONS[0]) for name in ("compare", "evaluate"))],
)
def test_nothing_is_interpolated(
    command: str, argument: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PLAYSLOT_SECRET", SECRET)
    assert cli.main([command, argument]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert "got an interpolation (${...}), expected the value itself" in err
    assert SECRET not in err
    assert "PLAYSLOT_SECRET" not in err


def test_the_values_of_a_stored_run_are_text(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLAYSLOT_SECRET", SECRET)
    stored = to_dict(compose(["preset=smoke"])) | {"out": "${oc.env:PLAYSLOT_SECRET}"}
    (tmp_path / "config.json").write_text(json.dumps(stored | {"run": ""}))
    assert SECRET not in json.dumps(to_dict(compose([f"run={tmp_path}"], "evaluate")))


@pytest.mark.integration
@pytest.mark.parametrize(
    ("command", "argument"),
    [
        ("train-slots", "slots.optim.lr=nan"),
        ("train-slots", "model.savi.slot_dim=1000000000"),
        ("adopt", "minutes=1e308"),
        ("collect", "collect.noise=nan"),
        ("evaluate", "seed=${oc.env:PLAYSLOT_SECRET}"),
    ],
)
def test_a_real_process_says_so_too(command: str, argument: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "playslot_rl", command, argument],
        env=os.environ | {"PLAYSLOT_SECRET": SECRET},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done.stderr
    assert done.stderr.startswith(f"playslot {command}: error: ")
    assert "unexpected" not in done.stderr
    assert SECRET not in done.stderr
