"""The `preset` group: `smoke` (tests), `compact` (two CPU cores), `paper` (one GPU)."""
