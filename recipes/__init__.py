"""Recipes: each command of `playslot` is one module here, with `main(config: ExperimentConfig) -> None`.

A recipe only chooses among the library's parts: it defines no `nn.Module`. It raises those of `playslot_rl.errors`:
ConfigError for what was typed, CheckpointError for a run, DataError for data, OutputError for what is written.
"""
