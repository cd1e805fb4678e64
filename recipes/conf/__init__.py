"""The shipped YAML: groups `env`, `preset`, what a task asks of a model (`env_model`), or in one preset (`env_preset`).

The dataclasses of playslot_rl/config are the truth: they hold every key with its default (the paper's sizes) and refuse
unknown ones; these files only change values. The later group wins; what is typed on the command line beats them all.
`as: NAME` takes another file of the same folder first.
"""
