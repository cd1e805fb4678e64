"""The Python blocks of the README and of docs/ run, in the order of their page, on what the page says is there."""

from __future__ import annotations

import multiprocessing
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ROOT / "playslot_rl" / "pretrained" / "button_press"


def blocks(page: Path) -> list[str]:
    """The ```python blocks of a page."""
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


PAGES = [page for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))] if blocks(page)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs with the stored policy, two data sets, and `policies/press`: what the pages start from."""
    from playslot_rl.api import load
    from playslot_rl.collectors import collect
    from playslot_rl.config import to_dict
    from playslot_rl.config.compose import compose
    from playslot_rl.storage.atomic import write_json

    root = tmp_path_factory.mktemp("docs")
    run = root / "runs" / "demo"
    shutil.copytree(SHIPPED / "policy" / "checkpoint", run / "policy" / "checkpoint")
    write_json(run / "world_model.json", {"source": "pretrained/button_press"})
    config = compose(["preset=compact", "logging.progress=false"])
    write_json(run / "config.json", to_dict(config))
    shutil.copytree(run, root / "runs" / "first")
    load(run, "cpu").save_pretrained(root / "policies" / "press")
    for seed, name in enumerate(("expert", "noisy")):
        collect(config, "expert", 6, 8, root / "data" / name, seed=seed, workers=1)
    return root


@pytest.fixture
def forking() -> Iterator[None]:
    """As on the page alone: importing TorchRL, as other pages do, would have a DataLoader's workers import all anew."""
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method("fork", force=True)
    yield
    multiprocessing.set_start_method(before, force=True)


def given(page: str, block: int) -> dict[str, Any]:
    """Names that a block takes as the reader's own."""
    import torch

    if page != "export.md":
        return {}
    frame = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(0))
    return {"frame": frame.mul(255).byte().movedim(0, -1).numpy() if block == 0 else frame}


def test_every_page_with_python_is_run() -> None:
    names = {"README.md", "first-policy.md", "python.md", "data.md", "data-sets.md", "hub.md", "play.md", "export.md"}
    names |= {"environments.md", "plan.md", "torchrl.md", "add-a-method.md", "add-a-task.md"}
    assert names <= {page.name for page in PAGES}


@pytest.mark.usefixtures("forking")
@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "hub.md"], ids=lambda page: page.name)
def test_the_python_blocks_of_a_page_run(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.chdir(folder)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    names: dict[str, Any] = {}
    for number, source in enumerate(blocks(page)):
        names |= given(page.name, number)
        code = compile(
            "\n" * page.read_text()[: page.read_text().index(source)].count("\n") + source, str(page), "exec"
        )
        with torch.random.fork_rng(devices=[]):
            exec(code, names)


def test_the_python_blocks_about_the_hub_run(folder: Path) -> None:
    """In a process of its own: huggingface_hub reads where its Hub is when it is imported."""
    sys.path.insert(0, str(ROOT / "tests" / "hub"))
    from fake_hub import WRITE_TOKEN, FakeHub

    with FakeHub().running() as hub:
        variables = {key: value for key, value in os.environ.items() if not key.startswith(("HF_", "HUGGING"))}
        variables |= {
            "HF_ENDPOINT": hub.url,
            "HF_HOME": str(folder / "home"),
            "HF_TOKEN": WRITE_TOKEN,
            "HF_HUB_DISABLE_XET": "1",
        }
        # RepoCard.validate asks the real Hub, whatever the endpoint.
        code = "import huggingface_hub\nhuggingface_hub.RepoCard.validate = lambda *_, **__: None\n"
        code += "".join(blocks(ROOT / "docs" / "how-to" / "hub.md")).replace("me/button-press", "owner/button-press")
        done = subprocess.run([sys.executable, "-c", code], cwd=folder, env=variables, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert (folder / "data" / "mine" / "meta" / "info.json").is_file()
