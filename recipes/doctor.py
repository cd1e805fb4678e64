"""`playslot doctor`: what works on this machine, and the cure for what does not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from playslot_rl.config import ExperimentConfig
from playslot_rl.data.cache import cache_folder
from playslot_rl.runtime import checks


def main(config: ExperimentConfig) -> int:
    """Print one finding after the other; 0 if everything essential works, otherwise 1."""
    asked: list[Callable[[], checks.Check]] = [
        checks.check_python,
        checks.check_packages,
        lambda: checks.check_torch(config.device),
        checks.check_rendering,
        checks.check_video,
        checks.check_torchcodec,
        checks.check_ffmpeg,
        lambda: checks.check_disk(Path(config.out or ".").resolve()),
        checks.check_cores,
        lambda: checks.check_cache(cache_folder(config.data.cache)),
    ]
    failed = 0
    for check in asked:
        finding = check()
        print(finding.line(), flush=True)
        failed += finding.status == "FAIL"
    print("\neverything essential works" if not failed else f"\n{failed} essential part(s) do not work")
    return 1 if failed else 0
