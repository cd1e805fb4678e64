"""The images: built and tried where docker runs; elsewhere the Dockerfile is read against the tree."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from playslot_rl.envs.rendering import CURE

TARGETS = ("cpu", "cuda")


def docker_runs() -> bool:
    """Whether there is a docker, and its daemon answers."""
    return (
        shutil.which("docker") is not None and subprocess.run(["docker", "info"], capture_output=True).returncode == 0
    )


@pytest.fixture(scope="module")
def dockerfile(repository: Path) -> str:
    return (repository / "Dockerfile").read_text()


def copied(dockerfile: str) -> list[str]:
    """What comes from the repository."""
    lines = re.findall(r"^COPY (?!--from)(.+)", dockerfile, re.MULTILINE)
    return [name for line in lines for name in line.split()[:-1]]


def test_everything_that_is_copied_exists_and_is_not_ignored(repository: Path, dockerfile: str) -> None:
    kept = {line[1:] for line in (repository / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert set(copied(dockerfile)) == kept
    assert [name for name in kept if not (repository / name).exists()] == []


def test_there_is_a_target_for_a_cpu_and_one_for_cuda(dockerfile: str) -> None:
    stages = re.findall(r"^FROM (\S+) AS (\S+)", dockerfile, re.MULTILINE)
    assert set(TARGETS) <= {name for _, name in stages}
    earlier: list[str] = []
    for base, name in stages:
        assert base in {"python:3.12-slim", *earlier}
        earlier.append(name)


def test_the_user_is_not_root_and_the_command_is_playslot(dockerfile: str) -> None:
    assert re.findall(r"^USER (\S+)", dockerfile, re.MULTILINE) == ["playslot"]
    assert re.findall(r"^ENTRYPOINT (.+)", dockerfile, re.MULTILINE) == ['["playslot"]']


def test_the_installer_is_that_of_the_makefile(repository: Path, dockerfile: str) -> None:
    wanted = re.search(r"^UV_VERSION := (\S+)", (repository / "Makefile").read_text(), re.MULTILINE)
    assert wanted is not None
    assert re.findall(r"uv==(\S+)", dockerfile) == [wanted[1]]


def test_what_draws_is_installed(dockerfile: str) -> None:
    named = re.search(r"apt-get install (lib[a-z0-9 ]+)", CURE)
    assert named is not None
    installed = dockerfile[dockerfile.index("apt-get install") :].splitlines()[0].split()
    assert set(named[1].split()) <= set(installed)


@pytest.fixture(params=TARGETS)
def image(request: pytest.FixtureRequest, repository: Path) -> Iterator[str]:
    name = f"playslot-test:{request.param}"
    subprocess.run(["docker", "build", "--target", request.param, "--tag", name, str(repository)], check=True)
    yield name
    subprocess.run(["docker", "image", "rm", name], check=True)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not docker_runs(), reason="needs a running docker")
def test_an_image_is_built_and_its_command_runs(image: str, tmp_path: Path) -> None:
    for words in (["--help"], ["doctor"]):
        done = subprocess.run(["docker", "run", "--rm", image, *words], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    code = "import playslot_rl; from playslot_rl.pretrained import episode; "
    code += "print(playslot_rl.load('pretrained').act(episode()[0]).shape)"
    run = ["docker", "run", "--rm", "--entrypoint", "python", image, "-c", code]
    assert subprocess.run(run, capture_output=True, text=True, check=True).stdout.strip() == "(4,)"
