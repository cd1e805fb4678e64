"""How fast episodes are collected, and where the time goes. Leave the machine idle.

.venv/bin/python benchmarks/collect.py --env button_press --workers 1,2 --episodes 40 [--json FILE] [key=value ...]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="button_press", help="environment name")
    parser.add_argument("--policy", default="random", choices=["random", "expert"])
    parser.add_argument("--steps", type=int, default=25, help="agent steps an episode")
    parser.add_argument("--workers", default="1,2", help="numbers of workers to compare, separated by commas")
    parser.add_argument("--episodes", type=int, default=40, help="counted episodes of each rate")
    parser.add_argument("--repeats", type=int, default=3, help="turns; the rates are medians")
    parser.add_argument("--target", type=int, default=20_000, help="size of the collection to extrapolate to")
    parser.add_argument("--json", type=Path, help="also write the figures there")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="changes of the config")
    options = parser.parse_intermixed_args()

    from playslot_rl.config.compose import compose
    from playslot_rl.envs.rendering import import_mujoco
    from playslot_rl.errors import PlaySlotError

    try:
        config = compose([f"env={options.env}", *options.overrides], "collect")
        import_mujoco()  # before torchrl, which imports it too
        import torch

        torch.set_num_threads(1)  # as in the workers
        from playslot_rl.speed.collecting import measure, table
        from playslot_rl.storage.atomic import write_json

        figures = measure(
            config,
            options.policy,
            options.steps,
            [int(count) for count in options.workers.split(",")],
            options.episodes,
            options.repeats,
            options.target,
            say=lambda text: print(f"{text} ...", file=sys.stderr, flush=True),
        )
    except PlaySlotError as error:
        print(f"benchmarks/collect.py: error: {error}", file=sys.stderr)
        return 1
    print(table(figures))
    if options.json is not None:
        write_json(options.json, figures)
        print(f"written: {options.json}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
