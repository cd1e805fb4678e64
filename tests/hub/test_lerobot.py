"""Plain LeRobot on the other side of the Hub; and a pull that is killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fake_hub import WRITE_TOKEN, FakeHub, Fault, Repository
from small_data import contents

from playslot_rl.data.metadata import FORMAT_TAG
from playslot_rl.datasets.fingerprint import content_fingerprint

Client = Callable[..., dict[str, Any]]
pytestmark = pytest.mark.slow

WRITE = """
    import sys
    from pathlib import Path
    sys.path.insert(0, TESTS)
    from foreign import write_foreign
    write_foreign(Path(ROOT), "image", cameras=("top", "side"))
"""
LOAD = """
    import hashlib, json
    import numpy as np
    from lerobot.datasets.dataset_metadata import CODEBASE_VERSION
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    def digest(dataset):
        rows = [dataset[i] for i in range(len(dataset))]
        return {name: hashlib.sha256(b"".join(np.asarray(row[name]).tobytes() for row in rows)).hexdigest()
                for name in ("observation.images.top", "observation.images.side", "action")}

    there = LeRobotDataset("owner/press", delta_timestamps={"action": [0.0, 0.1]})
    here = LeRobotDataset("owner/press", root=ROOT, delta_timestamps={"action": [0.0, 0.1]})
    print(json.dumps({"equal": digest(there) == digest(here), "episodes": there.num_episodes, "frames": len(there),
                      "version": CODEBASE_VERSION, "elsewhere": str(there.root) != ROOT}))
"""
PUSH = """
    import huggingface_hub
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    huggingface_hub.RepoCard.validate = lambda *_, **__: None  # asks the real Hub, whatever HF_ENDPOINT says
    LeRobotDataset("owner/press", root=ROOT).push_to_hub()
"""


def run(code: str, hub: FakeHub, root: Path, home: Path) -> str:
    """Run LeRobot in a process of its own; returns the last line it printed."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("HF_")}
    environment |= {"HF_ENDPOINT": hub.url, "HF_HOME": str(home), "HF_TOKEN": WRITE_TOKEN, "HF_HUB_DISABLE_XET": "1"}
    tests = str(Path(__file__).parents[1] / "data")
    code = f"ROOT, TESTS = {str(root)!r}, {tests!r}\n" + textwrap.dedent(code)
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return (done.stdout.splitlines() or [""])[-1]


def test_plain_lerobot_loads_what_we_pushed(hub: FakeHub, client: Client, tmp_path: Path) -> None:
    root = tmp_path / "written"
    run(WRITE, hub, root, tmp_path / "home")
    answer = client("push", root=root, repo_id="owner/press", private=False)
    assert "error" not in answer, answer
    loaded = json.loads(run(LOAD, hub, root, tmp_path / "home"))
    expected = {"equal": True, "episodes": 3, "frames": 15, "version": FORMAT_TAG, "elsewhere": True}
    assert loaded == expected


def test_what_lerobot_pushed_is_pulled(hub: FakeHub, client: Client, tmp_path: Path) -> None:
    root = tmp_path / "written"
    run(WRITE, hub, root, tmp_path / "home")
    run(PUSH, hub, root, tmp_path / "home")
    answer = client("pull", repo_id="owner/press", root=tmp_path / "there")
    assert "error" not in answer, answer
    assert answer["result"]["fingerprint"] == content_fingerprint(root).value
    assert answer["result"]["compared"] is False
    assert contents(tmp_path / "there").items() >= contents(root).items()


def test_a_pull_that_is_killed_leaves_nothing_in_its_place_and_carries_on(
    pushed: Repository, hub: FakeHub, start: Callable[..., Any], client: Client, data: Path, tmp_path: Path
) -> None:
    root = tmp_path / "there"
    hub.stalled.clear()
    hub.go_on.clear()
    hub.faults.append(Fault("GET", r"/resolve/.*file-001\.parquet", stall=True))
    victim = start()

    def ask() -> None:
        with pytest.raises(json.JSONDecodeError):  # it answers nothing more
            victim("pull", repo_id="owner/press", root=root)

    asking = threading.Thread(target=ask)
    asking.start()
    assert hub.stalled.wait(120)
    victim.process.send_signal(signal.SIGKILL)
    hub.go_on.set()
    asking.join(60)
    assert not root.exists()
    assert "error" not in client("pull", repo_id="owner/press", root=root)
    assert contents(root).items() >= contents(data).items()
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".there")] == []
