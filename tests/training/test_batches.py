"""A global batch in micro-batches, averages of the weights, compiled parts: what `fit` does beside the plain step."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from ranks import log_of
from tiny_stages import STAGES

from playslot_rl.config.compose import compose
from playslot_rl.errors import ConfigError
from playslot_rl.modules.savi import SAVi
from playslot_rl.modules.savi.decoder import _doubled
from playslot_rl.modules.transformer import TransformerBlock
from playslot_rl.storage.tensors import load_tensors, module_tensors
from playslot_rl.training import compiling
from playslot_rl.training import fit as fit_module
from playslot_rl.training.averages import WeightAverage
from playslot_rl.training.compiling import LEAST_STEPS, compile_parts, compiling_pays, release_parts, worth_compiling
from playslot_rl.training.fit import Part, fit


def changed(name: str, steps: int = 20, **optim: float) -> Part:
    part = STAGES[name]()
    config = replace(part.config, steps=steps, optim=replace(part.config.optim, **optim))
    return replace(part, config=config)


@pytest.mark.integration
@pytest.mark.parametrize("name", ["slots", "dynamics", "decoder"])
def test_micro_batches_give_the_curve_of_the_whole_batch(tmp_path: Path, name: str) -> None:
    fit(changed(name), tmp_path / "whole", seed=3)
    fit(changed(name, accumulate=3), tmp_path / "parts", seed=3)
    for whole, parts in zip(log_of(tmp_path / "whole"), log_of(tmp_path / "parts"), strict=True):
        assert parts["step"] == whole["step"]
        if whole["split"] == "train":
            assert parts["loss"] == pytest.approx(whole["loss"], rel=1e-5)
            assert parts["grad_norm"] == pytest.approx(whole["grad_norm"], rel=1e-4)


@pytest.mark.integration
def test_a_training_in_micro_batches_is_carried_on_in_one(tmp_path: Path) -> None:
    interrupt(changed("policy", accumulate=2), tmp_path / "parts")
    _, start = fit(changed("policy"), tmp_path / "parts", seed=3)
    fit(changed("policy"), tmp_path / "whole", seed=3)
    assert start == 10
    rows = [log_of(tmp_path / name)[-2] for name in ("whole", "parts")]
    assert rows[1]["loss"] == pytest.approx(rows[0]["loss"], rel=1e-5)


def interrupt(part: Part, folder: Path) -> None:
    """Train until the last validation, at which there is a Ctrl-C: the checkpoint after ten steps is the last one."""
    original = part.stage.validate

    def stop(step: int) -> dict[str, float]:
        if step == 20:
            raise KeyboardInterrupt
        return dict(original(step))

    part.stage.validate = stop  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        fit(part, folder, seed=3)


def test_shares_that_do_not_divide_the_batch_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"dynamics\.batch_size: got 6, expected a multiple of 4") as caught:
        fit(changed("dynamics", accumulate=4), tmp_path, seed=3)
    assert "\n" not in str(caught.value)


def test_a_network_that_normalises_by_its_batch_does_not_accumulate(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"svg\.optim\.accumulate: got 2, expected 1"):
        fit(changed("svg", accumulate=2), tmp_path, seed=3)


def test_the_average_is_validated_and_kept(tmp_path: Path) -> None:
    plain, averaged = changed("policy", 10), changed("policy", 10, ema=0.9)
    fit(plain, tmp_path / "plain", seed=3)
    fit(averaged, tmp_path / "ema", seed=3)
    stored = tmp_path / "ema" / "checkpoints" / "step_00000010"
    last, average = load_tensors(stored / "modules.safetensors"), load_tensors(stored / "average.safetensors")
    ended, without = module_tensors(averaged.stage.modules), module_tensors(plain.stage.modules)
    for name, value in average.items():
        assert torch.equal(ended[name], value), name
    for name in last:
        assert torch.equal(last[name], without[name]), name  # averaging changes nothing of what is learned
    assert any(not torch.equal(ended[name], last[name]) for name in average)
    rows = [[row for row in log_of(tmp_path / name) if row["split"] == "validation"] for name in ("plain", "ema")]
    assert rows[0] != rows[1]


@pytest.mark.integration
def test_an_average_resumes_bit_for_bit(tmp_path: Path) -> None:
    whole, half = changed("policy", ema=0.9), changed("policy", ema=0.9)
    fit(whole, tmp_path / "whole", seed=3)
    interrupt(half, tmp_path / "parts")
    rest = changed("policy", ema=0.9)
    assert fit(rest, tmp_path / "parts", seed=3)[1] == 10
    one, other = module_tensors(whole.stage.modules), module_tensors(rest.stage.modules)
    assert [name for name in one if not torch.equal(one[name], other[name])] == []
    again = changed("policy", ema=0.9)
    fit(again, tmp_path / "parts", seed=3)  # finished: the average all the same
    assert torch.equal(module_tensors(again.stage.modules)["policy.head.weight"], one["policy.head.weight"])


def test_the_average_forgets_where_the_weights_began() -> None:
    weight = torch.nn.Parameter(torch.zeros(3))
    average = WeightAverage({"w": weight}, 0.999)
    with torch.no_grad():
        weight.fill_(1.0)
    for step in range(1, 31):
        average.update(step)
    assert float(average.tensors["w"].min()) > 0.999
    with average.shown():
        assert torch.equal(weight, average.tensors["w"])
    assert torch.equal(weight, torch.ones(3))


@pytest.mark.integration
@pytest.mark.parametrize("stage", ["slots", "dynamics", "policy"])
def test_what_is_compiled_are_the_parts_that_are_called(stage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """SAVi's two methods; elsewhere each block of a list of them, never the list; and none is left compiled."""
    monkeypatch.setenv("CXX", "g++")
    modules = STAGES[stage]().stage.modules
    before = {id(part): set(vars(part)) for module in modules.values() for part in module.modules()}
    compile_parts(modules, "compile")
    inner = [part for module in modules.values() for part in module.modules()]
    marked = {id(part): set(vars(part)) - before[id(part)] for part in inner if set(vars(part)) != before[id(part)]}
    assert marked
    if stage == "slots":
        assert list(marked.values()) == [{"features", "rendered"}]
    else:
        assert all(names == {"forward"} for names in marked.values())
        assert not any(id(part) in marked for part in inner if isinstance(part, torch.nn.ModuleList))
        covered = {id(part) for whole in inner if id(whole) in marked for part in whole.modules()}
        assert {id(part) for part in inner if isinstance(part, TransformerBlock)} <= covered
    release_parts(modules)
    assert all(set(vars(part)) == before[id(part)] for part in inner)


