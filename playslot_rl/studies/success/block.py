"""The block of evaluation episodes that a comparison is measured on: one of development's, or a test's, drawn once."""

from __future__ import annotations

import secrets
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from playslot_rl.config import ExperimentConfig
from playslot_rl.seeds.episodes import TEST_BLOCKS
from playslot_rl.storage.atomic import json_or_nothing, read_json, write_json
from playslot_rl.storage.checkpoints import source_commit


def block_file(config: ExperimentConfig) -> Path:
    """`OUT/test_block.json`: the number, and when and at which commit it was drawn."""
    return Path(config.out) / "test_block.json"


def with_block(config: ExperimentConfig) -> ExperimentConfig:
    """The config with the number of its block. A test's is as typed, or as drawn for this folder before, or drawn now:
    nobody has seen its episodes.
    """
    own = config.compare
    if own.block == "development" or own.evaluation_seed >= TEST_BLOCKS:
        return config
    path = block_file(config)
    if path.is_file():
        drawn = read_json(path, "name another out=, which draws another block")
    else:
        number = TEST_BLOCKS + secrets.randbelow(TEST_BLOCKS)
        drawn = {"number": number, "date": datetime.now(UTC).date().isoformat(), "commit": source_commit()}
        write_json(path, drawn)
    return replace(config, compare=replace(own, evaluation_seed=int(drawn["number"])))


def block_of(config: ExperimentConfig) -> dict[str, Any]:
    """`number`, `kind` (`development` or `test`), and of one that was drawn here `date` and `commit`."""
    number = config.compare.evaluation_seed
    drawn = json_or_nothing(block_file(config))
    when = {key: drawn[key] for key in ("date", "commit")} if drawn.get("number") == number else {}
    return {"number": number, "kind": "test" if number >= TEST_BLOCKS else "development", **when}
