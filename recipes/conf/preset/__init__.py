"""The `preset` group: `smoke` (tests), `compact` (two CPU cores), `compact_gpu`, `gpu`, `paper` (one GPU)."""
