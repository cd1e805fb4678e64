"""The package: what is listed is what is there, what is built is complete, and importing it costs nothing."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import playslot_rl

MAPPED = ("envs", "collectors", "recipes")
PLUGIN = "lerobot_policy_playslot"
DATA_SUFFIXES = {".yaml", ".safetensors", ".json", ".png", ".css", ".md", ".typed"}
# Machines have hosts and folders of their own: none of them belongs into a file that is shared.
INDEX_ADDRESS = re.compile(r"(?i)https?://|file:|--(extra-)?index-url|--find-links|^-i |^-f ")


def settings(repository: Path) -> dict[str, object]:
    return tomllib.loads((repository / "pyproject.toml").read_text())


def installed_files(repository: Path) -> set[str]:
    """Files of the tree that have to be in the wheel, by the path they get there."""
    files = set()
    for folder in (repository / "playslot_rl", *(repository / name for name in MAPPED)):
        for path in folder.rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts and path.suffix in {".py", *DATA_SUFFIXES}:
                relative = path.relative_to(repository).as_posix()
                files.add(relative if relative.startswith("playslot_rl/") else f"playslot_rl/{relative}")
    return files


def test_every_folder_of_the_tree_is_a_listed_subpackage(repository: Path) -> None:
    tool = settings(repository)["tool"]
    assert isinstance(tool, dict)
    listed = tool["setuptools"]["packages"]
    files = installed_files(repository)
    found = {path.rpartition("/")[0].replace("/", ".") for path in files if path.endswith("/__init__.py")}
    assert sorted(found) == listed
    code = {path.rpartition("/")[0].replace("/", ".") for path in files if path.endswith(".py")}
    assert code <= found, "a folder with code has no __init__.py"


def test_the_lock_is_hashed_and_names_no_index(repository: Path) -> None:
    lines = (repository / "requirements.lock").read_text().splitlines()
    assert not [line for line in lines if INDEX_ADDRESS.search(line)]
    pins = [line for line in lines if line and not line.startswith((" ", "#"))]
    assert len(pins) > 50
    assert all(re.match(r"[a-z0-9._-]+==\S+( ; .+)? \\$", line) for line in pins)
    for index, line in enumerate(lines):
        if not line.startswith(" "):
            assert lines[index + 1].startswith("    --hash=sha256:")


def test_every_dependency_is_locked_in_its_pinned_version(repository: Path) -> None:
    lock = (repository / "requirements.lock").read_text()
    project = settings(repository)["project"]
    assert isinstance(project, dict)
    for requirement in [*project["dependencies"], *project["optional-dependencies"]["dev"]]:
        match = re.match(r"([A-Za-z0-9._-]+)(?:\[[^]]*\])?(==\S+)?", requirement)
        assert match is not None
        pin = re.escape(f"{match[1]}{match[2] or '=='}")
        assert re.search(rf"(?m)^{pin}", lock), f"{requirement} is not in the lock: run `make lock`"


def test_the_links_for_type_checkers_show_the_installed_package(repository: Path) -> None:
    subprocess.run(["make", "typing"], cwd=repository, check=True)
    links = {path.name: path for path in (repository / ".typing" / "playslot_rl").iterdir()}
    wanted = {path.name: path for path in (repository / "playslot_rl").iterdir() if path.name != "__pycache__"}
    wanted |= {name: repository / name for name in MAPPED}
    assert links.keys() == wanted.keys()
    assert all(link.is_symlink() and link.resolve() == wanted[name] for name, link in links.items())


def test_importing_the_package_loads_no_library() -> None:
    code = "import sys, playslot_rl, playslot_rl.cli; print([m for m in sys.modules if '.' not in m])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for heavy in ("torch", "torchrl", "tensordict", "lerobot", "mujoco", "metaworld", "hydra", "matplotlib", "numpy"):
        assert f"'{heavy}'" not in done.stdout


def test_importing_subpackages_loads_no_simulator() -> None:
    code = "import sys, playslot_rl.envs, playslot_rl.collectors, playslot_rl.recipes; print(list(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for heavy in ("torchrl", "lerobot", "mujoco", "metaworld"):
        assert f"'{heavy}'" not in done.stdout


def test_the_version_is_stated_once(repository: Path) -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+", playslot_rl.__version__)
    assert playslot_rl.__version__ not in (repository / "pyproject.toml").read_text().partition("[tool.setuptools]")[0]


def copied(repository: Path, to: Path) -> Path:
    """What a wheel is made from: setuptools leaves build/ in the source folder, whose stale files would hide a missing
    one.
    """
    source = to / "source"
    for name in ("playslot_rl", *MAPPED):
        shutil.copytree(repository / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(repository / name, source / name)
    return source


@pytest.mark.integration
def test_the_wheel_is_complete(repository: Path, tmp_path: Path) -> None:
    source = copied(repository, tmp_path)
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(source)]
    done = subprocess.run(build, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (entries,) = (archive.read(name).decode() for name in names if name.endswith("/entry_points.txt"))
    assert {name for name in names if name.startswith("playslot_rl/")} == installed_files(repository)
    assert "[console_scripts]\nplayslot = playslot_rl.cli:main\n" in entries
    assert "[gymnasium.envs]\n__root__ = playslot_rl.envs:register\n" in entries
    assert {name.partition("/")[0].partition("-")[0] for name in names} == {"playslot_rl"}
    assert any(name.endswith("dist-info/licenses/LICENSE") for name in names)


@pytest.mark.integration
def test_the_plugins_wheel_is_complete(repository: Path, tmp_path: Path) -> None:
    source = tmp_path / "source"
    shutil.copytree(repository / PLUGIN, source, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info", "build"))
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(source)]
    done = subprocess.run(build, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (metadata,) = (archive.read(name).decode() for name in names if name.endswith("/METADATA"))
    files = {path.name for path in (repository / PLUGIN / "src" / PLUGIN).iterdir() if path.is_file()}
    assert {f"{part}_playslot.py" for part in ("configuration", "modeling", "processor")} <= files, "LeRobot's names"
    assert {name for name in names if name.startswith(f"{PLUGIN}/")} == {f"{PLUGIN}/{name}" for name in files}
    assert f"\nName: {PLUGIN}\n" in metadata, "LeRobot imports the distribution by this very name"
    assert any(name.endswith("dist-info/licenses/LICENSE") for name in names)


def test_the_plugin_stands_on_this_version(repository: Path) -> None:
    plugin = tomllib.loads((repository / PLUGIN / "pyproject.toml").read_text())["project"]
    ours = settings(repository)["project"]
    assert isinstance(ours, dict)
    assert plugin["version"] == playslot_rl.__version__
    lerobot = next(name for name in ours["dependencies"] if name.startswith("lerobot"))
    assert plugin["dependencies"] == [f"playslot_rl=={playslot_rl.__version__}", lerobot]
    assert (repository / PLUGIN / "LICENSE").read_bytes() == (repository / "LICENSE").read_bytes()


@pytest.mark.slow
def test_the_wheel_works_outside_the_repository(repository: Path, tmp_path: Path) -> None:
    target = tmp_path / "site"
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    source = copied(repository, tmp_path)
    subprocess.run([*install, "--target", str(target), str(source)], check=True, capture_output=True)
    code = (
        "import playslot_rl, multiprocessing as mp\n"
        "from playslot_rl.config.compose import choices, compose\n"
        "from playslot_rl.envs import make_env\n"
        "print(playslot_rl.__file__, compose(['preset=smoke']).preset, 'block_push' in choices('env'))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env={"PYTHONPATH": str(target)}, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [str(target / "playslot_rl" / "__init__.py"), "smoke", "True"]
