"""`playslot doctor`: every check finds what is broken, names a cure, and only essential ones fail the command."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from playslot_rl.config import DataConfig, ExperimentConfig
from playslot_rl.recipes import doctor
from playslot_rl.runtime import checks
from playslot_rl.runtime.threads import available_cores, set_threads, tune_allocator

pytestmark = pytest.mark.integration


def test_all_is_well_here(tmp_path: Path) -> None:
    """In a process of its own: what libraries print depends on what else has used them."""
    command = [sys.executable, "-m", "playslot_rl", "doctor", f"data.cache={tmp_path / 'cache'}", "device=cpu"]
    done = subprocess.run(command, capture_output=True, text=True)
    out = done.stdout
    assert (done.returncode, done.stderr) == (0, ""), "what a library floods its process with is not shown"
    assert "Traceback" not in out
    for name in ("Python", "packages", "torch", "rendering", "PyAV", "torchcodec", "FFmpeg", "disk", "cores", "cache"):
        assert len([line for line in out.splitlines() if f" {name} " in line[:21]]) == 1, name
    assert "drew a 64x64 frame" in out
    assert "everything essential works" in out


def test_one_failure_fails_the_command_and_shows_its_cure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(checks, "_ran", lambda _: (False, "no GL"))
    (tmp_path / "file").touch()
    assert doctor.main(ExperimentConfig(data=DataConfig(cache=str(tmp_path / "file" / "cache")))) == 1
    out = capsys.readouterr().out
    assert re.search("FAIL  rendering .*: no GL\n *-> set MUJOCO_GL", out)
    assert "-> set PLAYSLOT_CACHE" in out
    assert "2 essential part(s) do not work" in out


def test_a_gl_backend_that_cannot_draw_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    found = checks.check_rendering()
    assert found.status == "FAIL"
    assert "nonsense" in found.found
    assert "libegl1" in found.cure


def test_a_device_that_is_not_there_is_found() -> None:
    found = checks.check_torch("cuda:99")
    assert (found.status, found.cure) == ("FAIL", "choose device=cpu")


def test_a_wrong_version_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.version", lambda name: "0.0.1")
    found = checks.check_packages()
    assert found.status == "FAIL"
    assert "torch is 0.0.1, expected 2.11.0" in found.found


@pytest.mark.parametrize(("free", "status"), [(1e9, "FAIL"), (5e9, "warn"), (50e9, "ok")])
def test_little_disk_space_is_found(free: float, status: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def usage(path: Any) -> Any:
        return shutil._ntuple_diskusage(100e9, 0, free)  # type: ignore[attr-defined]

    monkeypatch.setattr(shutil, "disk_usage", usage)
    assert checks.check_disk(tmp_path / "not" / "there" / "yet").status == status


def test_the_allocator_setting_is_accepted_and_changes_no_result() -> None:
    # In a process of its own, since it cannot be undone.
    code = (
        "from playslot_rl.runtime.threads import tune_allocator\n"
        "print(tune_allocator(), tune_allocator(), len(bytes(300_000_000)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "True", "300000000"]


def test_the_allocator_is_left_alone_without_glibc(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.libc_ver", lambda: ("", ""))
    assert tune_allocator() is False


def test_threads() -> None:
    import torch

    before = torch.get_num_threads()
    try:
        assert set_threads(0) == before
        assert set_threads(2) == 2
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    with pytest.raises(ValueError, match="threads: got -1, expected 0"):
        set_threads(-1)
    assert available_cores() >= 1


def test_a_torchcodec_that_does_not_load_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "torchcodec").mkdir()
    (tmp_path / "torchcodec" / "__init__.py").write_text("raise RuntimeError('no library\\n' * 80)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr("importlib.metadata.version", lambda name: "0.9.0")
    found = checks.check_torchcodec()
    assert found.status == "ok"
    assert "0.9.0 does not load here, pyav is used" in found.found
    assert "\n" not in found.line()
    (tmp_path / "torchcodec" / "__init__.py").write_text("")
    (tmp_path / "torchcodec" / "decoders.py").write_text("")
    assert "0.9.0 loads" in checks.check_torchcodec().found
