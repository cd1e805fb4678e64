"""What works on this machine, one check each, and the cure for what does not."""

from __future__ import annotations

import importlib.metadata
import io
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from packaging.requirements import Requirement

from playslot_rl.runtime.devices import named_device
from playslot_rl.runtime.precision import resolve_precision
from playslot_rl.runtime.threads import available_cores

_MIN_DISK_GB: Final = 2.0
_GOOD_DISK_GB: Final = 10.0
_REINSTALL: Final = "run `make setup` again, or `pip install .` in a fresh environment of Python 3.12"
_PATIENCE_S: Final = 120

_DRAW_ONE_FRAME: Final = """
import os
from playslot_rl.envs.rendering import check_rendering
frame = check_rendering()
print(f"drew a {frame.shape[0]}x{frame.shape[1]} frame with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')}")
"""


@dataclass(frozen=True)
class Check:
    """One finding: `warn` works, but something is missing or slow; `FAIL` is an essential part that does not work."""

    name: str
    status: Literal["ok", "warn", "FAIL"]
    found: str
    cure: str = ""

    def line(self) -> str:
        """As printed: one line, or two with a cure."""
        text = f"{self.status:<5} {self.name:<14} {self.found}"
        return f"{text}\n{'':<21}-> {self.cure}" if self.cure else text


def check_python() -> Check:
    found = f"{platform.python_version()} at {sys.prefix}"
    if platform.python_version_tuple()[:2] == ("3", "12"):
        return Check("Python", "ok", found)
    return Check("Python", "FAIL", found, "expected Python 3.12: install it and run `make setup`")


def check_packages() -> Check:
    """Every requirement of the package is installed, in the version asked for where one is pinned."""
    try:
        requirements = importlib.metadata.requires("playslot_rl") or []
    except importlib.metadata.PackageNotFoundError:
        return Check("packages", "FAIL", "playslot_rl is not installed", _REINSTALL)
    wrong = []
    for requirement in map(Requirement, requirements):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            have = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            wrong.append(f"{requirement.name} is missing")
            continue
        if not requirement.specifier.contains(have, prereleases=True):
            wrong.append(f"{requirement.name} is {have}, expected {str(requirement.specifier).removeprefix('==')}")
    if wrong:
        return Check("packages", "FAIL", "; ".join(wrong), _REINSTALL)
    return Check("packages", "ok", "all requirements, in the pinned versions")


def check_torch(device: str = "") -> Check:
    """Torch computes on the device that a command would take."""
    try:
        import torch

        name = str(named_device(device))
        total = float(torch.ones(8, 8, device=name).matmul(torch.ones(8, 8, device=name)).sum())
    except Exception as error:  # noqa: BLE001  a broken torch fails with whatever its libraries raise
        return Check("torch", "FAIL", _one_line(error), "choose device=cpu" if device else _REINSTALL)
    if total != 512.0:
        return Check("torch", "FAIL", f"a product of ones sums to {total}, expected 512", _REINSTALL)
    what = torch.cuda.get_device_name() if name.startswith("cuda") else f"{torch.get_num_threads()} threads"
    chosen = resolve_precision("auto", torch.device(name).type)
    return Check("torch", "ok", f"{torch.__version__}, device {name} ({what}), precision=auto is {chosen}")


def _ran(code: str) -> tuple[bool, str]:
    """Whether code ran, in a process of its own, which a broken library may end or flood; and its last line."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=_PATIENCE_S, check=False
        )
    except subprocess.TimeoutExpired:
        return False, f"no end within {_PATIENCE_S} s"
    said = (done.stderr if done.returncode else done.stdout).strip().splitlines()
    return not done.returncode, said[-1] if said else f"the process ended with code {done.returncode}"


def check_rendering() -> Check:
    """The GL backend, by drawing a frame."""
    drew, said = _ran(_DRAW_ONE_FRAME)
    if drew:
        return Check("rendering", "ok", said)
    cure = (
        "set MUJOCO_GL to egl, osmesa or glfw and install its library "
        "(Debian, Ubuntu: apt-get install libegl1 libgl1 libosmesa6)"
    )
    return Check("rendering", "FAIL", f"MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r}: {said}", cure)


def check_video() -> Check:
    """PyAV writes and reads lossless h264, which `collect.storage=video` and foreign data sets need."""
    try:
        import av
        import numpy as np

        frame = np.full((64, 64, 3), 128, np.uint8)
        buffer = io.BytesIO()
        with av.open(buffer, "w", format="mp4") as container:
            stream = container.add_stream("libx264", rate=10, options={"crf": "0"})
            stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv444p"
            for packet in [*stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")), *stream.encode(None)]:
                container.mux(packet)
        buffer.seek(0)
        with av.open(buffer, "r") as source:
            count = len(list(source.decode(video=0)))
    except Exception as error:  # noqa: BLE001  av raises its own and FFmpeg's errors
        cure = f"only collect.storage=video and data sets with video need it; {_REINSTALL}"
        return Check("PyAV", "warn", _one_line(error), cure)
    if count != 1:
        return Check("PyAV", "warn", f"wrote 1 frame and read {count}", _REINSTALL)
    return Check("PyAV", "ok", f"{av.__version__}, h264 yuv444p written and read")


def check_torchcodec() -> Check:
    """Whether torchcodec loads, with which LeRobot decodes videos where it can; this package reads them by PyAV."""
    try:
        version = importlib.metadata.version("torchcodec")
    except importlib.metadata.PackageNotFoundError:
        return Check("torchcodec", "ok", "not installed (not needed: PyAV reads videos)")
    found = f"{version} does not load here, pyav is used (LeRobot's own reader takes it with video_backend='pyav')"
    if _ran("import torchcodec.decoders")[0]:
        found = f"{version} loads (LeRobot reads videos by it, this package by PyAV)"
    return Check("torchcodec", "ok", found)


def check_ffmpeg() -> Check:
    """A system FFmpeg is never needed, since PyAV brings its own."""
    path = shutil.which("ffmpeg")
    return Check("FFmpeg", "ok", path or "none on the path (not needed: PyAV brings its own)")


def check_disk(folder: Path) -> Check:
    try:
        there = next(path for path in (folder, *folder.parents) if path.exists())
        free = shutil.disk_usage(there).free / 1e9
    except OSError as error:
        return Check("disk", "FAIL", _one_line(error), f"choose another folder than {folder}")
    found = f"{free:.0f} GB free in {folder}"
    if free < _MIN_DISK_GB:
        return Check("disk", "FAIL", found, f"free at least {_MIN_DISK_GB:.0f} GB, or choose another folder with out=")
    if free < _GOOD_DISK_GB:
        return Check("disk", "warn", found, f"a full pipeline may need {_GOOD_DISK_GB:.0f} GB")
    return Check("disk", "ok", found)


def check_cores() -> Check:
    cores = available_cores()
    if cores < 2:
        return Check("cores", "warn", "1 core", "the times in the README are for two cores; expect twice as long")
    return Check("cores", "ok", f"{cores} cores, {platform.machine()}")


def check_cache(folder: Path) -> Check:
    cure = "set PLAYSLOT_CACHE (or data.cache=) to a folder that you can write"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder) as probe:
            probe.write(b"playslot")
    except OSError as error:
        return Check("cache", "FAIL", f"{folder}: {_one_line(error)}", cure)
    return Check("cache", "ok", f"{folder} can be written")


def _one_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
