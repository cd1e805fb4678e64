"""Functions of tensors that a GPU replays; what a graph computes is tested on one, in `tests/gpu`."""

from __future__ import annotations

import inspect
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from playslot_rl.frames import psnr
from playslot_rl.runtime.captured import Captured, stopped_at, uncaptured


def test_a_second_call_is_recorded_unless_capturing_is_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Captured, "_recorded", lambda *_: lambda *_: "replayed")
    on_a_gpu: Any = SimpleNamespace(shape=torch.Size([2]), dtype=torch.float32, device=torch.device("cuda"))
    layer = torch.nn.Linear(1, 1)
    call = Captured(lambda _: "called", layer)
    with torch.no_grad():
        assert [call(on_a_gpu) for _ in range(3)] == ["called", "replayed", "replayed"]
        with uncaptured():
            assert call(on_a_gpu) == "called"
        assert call(on_a_gpu) == "replayed"
    assert call(on_a_gpu) == "called"  # gradients would be lost


def test_a_recording_that_fails_names_the_first_error_and_our_line() -> None:
    def record() -> None:
        try:
            psnr("no tensor")  # type: ignore[arg-type]
        finally:
            raise RuntimeError("operation failed due to a previous error during capture")

    with pytest.raises(RuntimeError) as caught:
        record()
    line, _, said = stopped_at(caught.value).partition("`: ")
    assert "previous error" not in said
    assert line.removeprefix("`") in inspect.getsource(psnr)
