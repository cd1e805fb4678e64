"""The `preset` group: `smoke` (tests), `compact` (two CPU cores), `compact_gpu` (for a GPU), `paper` (one GPU)."""