def test_compiling_without_a_compiler_is_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling.shutil, "which", lambda name: None)
    monkeypatch.delenv("CXX", raising=False)
    part = STAGES["policy"]()
    with pytest.raises(ConfigError, match=r"policy\.compile=true: got no C\+\+ compiler") as caught:
        fit(replace(part, config=replace(part.config, compile=True)), tmp_path, seed=3)
    assert "\n" not in str(caught.value)


def test_left_open_compiling_is_for_large_networks_on_a_gpu_with_many_steps_to_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(compiling, "_compiles", lambda _: True)
    gpu, cpu = torch.device("cuda"), torch.device("cpu")
    monkeypatch.setenv("CXX", "g++")
    monkeypatch.setattr(compiling.importlib.util, "find_spec", lambda _: object())
    assert compiling_pays(gpu, LEAST_STEPS)
    assert not compiling_pays(gpu, LEAST_STEPS - 1)
    assert not compiling_pays(cpu, LEAST_STEPS)
    monkeypatch.setattr(compiling.shutil, "which", lambda _: None)
    monkeypatch.delenv("CXX")
    assert not compiling_pays(gpu, LEAST_STEPS)
    full, strided = (SAVi(compose([f"preset={preset}"]).model.savi, 64) for preset in ("paper", "compact"))
    plain = torch.nn.Linear(1, 1)
    assert list(worth_compiling({"full": full, "strided": strided, "plain": plain})) == ["full"]
    monkeypatch.setattr(compiling, "COMPACT", True)
    assert list(worth_compiling({"full": full, "strided": strided, "plain": plain})) == ["full", "strided"]


@pytest.mark.parametrize(
    ("asked", "pays", "expected"), [(None, True, True), (None, False, False), (False, True, False)]
)
def test_what_a_training_compiles_unasked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: bool | None, pays: bool, expected: bool
) -> None:
    left: list[int] = []
    compiled: list[dict[str, torch.nn.Module]] = []
    monkeypatch.setattr(fit_module, "compiling_pays", lambda _, steps: bool(left.append(steps)) or pays)
    monkeypatch.setattr(fit_module, "worth_compiling", lambda modules: {"some": modules["savi"]})
    monkeypatch.setattr(fit_module, "compile_parts", lambda modules, _: compiled.append(modules))
    part = changed("slots", 2)
    fit(replace(part, config=replace(part.config, compile=asked)), tmp_path, seed=3)
    assert [list(modules) for modules in compiled] == ([["some"]] if expected else [])
    assert left == ([2] if asked is None else [])


@pytest.mark.integration
@pytest.mark.skipif(not compiling.has_compiler(), reason="needs a C++ compiler")
def test_a_doubling_can_be_compiled() -> None:
    conv, x = torch.nn.Conv2d(4, 16, 3, padding=1), torch.rand(2, 4, 8, 8)
    assert torch.allclose(torch.compile(_doubled)(conv, x, True), _doubled(conv, x, True), atol=1e-5)
