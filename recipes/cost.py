"""The tables of `playslot bench` about a training step, for any config: `python -m playslot_rl.recipes.cost
preset=paper`.

Operations of a step are counted on this CPU, with the memory and time that they mean on devices of *assumed* speed
(`playslot_rl.speed.cost.Machine`). With `device=` steps are also *measured* there, in fp32 and bf16, with and without
torch.compile where the setting `compile` is on: `device=cuda` takes a minute on an H100, `device=cpu` many.
"""

from __future__ import annotations

import sys

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import compose
from playslot_rl.errors import PlaySlotError, explain


def main(config: ExperimentConfig) -> str:
    """The tables, in Markdown; progress goes to standard error."""
    from playslot_rl.runtime.threads import set_threads, tune_allocator
    from playslot_rl.speed.report import cost_tables

    tune_allocator()
    set_threads(config.threads)
    return cost_tables(config, lambda text: print(f"{text} ...", file=sys.stderr, flush=True))


if __name__ == "__main__":
    try:
        print(main(compose(sys.argv[1:])))
    except PlaySlotError as error:
        sys.exit(f"cost: error: {explain(error)}")
