"""Recipes: each command of `playslot` is one module here, with `main(config: ExperimentConfig) -> None`.

A recipe only chooses among the library's parts: it defines no `nn.Module`.
"""
