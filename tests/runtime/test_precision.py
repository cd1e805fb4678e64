"""`precision=auto`: bf16 where the processor has it, fp32 elsewhere; a run goes on on another processor."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
import torch

from playslot_rl.config import ExperimentConfig, Precision, SAViConfig
from playslot_rl.config.compose import compose
from playslot_rl.config.plain import flatten, to_dict
from playslot_rl.modules.savi import SAVi
from playslot_rl.runtime import precision as subject
from playslot_rl.runtime.precision import autocast, keeping, native_bf16, resolve_precision, speedup
from playslot_rl.storage.resume import first_difference


@pytest.fixture(params=[True, False], ids=["bf16", "no bf16"])
def native(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """A processor with bf16 arithmetic, and one without."""
    there: bool = request.param
    monkeypatch.setattr(subject, "native_bf16", lambda _device: there)
    subject._warn_of_emulation.cache_clear()
    return there


@pytest.mark.parametrize("asked", ["fp32", "bf16", "auto"])
def test_auto_is_what_the_processor_has_and_the_others_are_themselves(native: bool, asked: Precision) -> None:
    expected = ("bf16" if native else "fp32") if asked == "auto" else asked
    assert resolve_precision(asked, "cpu") == expected
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with autocast("cpu", asked):
            assert torch.is_autocast_enabled("cpu") is (expected == "bf16")


def test_savi_under_auto_is_savi_under_what_it_stands_for(native: bool) -> None:
    torch.manual_seed(0)
    savi = SAVi(
        SAViConfig(n_slots=2, slot_dim=8, encoder_channels=(8,), encoder_strides=(1,), decoder_channels=(8,)),
        image_size=32,
    )
    slots = torch.randn(1, 2, 8)
    found = {}
    names: tuple[Precision, ...] = ("fp32", "bf16", "auto")
    for name in names:
        savi.precision = name
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found[name] = savi.decode(slots).frames
    assert torch.equal(found["auto"], found["bf16" if native else "fp32"])
    assert not torch.equal(found["fp32"], found["bf16"])


def test_emulated_bf16_is_warned_of_once(native: bool) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(3):
            autocast("cpu", "bf16")
            autocast("cpu", "auto")
    messages = [str(one.message) for one in caught]
    assert len(messages) == (0 if native else 1)
    assert all("use precision=auto" in message for message in messages)


@pytest.mark.skipif(not Path("/proc/cpuinfo").is_file(), reason="no list of the processor's abilities")
def test_a_processor_is_asked_and_a_device_without_an_answer_has_none() -> None:
    flags = Path("/proc/cpuinfo").read_text().split()
    assert native_bf16("cpu") is bool({"avx512_bf16", "amx_bf16", "bf16"} & set(flags))
    assert not native_bf16("meta")


@pytest.mark.parametrize(
    ("stored", "wanted", "same"),
    [("bf16", "auto", True), ("fp32", "auto", True), ("auto", "auto", True), ("auto", "fp32", False),
     ("bf16", "fp32", False)],
)  # fmt: skip
def test_a_run_goes_on_under_auto_whatever_it_began_with(stored: str, wanted: str, same: bool) -> None:
    difference = first_difference({"stage": {"precision": stored}}, {"stage": {"precision": wanted}})
    assert (difference is None) is same


def test_the_compact_preset_leaves_every_precision_to_the_processor_or_to_fp32() -> None:
    config: ExperimentConfig = compose(["preset=compact"])
    found = {key: value for key, value in flatten(to_dict(config)).items() if key.endswith("precision")}
    assert set(found.values()) == {"auto", "fp32"}
    assert found["slots.precision"] == found["dynamics.precision"] == "auto"


def test_a_gpu_is_measured_and_a_processor_taken_at_its_word(native: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    for times, quicker in ((1.05, False), (1.1, True), (2.0, True)):
        monkeypatch.setattr(subject, "speedup", lambda device, times=times: (asked.append(device), times)[1])
        assert resolve_precision("auto", "cuda") == ("bf16" if native and quicker else "fp32")
        assert resolve_precision("auto", "cpu") == ("bf16" if native else "fp32")
        assert resolve_precision("bf16", "cuda") == "bf16"
    assert asked == (["cuda"] * 3 if native else [])


def test_the_measurement_draws_no_random_numbers() -> None:
    before = torch.get_rng_state()
    with torch.inference_mode():
        assert 0 < speedup("cpu", 1, 8, 2) < float("inf")
    assert torch.equal(torch.get_rng_state(), before)


def test_what_a_training_began_with_is_kept_but_where_it_is_emulated(native: bool) -> None:
    with keeping("fp32"):
        assert resolve_precision("auto", "cpu") == "fp32"
        assert resolve_precision("bf16", "cpu") == "bf16"
    with keeping("bf16"):
        assert resolve_precision("auto", "cpu") == ("bf16" if native else "fp32")
    with keeping("auto"):
        assert resolve_precision("auto", "cpu") == ("bf16" if native else "fp32")
