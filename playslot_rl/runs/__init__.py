"""Runs: opened once at a command's edge; their stages are read once and checked, their networks restored in one place."""

from playslot_rl.runs.run import Run, pretrained_folder

__all__ = ["Run", "pretrained_folder"]
